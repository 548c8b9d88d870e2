"""The map's splats: plain tensors side by side, as the rasterizers and the optimizer read them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass
class Splats:
    """N splats in the map's frame; every field has the same N, dtype (float32, or float64 for checks) and device."""

    means: Tensor  # (N, 3), map units
    log_scales: Tensor  # (N, 3), log of the standard deviations along the axes, map units
    quaternions: Tensor  # (N, 4), w first, any length but 0: normalized where they are used
    opacity_logits: Tensor  # (N,), opacity = sigmoid of it
    sh: Tensor  # (N, B, 3), B = 1, 4, 9 or 16 spherical-harmonics coefficients per channel
    betas: Tensor  # (N,), exponent for "exact" (2 = Gaussian), raw b for "ges_scale" (0 = neutral), else ignored

    def __len__(self) -> int:
        return len(self.means)

    def tensors(self) -> dict[str, Tensor]:
        """The fields by name, in the order of declaration."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def check(self) -> None:
        """Raises ValueError, naming the field, if shapes, dtypes or devices do not fit together."""
        n = len(self.means)
        bases = self.sh.shape[1] if self.sh.dim() == 3 else 0
        if bases not in (1, 4, 9, 16):
            raise ValueError(f"sh is {tuple(self.sh.shape)}: expected (N, B, 3) with B = 1, 4, 9 or 16")
        shapes = {
            "means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,),
            "sh": (n, bases, 3), "betas": (n,),
        }  # fmt: skip
        for name, tensor in self.tensors().items():
            if tuple(tensor.shape) != shapes[name]:
                raise ValueError(f"{name} is {tuple(tensor.shape)}: expected {shapes[name]}")
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise ValueError(
                    f"{name} is {tensor.dtype} on {tensor.device}, means are {self.means.dtype} on {self.means.device}"
                )

    @staticmethod
    def empty(bases: int = 1, dtype: torch.dtype = torch.float32) -> Splats:
        """No splats."""
        shapes = [(0, 3), (0, 3), (0, 4), (0,), (0, bases, 3), (0,)]
        return Splats(*(torch.zeros(shape, dtype=dtype) for shape in shapes))


FIELDS = tuple(field.name for field in fields(Splats))
