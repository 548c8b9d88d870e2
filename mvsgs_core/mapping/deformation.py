"""Splats move with their anchor keyframe when its pose or scale is corrected, and their Adam moments with them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import geometry
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.sh_rotation import sh_rotation

CHUNK = 16384  # splats that are moved at once: matrices in float64 for each take three times what the map keeps of it


@torch.no_grad()
def move_with_anchors(state: MapState, similarities: dict[int, geometry.Similarity]) -> int:
    """Moves all splats whose anchor is a key; returns their number.

    Positions, standard deviations, orientations and spherical harmonics follow. The moments follow the change of
    variables instead of being zeroed, so that the next step goes on in the direction it was going, in the new frame: a
    gradient transforms by R / s, the mean with it; the mean of squares by the squares of those coefficients, exact for
    gradients with uncorrelated components (a rotated diagonal covariance, of which the diagonal is kept).
    """
    if not similarities or len(state) == 0:
        return 0
    keys = sorted(similarities)
    ordered = [similarities[key] for key in keys]
    lookup = torch.tensor(keys, dtype=torch.int64, device=state.device)
    position = torch.searchsorted(lookup, state.anchors).clamp(max=len(keys) - 1)
    chosen = torch.nonzero(lookup[position] == state.anchors)[:, 0]
    for some in chosen.split(CHUNK):
        _move(state, some, position[some], ordered)
    return len(chosen)


def _move(state: MapState, chosen: Tensor, which: Tensor, ordered: list[geometry.Similarity]) -> None:
    """Moves the splats `chosen` (M,), in place, each by the similarity `which` (M,) of `ordered`."""
    rotations = np.stack([s.rotation for s in ordered])
    scale = _rows([s.scale for s in ordered], which)
    rotation = _rows(rotations, which)
    translation = _rows([s.translation for s in ordered], which)
    turn = _rows(geometry.left_multiplication(geometry.quaternion_from_rotation(rotations)), which)

    splats = state.detached()
    means = splats.means[chosen].to(torch.float64)
    splats.means[chosen] = (scale[:, None] * _apply(rotation, means) + translation).to(torch.float32)
    splats.log_scales[chosen] += scale.log().to(torch.float32)[:, None]
    splats.quaternions[chosen] = _apply(turn, splats.quaternions[chosen].to(torch.float64)).to(torch.float32)

    jacobian = rotation / scale[:, None, None]
    _move_moments(state, "means", chosen, jacobian)
    _move_moments(state, "quaternions", chosen, turn)
    if splats.sh.shape[1] > 1:
        harmonics = _rows([sh_rotation(r, splats.sh.shape[1]) for r in rotations], which)
        splats.sh[chosen] = (harmonics @ splats.sh[chosen].to(torch.float64)).to(torch.float32)
        first, second = state.first["sh"], state.second["sh"]
        first[chosen] = (harmonics @ first[chosen].to(torch.float64)).to(torch.float32)
        second[chosen] = (harmonics.square() @ second[chosen].to(torch.float64)).to(torch.float32)


def _move_moments(state: MapState, name: str, chosen: Tensor, jacobian: Tensor) -> None:
    first, second = state.first[name], state.second[name]
    first[chosen] = _apply(jacobian, first[chosen].to(torch.float64)).to(torch.float32)
    second[chosen] = _apply(jacobian.square(), second[chosen].to(torch.float64)).to(torch.float32)


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]


def _rows(values: object, which: Tensor) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64), device=which.device)[which]
