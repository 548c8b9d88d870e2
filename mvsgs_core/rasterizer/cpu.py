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
    """(parameters, means2d, pose) -> color, depth, opacity; the rest of a `Render` is left in `extra`."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, log_scales: Tensor, quaternions: Tensor, opacity_logits: Tensor, sh: Tensor,
        betas: Tensor, means2d: Tensor, pose: Tensor, view: RenderSettings, extra: dict[str, Any],
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        height, width = view.size
        parameters = [t.detach().contiguous() for t in (means, log_scales, quaternions, opacity_logits, sh, betas)]
        color = torch.empty(height, width, 3)
        depth, opacity = torch.empty(height, width), torch.empty(height, width)
        radii = torch.empty(len(means))
        passed = native.load("rasterizer").forward(
            *(parameter.numpy() for parameter in parameters),
            pose=pose.detach().contiguous().numpy(),
            intrinsics=view.intrinsics,
            near=view.near,
            background=view.background,
            exact=view.kernel == "exact",
            antialiased=view.antialiased,
            degree=view.degree,
            tile_mask=None if view.tile_mask is None else view.tile_mask.numpy(),
            weights=view.weights,
            threads=view.threads,
            color=color.numpy(),
            depth=depth.numpy(),
            opacity=opacity.numpy(),
            radii=radii.numpy(),
        )
        extra.update(passed=passed, radii=radii)
        ctx.passed, ctx.view, ctx.report = passed, view, extra["backward"]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parameters, color, depth, opacity)
        return color, depth, opacity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *parameters, color, depth, opacity = ctx.saved_tensors
        on_color, on_depth, on_opacity = (None if g is None else g.detach().contiguous().numpy() for g in gradients)
        results = [torch.empty_like(parameter) for parameter in parameters]
        on_screen = torch.empty(len(parameters[0]), 2)
        on_pose = torch.zeros(4, 4, dtype=torch.float64)
        on_means, on_log_scales, on_quaternions, on_opacity_logits, on_sh, on_betas = (r.numpy() for r in results)
        ctx.report.refused = native.load("rasterizer").backward(
            ctx.passed,
            *(parameter.numpy() for parameter in parameters),
            color=color.numpy(),
            depth=depth.numpy(),
            opacity=opacity.numpy(),
            color_gradient=np.zeros(color.shape, np.float32) if on_color is None else on_color,
            depth_gradient=on_depth,
            opacity_gradient=on_opacity,
            threads=ctx.view.threads,
            on_means=on_means,
            on_log_scales=on_log_scales,
            on_quaternions=on_quaternions,
            on_opacity_logits=on_opacity_logits,
            on_sh=on_sh,
            on_betas=on_betas,
            on_screen=on_screen.numpy(),
            on_pose=on_pose.numpy(),
        )
        *shared, of_betas = results
        return (*shared, of_betas if ctx.view.kernel == "exact" else None, on_screen, on_pose, None, None)


def render(splats: Splats, view: RenderSettings) -> Render:
    """See `rasterizer.rasterize`. Raises ValueError unless the splats are float32 in main memory."""
    if splats.means.dtype != torch.float32 or splats.means.device.type != "cpu":
        raise ValueError(
            f"the cpu back end takes float32 splats on the CPU, got {splats.means.dtype} on {splats.means.device}: "
            "take backend='reference' for float64"
        )
    count = len(splats)
    means2d = means2d_leaf(splats, view)
    extra: dict[str, Any] = {"backward": Backward()}
    color, depth, opacity = _Rasterize.apply(*splats.tensors().values(), means2d, view.pose, view, extra)
    weight_sum = weight_max = None
    if view.weights:
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
