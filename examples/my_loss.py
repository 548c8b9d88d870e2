"""A loss of your own, in a file outside the repository: what the mapper minimizes in place of L1 and SSIM.

    mvsgs dataset=tum dataset.path=DIR mapper.training.loss_function=my_loss.robust

or in a program: `Mapping(loss=robust)`. It is called once an iteration, and what it returns is differentiated: for the
rasterizer's outputs (`inputs.render`: color (H, W, 3), depth and opacity (H, W)) and the map's splats.
"""

from __future__ import annotations

import torch

from mvsgs_core.mapping.losses import LossInputs, LossWeights, training_loss, weights_of

EDGE = 0.03  # of the range of colors: errors far beyond it count by their size, not by its square
OPACITY = 0.005  # weight of splats that are neither opaque nor gone

USUAL = weights_of("ssim", LossWeights(l1=0.0))  # the mapper's own terms, without the one that is replaced


def robust(inputs: LossInputs) -> torch.Tensor:
    """Charbonnier's error of the colors beside SSIM, and a price on half-transparent splats; a scalar."""
    difference = inputs.render.color - inputs.target
    colors = (difference.square() + EDGE**2).sqrt().mean() - EDGE
    opacity = inputs.splats.opacity_logits.sigmoid()
    return 0.8 * colors + training_loss(inputs, USUAL) + OPACITY * (opacity * (1.0 - opacity)).mean()
