"""A back end's forward and backward pass behind PyTorch's autograd."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvsgs_core.rasterizer.interface import Backward, Render, RenderSettings, SplatStep, means2d_leaf
from mvsgs_core.rasterizer.splats import Splats

Images = tuple[Tensor, Tensor, Tensor]  # color (H, W, 3), depth (H, W), opacity (H, W)
OnImages = tuple[Tensor, Tensor | None, Tensor | None]  # gradients of these; None: 0


@dataclass(frozen=True)
class Rendered:
    """What a forward pass gives beside the images; see `Render`."""

    radii: Tensor
    refused: int
    weight_max: Tensor | None
    kept: Any  # what the backward pass reads again, beside parameters and images


class BackEnd(Protocol):
    """A module with these two functions; `parameters` are the fields of `Splats` in their order, contiguous."""

    def forward(self, settings: RenderSettings, parameters: list[Tensor]) -> tuple[Images, Rendered]:
        """Raises ValueError for a dtype or device that the back end does not take."""

    def backward(
        self, settings: RenderSettings, kept: Any, parameters: list[Tensor], images: Images, on_images: OnImages,
        on_splats: list[Tensor], on_means2d: Tensor, wants_pose: bool,
    ) -> tuple[Tensor | None, int | None]:  # fmt: skip
        """Fills on_splats and on_means2d from the gradients of the images, None: 0; returns that of the pose, and how
        many splats were refused, None: not counted."""


class OpacityBackEnd(BackEnd, Protocol):
    """One that can give the gradients of opacities without the others."""

    def backward_opacity(
        self, kept: Any, opacity_logits: Tensor, images: Images, on_images: OnImages
    ) -> tuple[Tensor, int]:
        """As `backward`; the gradient of the logits, and how many splats were refused."""


class SteppingBackEnd(BackEnd, Protocol):
    """One that can step the splats in the backward pass."""

    def backward_step(
        self, settings: RenderSettings, kept: Any, parameters: list[Tensor], images: Images, on_images: OnImages,
        step: SplatStep,
    ) -> tuple[Tensor, int]:  # fmt: skip
        """As `backward`, but the parameters are changed as `step` says, and no gradient of theirs is kept."""


class _Rasterize(torch.autograd.Function):
    """(means2d, pose, fields of Splats) -> color, depth, opacity; the rest of the forward pass goes into `rest`."""

    @staticmethod
    def forward(
        ctx: Any, back_end: BackEnd, settings: RenderSettings, rest: list[Rendered], report: Backward,
        means2d: Tensor, pose: Tensor, *splats: Tensor,
    ) -> Images:  # fmt: skip
        parameters = [tensor.detach().contiguous() for tensor in splats]
        images, rendered = back_end.forward(settings, parameters)
        rest.append(rendered)
        ctx.back_end, ctx.settings, ctx.kept, ctx.report = back_end, settings, rendered.kept, report
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parameters, *images)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        *parameters, color, depth, opacity = ctx.saved_tensors
        on_splats = [torch.empty_like(parameter) for parameter in parameters]
        on_means2d = color.new_empty(len(parameters[0]), 2)
        on_pose, ctx.report.refused = ctx.back_end.backward(
            ctx.settings, ctx.kept, parameters, (color, depth, opacity), _on_images(color, gradients), on_splats,
            on_means2d, ctx.needs_input_grad[5],
        )  # fmt: skip
        *shared, on_betas = on_splats
        return (None, None, None, None, on_means2d, on_pose, *shared, on_betas if ctx.settings.exact else None)


class _Stepped(torch.autograd.Function):
    """(pose, fields of Splats) -> color, depth, opacity; the backward pass steps the fields, which get no gradient."""

    @staticmethod
    def forward(
        ctx: Any, back_end: SteppingBackEnd, settings: RenderSettings, rest: list[Rendered], report: Backward,
        step: SplatStep, pose: Tensor, *splats: Tensor,
    ) -> Images:  # fmt: skip
        parameters = [tensor.detach() for tensor in splats]
        images, rendered = back_end.forward(settings, parameters)
        rest.append(rendered)
        ctx.back_end, ctx.settings, ctx.kept, ctx.report, ctx.step = back_end, settings, rendered.kept, report, step
        ctx.parameters = parameters  # not saved for autograd: they are changed on purpose
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*images)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        color, depth, opacity = ctx.saved_tensors
        on_pose, ctx.report.refused = ctx.back_end.backward_step(
            ctx.settings, ctx.kept, ctx.parameters, (color, depth, opacity), _on_images(color, gradients), ctx.step
        )
        return (None, None, None, None, None, on_pose, *[None] * len(ctx.parameters))


class _OfOpacities(torch.autograd.Function):
    """(opacity_logits) -> color, depth, opacity, of splats nothing else of which is trained."""

    @staticmethod
    def forward(
        ctx: Any, back_end: OpacityBackEnd, settings: RenderSettings, rest: list[Rendered], report: Backward,
        splats: Splats, opacity_logits: Tensor,
    ) -> Images:  # fmt: skip
        images, rendered = back_end.forward(settings, [t.detach().contiguous() for t in splats.tensors().values()])
        rest.append(rendered)
        ctx.back_end, ctx.kept, ctx.report = back_end, rendered.kept, report
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(opacity_logits, *images)
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        opacity_logits, color, depth, opacity = ctx.saved_tensors
        on_logits, ctx.report.refused = ctx.back_end.backward_opacity(
            ctx.kept, opacity_logits.contiguous(), (color, depth, opacity), _on_images(color, gradients)
        )
        return (None, None, None, None, None, on_logits)


def _on_images(color: Tensor, gradients: tuple[Tensor | None, ...]) -> OnImages:
    """As a back end takes them."""
    on_color, on_depth, on_opacity = (None if g is None else g.detach().contiguous() for g in gradients)
    return (torch.zeros_like(color) if on_color is None else on_color), on_depth, on_opacity


def render_for_opacities(back_end: OpacityBackEnd, splats: Splats, settings: RenderSettings) -> Render:
    """The same as `render`, differentiable in the opacities alone; `Render.means2d` takes no gradient."""
    rest, report = list[Rendered](), Backward()
    images = _OfOpacities.apply(back_end, settings, rest, report, splats, splats.opacity_logits)
    return _render(images, rest, report, splats.means.new_zeros(len(splats), 2))


def trains_opacities_alone(splats: Splats, settings: RenderSettings) -> bool:
    """Whether a gradient is wanted of the opacities, and of nothing else."""
    wanted = [name for name, tensor in splats.tensors().items() if tensor.requires_grad]
    return torch.is_grad_enabled() and wanted == ["opacity_logits"] and not settings.pose.requires_grad


def render(back_end: BackEnd, splats: Splats, settings: RenderSettings) -> Render:
    """See `rasterizer.rasterize`. Raises ValueError for a dtype or device that the back end does not take."""
    means2d, rest, report = means2d_leaf(splats, settings), list[Rendered](), Backward()
    images = _Rasterize.apply(back_end, settings, rest, report, means2d, settings.pose, *splats.tensors().values())
    return _render(images, rest, report, means2d)


def render_stepping(back_end: SteppingBackEnd, splats: Splats, settings: RenderSettings, step: SplatStep) -> Render:
    """The same, its backward pass steps the splats, which are contiguous; `Render.means2d` is empty."""
    rest, report = list[Rendered](), Backward()
    images = _Stepped.apply(back_end, settings, rest, report, step, settings.pose, *splats.tensors().values())
    return _render(images, rest, report, splats.means.new_zeros(0, 2))


def _render(images: Images, rest: list[Rendered], report: Backward, means2d: Tensor) -> Render:
    (rendered,) = rest
    return Render(
        *images, rendered.radii > 0, rendered.radii, means2d, rendered.weight_max, rendered.refused, report,
    )  # fmt: skip
