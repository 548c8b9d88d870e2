"""Depth maps of a camera of their own, brought to the color camera's."""

from __future__ import annotations

import numpy as np

from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens, distorted


def register(depth: np.ndarray, source: Lens, target: Lens, baseline: float) -> np.ndarray:
    """Depth map (H, W) float32 as a camera `baseline` to the right of its own sees it, through its lens, at the lens's
    size; the nearest surface wins."""
    (height, width), (fx, fy, cx, cy) = target.size, target.intrinsics
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns]
    own_fx, own_fy, own_cx, own_cy = source.intrinsics
    x, y = (np.arange(depth.shape[1]) - own_cx) / own_fx, (np.arange(depth.shape[0]) - own_cy) / own_fy
    u = fx * (x[columns] - baseline / z.astype(np.float64)) + cx
    v = fy * y[rows] + cy
    if target.distorted and len(z):
        u, v = distorted(target, np.array(target.intrinsics), np.stack([u, v], axis=1)).T
    u, v = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    result = np.full(height * width, np.inf, dtype=np.float32)
    np.minimum.at(result, (v * width + u)[inside], z[inside])
    result[np.isinf(result)] = 0.0
    return result.reshape(height, width)


def size_of_depth(color: tuple[int, int], depth: tuple[int, int]) -> tuple[int, int]:
    """(height, width) to register depth maps of another shape than color images to: the images' shape, and no side
    longer than the depth map's, so that no gaps are left between its pixels."""
    if same_shape(color, depth):
        return depth
    scale = min(depth[0] / color[0], depth[1] / color[1])
    return max(1, round(scale * color[0])), max(1, round(scale * color[1]))
