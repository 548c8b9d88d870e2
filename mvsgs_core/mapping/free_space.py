"""Splats in the air: those that lie before the surface that most of the keyframes see there.

What only a few images see may be shown as well by a splat near the camera as by the surface itself, and where depth is
doubtful splats begin there. The images that they were trained on do not tell; the filtered depth of the others does.
A keyframe votes against a splat that it would see before all that it sees around there, and for one that is where it
sees something. It says nothing of one behind that, nor where less than half of its depth is known.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import torch
from torch import Tensor

from mvsgs_core.mapping.keyframes import CELLS, HALF_MAX, TrainingView

KNOWN = 0.5  # of a cell's pixels, and of its neighbors': with fewer it votes against nothing
THERE = 0.5  # of the distance by which a splat in the air is off: as near as that it is where the surface is


def surface_of(depth: np.ndarray) -> np.ndarray:
    """(3, CELLS, CELLS) float16: the least and the greatest of the depths known in each cell of a grid over the image,
    0 where none is, and the share of its pixels that is known. depth: (h, w), 0 where unknown."""
    rows, columns = (np.minimum(-(-np.arange(CELLS) * size // CELLS), size - 1) for size in depth.shape)

    def reduced(values: np.ndarray, by: np.ufunc) -> np.ndarray:
        return np.asarray(by.reduceat(by.reduceat(values, rows, axis=0), columns, axis=1))

    known = depth > 0
    nearest = reduced(np.where(known, depth, np.inf), np.minimum)
    farthest, share = reduced(depth, np.maximum), reduced(known.astype(np.float32), np.add)
    share /= reduced(np.ones(depth.shape, np.float32), np.add)
    found = np.stack([np.where(np.isfinite(nearest), nearest, 0.0), farthest, share])
    return np.asarray(np.minimum(found, HALF_MAX), np.float16)


@torch.no_grad()
def in_the_air(means: Tensor, views: Iterable[TrainingView], margin: float) -> Tensor:
    """(N,) bool: splats at `means` (N, 3) that more keyframes see before all that is there than see at a surface.

    margin: of the depth, by which it is before.
    """
    votes = torch.zeros(len(means), dtype=torch.int32, device=means.device)
    for view in views:
        if view.surface is not None and view.surface[2].any():
            votes += _votes(means, view, margin)
    return votes > 0


def _votes(means: Tensor, view: TrainingView, margin: float) -> Tensor:
    """(N,) int32: 1 against a splat, -1 for it, 0 where the keyframe does not tell."""
    assert view.surface is not None
    nearest, farthest, share = view.surface.astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    sure = cv2.erode((share >= KNOWN).astype(np.uint8), around) > 0
    before = np.where(sure, cv2.erode(np.where(share > 0, nearest, np.inf).astype(np.float32), around), 0.0)
    device = means.device
    pose = torch.from_numpy(np.linalg.inv(view.refined_from_cam)).to(device, means.dtype)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    (height, width), (fx, fy, cx, cy) = view.image_size, view.image_intrinsics.tolist()
    ahead = z > 0
    depth = torch.where(ahead, z, 1.0)
    column, row = (
        ((f * at / depth + c + 0.5) * (CELLS / size)).floor()
        for f, at, c, size in ((fx, x, cx, width), (fy, y, cy, height))
    )
    inside = ahead & (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    cell = torch.where(inside, row * CELLS + column, 0.0).to(torch.int64)
    limits = torch.from_numpy(np.stack([before, nearest, farthest]).astype(np.float32).reshape(3, -1)).to(device)
    before_all, near, far = limits[:, cell]
    against = inside & (z < (1.0 - margin) * before_all)
    there = inside & (z > (1.0 - THERE * margin) * near) & (z < (1.0 + THERE * margin) * far)
    return against.to(torch.int32) - there.to(torch.int32)


__all__ = ["in_the_air", "surface_of"]
