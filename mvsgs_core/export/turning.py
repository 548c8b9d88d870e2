"""Splats in other axes: what file formats that name their axes need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.rasterizer.sh_rotation import sh_rotation
from mvsgs_core.rasterizer.splats import Splats

# (3, 3): from our axes (x right, y down, z forward; "RDF") to those of OpenGL and glTF (x right, y up, z back; "RUB")
RUB_FROM_RDF = np.diag([1.0, -1.0, -1.0])


def turned(splats: Splats, rotation: np.ndarray) -> Splats:
    """The same splats after the world was turned by `rotation` (3, 3): positions, orientations and view-dependent
    colors."""
    turn = geometry.left_multiplication(geometry.quaternion_from_rotation(rotation[None]))[0]
    harmonics = sh_rotation(rotation, splats.sh.shape[1])
    return replace(
        splats,
        means=_times(rotation, splats.means),
        quaternions=_times(turn, splats.quaternions),
        sh=(torch.from_numpy(harmonics) @ splats.sh.to(torch.float64)).to(splats.sh.dtype),
    )


def _times(matrix: np.ndarray, vectors: torch.Tensor) -> torch.Tensor:
    return (vectors.to(torch.float64) @ torch.from_numpy(matrix).T).to(vectors.dtype)
