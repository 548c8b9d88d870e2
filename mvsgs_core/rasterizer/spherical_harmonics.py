"""Real spherical harmonics up to degree 3, in the order and with the signs that 3DGS files have."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Values = TypeVar("Values", Tensor, np.ndarray)

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
    -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def basis(directions: Tensor, degree: int) -> Tensor:
    """((degree + 1)^2 basis values of unit `directions` (N, 3)) -> (N, (degree + 1)^2)."""
    x, y, z = directions.unbind(-1)
    columns = [torch.full_like(x, C0)]
    if degree >= 1:
        columns += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        columns += [
            C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * z * z - x * x - y * y), C2[3] * x * z, C2[4] * (x * x - y * y),
        ]  # fmt: skip
    if degree >= 3:
        columns += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=-1)


def colors(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colors (N, 3) >= 0 of coefficients (N, B, 3) seen along unit `directions` (N, 3): max(0, 1/2 + sum)."""
    count = (degree + 1) ** 2
    return (0.5 + torch.einsum("nb,nbc->nc", basis(directions, degree), sh[:, :count])).clamp(min=0.0)


def from_rgb(rgb: Values) -> Values:
    """The coefficient of degree 0 (..., 3) that gives colors (..., 3), 0 to 1."""
    return (rgb - 0.5) / C0


def to_rgb(coefficient: Values) -> Values:
    """What `from_rgb` undoes."""
    return 0.5 + C0 * coefficient


def degree_of(bases: int) -> int:
    """Degree of a number of coefficients; raises ValueError unless it is 1, 4, 9 or 16."""
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    if bases not in degrees:
        raise ValueError(f"{bases} coefficients: expected 1, 4, 9 or 16")
    return degrees[bases]
