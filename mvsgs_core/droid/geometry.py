"""Where the cells of one keyframe's 1/8 map fall in another's, and what follows from it (DROID-SLAM, section 3.2).

Intrinsics (fx, fy, cx, cy) are in cells; poses are cam_from_world (4, 4). Tensors keep their dtype and device.
"""

from __future__ import annotations

import torch
from torch import Tensor

_NEAR = 0.2  # scaled depth in the target below which a reprojection is not valid
_NEAR_DISTANCE = 0.25  # the same for the distance of two frames


def cells(h: int, w: int, like: Tensor) -> Tensor:
    """(h, w, 2) coordinates (u, v)."""
    v, u = torch.meshgrid(
        torch.arange(h, device=like.device, dtype=like.dtype),
        torch.arange(w, device=like.device, dtype=like.dtype),
        indexing="ij",
    )
    return torch.stack([u, v], dim=-1)


def _rays(h: int, w: int, intrinsics: Tensor) -> Tensor:
    """(h, w, 3) with z = 1."""
    uv = (cells(h, w, intrinsics) - intrinsics[2:]) / intrinsics[:2]
    return torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)


def _move(relative: Tensor, inverse_depth: Tensor, intrinsics: Tensor) -> Tensor:
    """R [x, y, 1] + d t, (E, h, w, 3): the points of E maps, divided by their depth, in another camera."""
    rays = _rays(inverse_depth.shape[-2], inverse_depth.shape[-1], intrinsics)
    turned = torch.einsum("eab,hwb->ehwa", relative[:, :3, :3], rays)
    return turned + inverse_depth[..., None] * relative[:, None, None, :3, 3]


def reproject(relative: Tensor, inverse_depth: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates (E, h, w, 2) of the cells of E maps in other cameras, and where they are valid (E, h, w) bool.

    relative: (E, 4, 4) target_from_source; inverse_depth: (E, h, w) of the sources. A point that is hardly before the
    target or behind it is divided by 1 instead of its depth.
    """
    points = _move(relative, inverse_depth, intrinsics)
    z = points[..., 2]
    safe = torch.where(z < 0.5 * _NEAR, torch.ones_like(z), z)
    return points[..., :2] / safe[..., None] * intrinsics[:2] + intrinsics[2:], z > _NEAR


def _pixels_moved(points: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Length of the flow of each cell (E, h, w), 0 where too near, and where it counts."""
    valid = points[..., 2] > _NEAR_DISTANCE
    z = torch.where(valid, points[..., 2], torch.ones_like(points[..., 2]))
    target = points[..., :2] / z[..., None] * intrinsics[:2] + intrinsics[2:]
    length = (target - cells(points.shape[1], points.shape[2], intrinsics)).norm(dim=-1)
    return torch.where(valid, length, torch.zeros_like(length)), valid


def frame_distance(relative: Tensor, inverse_depth: Tensor, intrinsics: Tensor, beta: float) -> Tensor:
    """(E,) mean of beta |flow| + (1 - beta) |flow by translation alone|, in cells, in one direction.

    1000 where less than 75 % of the flows are of points before the target.
    """
    h, w = inverse_depth.shape[-2:]
    still = relative.clone()
    still[:, :3, :3] = torch.eye(3, dtype=relative.dtype, device=relative.device)
    full, full_valid = _pixels_moved(_move(relative, inverse_depth, intrinsics), intrinsics)
    shift, shift_valid = _pixels_moved(_move(still, inverse_depth, intrinsics), intrinsics)
    total = (beta * full + (1 - beta) * shift).sum(dim=(1, 2))
    weight = (beta * full_valid + (1 - beta) * shift_valid).sum(dim=(1, 2))
    far = weight / (h * w) < 0.75
    return torch.where(far, torch.full_like(total, 1000.0), total / weight.clamp(min=1e-9))


def agreeing_neighbors(
    relative: Tensor, inverse_depth: Tensor, others: Tensor, intrinsics: Tensor, tolerance: float
) -> Tensor:
    """(h, w) how many of N other maps (N, h, w) have, at one of the four cells around where a cell falls, its depth.

    relative: (N, 4, 4) other_from_reference; inverse_depth: (h, w) of the reference; tolerance in the unit of depth.
    """
    h, w = inverse_depth.shape
    points = _move(relative, inverse_depth[None].expand(len(relative), h, w), intrinsics)
    z = points[..., 2]
    z = torch.where(z > 0, z, torch.ones_like(z))
    left, top = (points[..., :2] / z[..., None] * intrinsics[:2] + intrinsics[2:]).floor().unbind(dim=-1)
    inside = (points[..., 2] > 0) & (left >= 0) & (top >= 0) & (left < w - 1) & (top < h - 1)
    at = torch.where(inside, top * w + left, torch.zeros_like(top)).long().flatten(1)
    depth = z / inverse_depth
    agrees = torch.zeros_like(inside)
    for step in (0, 1, w, w + 1):
        found = others.flatten(1).gather(1, at + step).view_as(depth)
        agrees |= (depth - 1.0 / found).abs() < tolerance
    return (inside & agrees).sum(dim=0)


__all__ = ["agreeing_neighbors", "cells", "frame_distance", "reproject"]
