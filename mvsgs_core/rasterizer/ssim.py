"""SSIM (Wang et al. 2004) of images with channels last: fused kernels in C++ and Triton, and their twin in PyTorch.

11x11 Gaussian window of sigma 1.5, separable, zeros beyond the border, C1 = 0.01^2, C2 = 0.03^2, mean over pixels and
channels: the form that 3DGS trains with.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvsgs_core import native
from mvsgs_core.rasterizer.ssim_window import C1, C2, RADIUS, SIGMA


def ssim_reference(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM of images (H, W, C) in plain PyTorch; differentiable in both."""
    x, y = image.permute(2, 0, 1)[:, None], target.to(image).permute(2, 0, 1)[:, None]
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = window / window.sum()

    def blur(values: Tensor) -> Tensor:
        rows = torch.nn.functional.conv2d(values, window.view(1, 1, -1, 1), padding=(RADIUS, 0))
        return torch.nn.functional.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, RADIUS))

    a, b = blur(x), blur(y)
    variance_x, variance_y, covariance = blur(x * x) - a * a, blur(y * y) - b * b, blur(x * y) - a * b
    top = (2 * a * b + C1) * (2 * covariance + C2)
    return (top / ((a * a + b * b + C1) * (variance_x + variance_y + C2))).mean()


class _ImageLoss(torch.autograd.Function):
    """A loss whose gradient by the image was made with it."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, loss: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_loss: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        if on_loss.device.type == "cpu" and float(on_loss) == 1.0:  # most often it is the loss itself
            return gradient, None, None
        return gradient * on_loss, None, None


def loss_with_gradient(image: Tensor, loss: Tensor, gradient: Tensor) -> Tensor:
    """The loss, a scalar, whose gradient by `image` is `gradient`."""
    joined: Tensor = _ImageLoss.apply(image, loss, gradient)
    return joined


def chosen_backend(image: Tensor) -> str:
    """For float32 with three channels "cpu" (C++) or on a GPU "triton"; "reference" (PyTorch) for anything else."""
    if image.dtype != torch.float32 or image.shape[-1] != 3:
        return "reference"
    return {"cpu": "cpu", "cuda": "triton"}.get(image.device.type, "reference")


def image_loss(
    image: Tensor,
    target: Tensor,
    *,
    l1_weight: float,
    ssim_weight: float,
    pixel_weight: Tensor | None = None,
    threads: int | None = None,
    backend: str = "auto",
) -> Tensor:
    """mean((l1_weight + pixel_weight) |image - target|) + ssim_weight (1 - SSIM), a scalar.

    image, target: (H, W, 3); the gradient goes to `image` only. pixel_weight: (H, W), carries no gradient.
    backend: "cpu", "triton", "reference" or "auto", see `chosen_backend`. Raises ValueError if shapes differ or the
    back end has no such name, ImportError if a GPU is asked for without triton.
    """
    if image.shape != target.shape or image.dim() != 3 or image.shape[2] != 3:
        raise ValueError(f"image is {tuple(image.shape)}, target {tuple(target.shape)}: expected two (H, W, 3)")
    if pixel_weight is not None and pixel_weight.shape != image.shape[:2]:
        raise ValueError(f"pixel_weight is {tuple(pixel_weight.shape)}: expected {tuple(image.shape[:2])}")
    weight = None if pixel_weight is None else pixel_weight.detach().to(image.dtype).contiguous()
    chosen = chosen_backend(image) if backend == "auto" else backend
    if chosen in ("cpu", "triton"):
        x, y = image.detach().contiguous(), target.detach().float().contiguous()
        if chosen == "cpu":
            made = _cpu_loss(x, y, weight, l1_weight, ssim_weight, threads or 0)
        else:
            from mvsgs_core.rasterizer.triton import ssim as triton_ssim

            made = triton_ssim.loss_with_gradient(x, y, weight, l1_weight, ssim_weight)
        return loss_with_gradient(image, *made)
    if chosen != "reference":
        raise ValueError(f"backend {backend!r}: choose one of auto, cpu, triton, reference")
    target = target.detach().to(image)
    difference = (image - target).abs()
    weighted = l1_weight * difference.mean()
    if weight is not None:
        weighted = weighted + (weight[..., None] * difference).mean()
    return weighted + ssim_weight * (1.0 - ssim_reference(image, target))


def _cpu_loss(
    image: Tensor, target: Tensor, weight: Tensor | None, l1_weight: float, ssim_weight: float, threads: int
) -> tuple[Tensor, Tensor]:
    gradient = torch.empty(image.shape)
    l1, similarity = native.load("rasterizer").image_loss(
        image.numpy(), target.numpy(), None if weight is None else weight.numpy(), l1_weight, ssim_weight,
        gradient.numpy(), threads,
    )  # fmt: skip
    return torch.tensor(l1 + ssim_weight * (1.0 - similarity), dtype=torch.float32), gradient


def ssim(image: Tensor, target: Tensor, threads: int | None = None) -> Tensor:
    """Mean SSIM of images (H, W, 3); the gradient goes to `image` only."""
    return 1.0 - image_loss(image, target, l1_weight=0.0, ssim_weight=1.0, threads=threads)
