"""The C++ rasterizer behind PyTorch's autograd: tensors go in as they lie in memory, nothing is copied.

They go as NumPy views: a tensor's own exchange protocol takes several microseconds of Python each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvsgs_core import native
from mvsgs_core.rasterizer.interface import Backward, Render, RenderSettings, means2d_leaf
from mvsgs_core.rasterizer.splats import Splats


class _Rasterize(torch.autograd.Function):
    """(means2d, pose, fields of Splats) -> color, depth, opacity; the rest of a `Render` is left in `extra`."""

    @staticmethod
    def forward(
        ctx: Any, settings: RenderSettings, extra: dict[str, Any], means2d: Tensor, pose: Tensor, *splats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        parameters = [tensor.detach().contiguous() for tensor in splats]
        color = torch.empty(*settings.size, 3)
        depth, opacity = torch.empty(settings.size), torch.empty(settings.size)
        radii = torch.empty(len(means2d))
        passed = native.load("rasterizer").forward(
            settings=settings,
            pose=pose.detach().contiguous().numpy(),
            splats=[parameter.numpy() for parameter in parameters],
            color=color.numpy(),
            depth=depth.numpy(),
            opacity=opacity.numpy(),
            radii=radii.numpy(),
        )
        extra.update(passed=passed, radii=radii)
        ctx.passed, ctx.settings, ctx.report = passed, settings, extra["backward"]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parameters, color, depth, opacity)
        return color, depth, opacity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *parameters, color, depth, opacity = ctx.saved_tensors
        on_color, on_depth, on_opacity = (None if g is None else g.detach().contiguous().numpy() for g in gradients)
        results = [torch.empty_like(parameter) for parameter in parameters]
        on_means2d = torch.empty(len(parameters[0]), 2)
        on_pose = torch.zeros(4, 4, dtype=torch.float64)
        ctx.report.refused = native.load("rasterizer").backward(
            ctx.passed,
            splats=[parameter.numpy() for parameter in parameters],
            color=color.numpy(),
            depth=depth.numpy(),
            opacity=opacity.numpy(),
            on_color=np.zeros(color.shape, np.float32) if on_color is None else on_color,
            on_depth=on_depth,
            on_opacity=on_opacity,
            on_splats=[result.numpy() for result in results],
            on_means2d=on_means2d.numpy(),
            on_pose=on_pose.numpy(),
        )
        *shared, on_betas = results
        return (None, None, on_means2d, on_pose, *shared, on_betas if ctx.settings.exact else None)


def render(splats: Splats, settings: RenderSettings) -> Render:
    """See `rasterizer.rasterize`. Raises ValueError unless the splats are float32 in main memory."""
    if splats.means.dtype != torch.float32 or splats.means.device.type != "cpu":
        raise ValueError(
            f"the cpu back end takes float32 splats on the CPU, got {splats.means.dtype} on {splats.means.device}: "
            "take backend='reference' for float64"
        )
    count = len(splats)
    means2d = means2d_leaf(splats, settings)
    extra: dict[str, Any] = {"backward": Backward()}
    color, depth, opacity = _Rasterize.apply(settings, extra, means2d, settings.pose, *splats.tensors().values())
    weight_sum = weight_max = None
    if settings.weights:
        weight_sum, weight_max = torch.empty(count), torch.empty(count)
        native.load("rasterizer").weights(extra["passed"], weight_sum.numpy(), weight_max.numpy())
    return Render(
        color=color,
        depth=depth,
        opacity=opacity,
        visible=extra["radii"] > 0,
        radii=extra["radii"],
        means2d=means2d,
        weight_sum=weight_sum,
        weight_max=weight_max,
        refused=extra["passed"].refused,
        backward=extra["backward"],
    )
