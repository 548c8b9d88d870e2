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

from mvsgs_core.splats import ssim

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


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian of (1, 1, h, w), zeros beyond the border, window of 2 round(3 sigma) + 1 with weights that sum to 1."""
    radius = round(3.0 * sigma)
    offsets = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2.0 * sigma * sigma))
    window = window / window.sum()
    rows = functional.conv2d(image, window.view(1, 1, -1, 1), padding=(radius, 0))
    return functional.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, radius))


def edge_response(image: Tensor, frequency: float) -> Tensor:
    """(H, W) in 0 to 1: the difference of Gaussians of a render (H, W, 3), normalized, inverted below frequency 50.

    A uniform image has no edges: 0, or 1 where inverted. Raises ValueError for a frequency outside of 0 to 100.
    """
    if not 0.0 <= frequency <= 100.0:
        raise ValueError(f"frequency {frequency}: expected 0 to 100")
    with torch.no_grad():
        grey = image.mean(dim=-1)[None, None]
        size = (max(1, int(grey.shape[2] * LOWERED)), max(1, int(grey.shape[3] * LOWERED)))
        if min(grey.shape[2:]) * LOWERED >= 1.0:
            lowered = functional.interpolate(
                grey, scale_factor=LOWERED, mode="bilinear", align_corners=False, recompute_scale_factor=False
            )
        else:
            lowered = functional.interpolate(grey, size=size, mode="bilinear", align_corners=False)
        sigma = mask_sigma(frequency)
        edges = _blur(lowered, sigma) - _blur(lowered, 2.0 * sigma)
        raised = functional.interpolate(edges, size=grey.shape[2:], mode="bilinear", align_corners=False)[0, 0]
        low, high = raised.min(), raised.max()
        response = (raised - low) / (high - low).clamp(min=TINY)
        return 1.0 - response if frequency < 50.0 else response


def frequency_mask(image: Tensor, frequency: float) -> Tensor:
    """(H, W) bool of a render (H, W, 3), without gradient: where the third term looks."""
    return edge_response(image, frequency) >= 0.5


def ges_loss(
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
