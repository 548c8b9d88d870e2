"""The training loss of GES (Hamdi et al. 2024): L1 + SSIM + an L1 inside a frequency-modulated, edge-aware mask.

The mask comes from a difference of Gaussians of the render, whose width moves with the training's progress
`frequency` in 0 to 100: in the first half the smooth regions are kept (the mask is inverted), in the second the edges.
An online run, whose length is not known ahead, gives each view its own progress: see `frequency_of`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mvsgs_core.rasterizer import ssim

LOWERED = 0.2  # scale at which the mask is made
TINY = 1e-20


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms; those of GES's released code."""

    l1: float = 0.3
    ssim: float = 0.2  # of 1 - SSIM
    frequency: float = 0.5  # of the masked L1; 0 leaves the mask out


def frequency_of(iterations: int, horizon: int) -> float:
    """Progress 0 to 100 of a view that was trained on `iterations` times and counts as done after `horizon`."""
    return 100.0 * min(1.0, iterations / max(1, horizon))


def mask_sigma(frequency: float) -> float:
    """Standard deviation in lowered pixels of the narrower Gaussian."""
    return 0.1 + 0.1 * (frequency if frequency < 50.0 else 100.0 - frequency)


def lowered_gray(image: Tensor) -> Tensor:
    """(1, 1, h, w): the mean of the channels of (H, W, 3) at 0.2 of the size, at least a pixel."""
    gray = image.mean(dim=-1)[None, None]
    if min(gray.shape[2:]) * LOWERED >= 1.0:
        # coordinates by the factor, not by the ratio of the sizes, as in the released code
        return functional.interpolate(
            gray, scale_factor=LOWERED, mode="bilinear", align_corners=False, recompute_scale_factor=False
        )
    size = [max(1, int(side * LOWERED)) for side in gray.shape[2:]]
    return functional.interpolate(gray, size=size, mode="bilinear", align_corners=False)


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian of (1, 1, h, w), zeros beyond the border, window of 2 round(3 sigma) + 1 with weights that sum to 1."""
    radius = round(3.0 * sigma)
    offsets = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2.0 * sigma * sigma))
    window = window / window.sum()
    rows = functional.conv2d(image, window.view(1, 1, -1, 1), padding=(radius, 0))
    return functional.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, radius))


def difference_of_gaussians(lowered: Tensor, frequency: float) -> Tensor:
    """Edges of (1, 1, h, w) at the width of a frequency; taken in float64, as at the ends they are of the size 1e-6."""
    sigma, exact = mask_sigma(frequency), lowered.double()
    return (_blur(exact, sigma) - _blur(exact, 2.0 * sigma)).to(lowered.dtype)


def edge_response(image: Tensor, frequency: float) -> Tensor:
    """(H, W) in 0 to 1: the difference of Gaussians of a render (H, W, 3), normalized, inverted below frequency 50.

    A uniform image has no edges: 0, or 1 where inverted. Raises ValueError for a frequency outside of 0 to 100.
    """
    if not 0.0 <= frequency <= 100.0:
        raise ValueError(f"frequency {frequency}: expected 0 to 100")
    with torch.no_grad():
        edges = difference_of_gaussians(lowered_gray(image), frequency)
        raised = functional.interpolate(edges, size=image.shape[:2], mode="bilinear", align_corners=False)[0, 0]
        low, high = raised.min(), raised.max()
        response = (raised - low) / (high - low).clamp(min=TINY)
        return 1.0 - response if frequency < 50.0 else response


def frequency_mask(image: Tensor, frequency: float) -> Tensor:
    """(H, W) bool of a render (H, W, 3), without gradient: where the third term looks."""
    return edge_response(image, frequency) >= 0.5


def photometric_loss(
    image: Tensor, target: Tensor, frequency: float, config: LossConfig | None = None, threads: int | None = None
) -> Tensor:
    """config.l1 L1 + config.ssim (1 - SSIM) + config.frequency mean |m image - m target|, a scalar; (H, W, 3) images.

    Means are over all pixels, the masked one too. The gradient goes to `image` only, none through the mask.
    """
    weights = config or LossConfig()
    extra = None
    if weights.frequency > 0.0:
        extra = weights.frequency * frequency_mask(image.detach(), frequency).to(image.dtype)
    return ssim.image_loss(
        image, target, l1_weight=weights.l1, ssim_weight=weights.ssim, pixel_weight=extra, threads=threads
    )
