"""The C++ back end: tensors go in as they lie in memory, nothing is copied.

They go as NumPy views: a tensor's own exchange protocol takes several microseconds of Python each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import native
from mvsgs_core.rasterizer.differentiable import Images, OnImages, Rendered
from mvsgs_core.rasterizer.interface import RenderSettings, SplatStep
from mvsgs_core.rasterizer.splats import FIELDS


def forward(settings: RenderSettings, parameters: list[Tensor]) -> tuple[Images, Rendered]:
    """See `BackEnd`. Raises ValueError unless the splats are float32 in main memory, and for too many pairs."""
    means = parameters[0]
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ValueError(
            f"the cpu back end takes float32 splats on the CPU, got {means.dtype} on {means.device}: "
            "take backend='reference' for float64"
        )
    color = torch.empty(*settings.size, 3)
    depth, opacity = torch.empty(settings.size), torch.empty(settings.size)
    radii = torch.empty(len(means))
    passed = native.load("rasterizer").forward(
        settings=settings,
        pose=settings.pose.detach().contiguous().numpy(),
        splats=[parameter.numpy() for parameter in parameters],
        color=color.numpy(),
        depth=depth.numpy(),
        opacity=opacity.numpy(),
        radii=radii.numpy(),
    )
    weight_max = None
    if settings.weights:
        weight_max = torch.empty(len(means))
        native.load("rasterizer").weights(passed, weight_max.numpy())
    return (color, depth, opacity), Rendered(radii, passed.refused, weight_max, passed)


def backward(
    settings: RenderSettings, kept: Any, parameters: list[Tensor], images: Images, on_images: OnImages,
    on_splats: list[Tensor], on_means2d: Tensor, wants_pose: bool,
) -> tuple[Tensor, int]:  # fmt: skip
    """See `BackEnd`."""
    on_pose = torch.zeros(4, 4, dtype=torch.float64)
    refused: int = native.load("rasterizer").backward(
        kept,
        splats=[parameter.numpy() for parameter in parameters],
        **_arrays(images, on_images),
        on_splats=[gradient.numpy() for gradient in on_splats],
        on_means2d=on_means2d.numpy(),
        on_pose=on_pose.numpy(),
    )
    return on_pose, refused


def backward_opacity(kept: Any, opacity_logits: Tensor, images: Images, on_images: OnImages) -> tuple[Tensor, int]:
    """See `OpacityBackEnd`."""
    on_logits = torch.empty_like(opacity_logits)
    refused: int = native.load("rasterizer").backward_opacity(
        kept,
        opacity_logits=opacity_logits.numpy(),
        **_arrays(images, on_images),
        on_logits=on_logits.numpy(),
    )
    return on_logits, refused


def backward_step(
    settings: RenderSettings, kept: Any, parameters: list[Tensor], images: Images, on_images: OnImages,
    step: SplatStep,
) -> tuple[Tensor, int]:  # fmt: skip
    """See `SteppingBackEnd`."""
    on_pose = torch.zeros(4, 4, dtype=torch.float64)
    moved = [
        (FIELDS.index(m.name), m.first.numpy(), m.second.numpy(), m.rate, m.final_rate, m.low, m.high, m.lead, m.tail)
        for m in step.moved
        if settings.exact or m.name != "betas"
    ]
    refused, step.refused = native.load("rasterizer").backward_step(
        kept,
        values=[parameter.numpy() for parameter in parameters],
        **_arrays(images, on_images),
        moved=moved,
        ages=step.ages.numpy(),
        constants=step.constants,
        decay_steps=step.decay_steps,
        means2d_gradient=step.means2d_gradient.numpy(),
        means2d_views=step.means2d_views.numpy(),
        on_pose=on_pose.numpy(),
    )
    return on_pose, refused


def _arrays(images: Images, on_images: OnImages) -> dict[str, np.ndarray | None]:
    """As the kernels' arguments."""
    names, given = ("color", "depth", "opacity"), [*images, *on_images]
    arrays = (None if tensor is None else tensor.numpy() for tensor in given)
    return dict(zip([*names, *(f"on_{name}" for name in names)], arrays))
