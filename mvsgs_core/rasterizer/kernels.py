"""The three kernels by name: how a splat's weight falls with the squared Mahalanobis distance m in the image.

- "gaussian": exp(-m / 2).
- "exact": exp(-1/2 m^(beta/2)), the generalized exponential of GES (Hamdi et al. 2024, eq. 2) with the power inside;
  beta = 2 is the Gaussian.
- "ges_scale": what the released code of GES does: a Gaussian whose scales are multiplied by 2 sigmoid(b / 10).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

KERNELS = ("gaussian", "exact", "ges_scale")

BETA_RANGE = (0.1, 20.0)  # exponents outside are used as the nearer end, without gradient
CENTER_M = 1e-6  # below this m the exact kernel is flat: for beta < 1 its slope has no bound at the center
MIN_ALPHA = 1.0 / 255.0  # a splat ends where its alpha falls below this


def check_kernel(kernel: str) -> None:
    if kernel not in KERNELS:
        raise ValueError(f"kernel {kernel!r}: choose one of {', '.join(KERNELS)}")


def neutral_beta(kernel: str) -> float:
    """The value of `Splats.betas` at which the kernel is the plain Gaussian."""
    check_kernel(kernel)
    return 0.0 if kernel == "ges_scale" else 2.0


def log_scale_shift(b: Tensor) -> Tensor:
    """Log of 2 sigmoid(b / 10) of raw shape parameters (N,), the factor on the scales in "ges_scale": finite for every
    finite b."""
    return math.log(2.0) + torch.nn.functional.logsigmoid(0.1 * b)


def falloff(m: Tensor, betas: Tensor, exact: bool) -> Tensor:
    """The kernel, 1 at the center, at squared Mahalanobis distances `m` (..., N) of splats with `betas` (N,)."""
    if exact:
        exponent = 0.5 * betas.clamp(*BETA_RANGE)
        return torch.exp(-0.5 * m.clamp(min=CENTER_M) ** exponent)
    return torch.exp(-0.5 * m)


def extent(opacity: Tensor, betas: Tensor, exact: bool) -> Tensor:
    """m (N,) at which opacity * falloff = 1/255; 0 where the opacity is below 1/255."""
    twice_log = 2.0 * torch.log((opacity / MIN_ALPHA).clamp(min=1.0))
    if exact:
        return twice_log ** (2.0 / betas.clamp(*BETA_RANGE))
    return twice_log


def gaussian_std_ratio(betas: Tensor) -> Tensor:
    """Standard deviation (N,) in the image of the exact kernel over that of the Gaussian with the same covariance.

    sqrt(1/2 2^(2/beta) Gamma(4/beta) / Gamma(2/beta)): multiply the scales by it to show a map in a viewer that only
    knows Gaussians.
    """
    b = betas.clamp(*BETA_RANGE).double()
    log_ratio = 2.0 / b * math.log(2.0) + torch.lgamma(4.0 / b) - torch.lgamma(2.0 / b) - math.log(2.0)
    return torch.exp(0.5 * log_ratio).to(betas.dtype)
