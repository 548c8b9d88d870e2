"""L1 and SSIM of a photograph as it came, in bytes, against a render of the map: one kernel, and its twin in PyTorch.

The render shows the map's colors; what the camera makes of them is done in the kernel, and undone for the gradient. In
plain PyTorch that takes eight images of fresh memory an iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mvsgs_core import native
from mvsgs_core.rasterizer.rasterize import exposed
from mvsgs_core.rasterizer.ssim import chosen_backend, image_loss, loss_with_gradient


@dataclass(frozen=True)
class Formation:
    """What a camera makes of the map's colors: image = factor (A color + b), see `mvsgs_core.photometry`."""

    exposure: Tensor | None = None  # (3, 4) [A | b]; None: the identity
    factor: Tensor | None = None  # (H, W, 1) of vignetting; None: none
    valid: Tensor | None = None  # (H, W) bool, False where the photograph says nothing; None: it does everywhere
    clipped: bool = False  # the photograph ends at black and white where the image does not

    def check(self, size: tuple[int, int]) -> None:
        """Raises ValueError where a part is not of an image (H, W)."""
        wanted = {"exposure": (3, 4), "factor": (*size, 1), "valid": size}
        for name, shape in wanted.items():
            part: Tensor | None = getattr(self, name)
            if part is not None and part.shape != shape:
                raise ValueError(f"{name} is {tuple(part.shape)}: expected {shape}")

    def image(self, color: Tensor) -> Tensor:
        """Of the map's colors (H, W, 3), not clipped."""
        image = color if self.exposure is None else exposed(color, self.exposure.to(color.dtype))
        return image if self.factor is None else image * self.factor

    def target(self, photograph: Tensor, image: Tensor) -> Tensor:
        """A photograph (H, W, 3) in [0, 1] as a loss compares an image with it: as the image itself where it says
        nothing, so that neither loss nor gradient comes of it."""
        target = photograph if self.valid is None else torch.where(self.valid[..., None], photograph, image.detach())
        return unclipped(target, image) if self.clipped else target


def unclipped(target: Tensor, color: Tensor) -> Tensor:
    """A photograph (H, W, 3) as a loss compares a render `color` with it: where it is white, or black, and the render
    beyond that, as the render. So a pixel that is cut off pulls in the one direction that it tells of, and no other."""
    color = color.detach()
    return torch.where(color.clamp(0.0, 1.0) == target, color, target)


def photograph_loss(
    color: Tensor, photograph: Tensor, formation: Formation, *, l1_weight: float, ssim_weight: float,
    threads: int | None = None, backend: str = "auto",
) -> Tensor:  # fmt: skip
    """l1_weight mean |image - target| + ssim_weight (1 - SSIM), a scalar; image and target as `Formation` makes them.

    color: (H, W, 3) of the map, to which the gradient goes; photograph: (H, W, 3) uint8. backend: as of `image_loss`;
    "cpu" for "auto" where it can be and no exposure is trained. Raises ValueError if shapes differ or the photograph is
    not of bytes.
    """
    if color.shape != photograph.shape or photograph.dtype != torch.uint8 or color.dim() != 3 or color.shape[2] != 3:
        raise ValueError(
            f"color is {tuple(color.shape)}, photograph {tuple(photograph.shape)} {photograph.dtype}: expected two "
            "(H, W, 3), the photograph uint8"
        )
    formation.check((color.shape[0], color.shape[1]))
    trained = formation.exposure is not None and formation.exposure.requires_grad
    if (chosen_backend(color) if backend == "auto" else backend) == "cpu" and not trained:
        return loss_with_gradient(color, *_fused(color, photograph, formation, l1_weight, ssim_weight, threads or 0))
    image = formation.image(color)
    target = formation.target(photograph.to(color.device, color.dtype) / 255.0, image)
    return image_loss(image, target, l1_weight=l1_weight, ssim_weight=ssim_weight, threads=threads, backend=backend)


def _fused(
    color: Tensor, photograph: Tensor, formation: Formation, l1_weight: float, ssim_weight: float, threads: int
) -> tuple[Tensor, Tensor]:
    gradient = torch.empty(color.shape)
    exposure, factor, valid = formation.exposure, formation.factor, formation.valid
    l1, similarity = native.load("rasterizer").photograph_loss(
        color.detach().contiguous().numpy(),
        photograph.contiguous().numpy(),
        None if exposure is None else exposure.detach().float().contiguous().numpy(),
        None if factor is None else factor.float().contiguous().numpy(),
        None if valid is None else valid.contiguous().numpy(),
        formation.clipped,
        l1_weight,
        ssim_weight,
        gradient.numpy(),
        threads,
    )
    return torch.tensor(l1 + ssim_weight * (1.0 - similarity), dtype=torch.float32), gradient


__all__ = ["Formation", "photograph_loss", "unclipped"]
