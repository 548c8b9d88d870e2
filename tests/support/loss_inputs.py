"""What a loss term is computed from, of images alone."""

from __future__ import annotations

import torch

from mvsgs_core.mapping.losses import LossInputs
from mvsgs_core.rasterizer.interface import Backward, Render
from tests.support.rasterizer_scenes import random_splats


def inputs_of(image: torch.Tensor, target: torch.Tensor, frequency: float) -> LossInputs:
    """The render is `image` (H, W, 3); the splats are five of no relation to it."""
    nothing = torch.zeros(0)
    render = Render(image, nothing, nothing, nothing, nothing, nothing, None, 0, Backward())
    return LossInputs(render, target, random_splats(5, bases=1), frequency, threads=1)
