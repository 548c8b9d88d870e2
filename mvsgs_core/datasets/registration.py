"""Depth maps of a camera of their own, brought to the color camera's."""

from __future__ import annotations

import numpy as np

from mvsgs_core.camera import project, unproject
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens, distorted


def register(depth: np.ndarray, source: Lens, target: Lens, baseline: float) -> np.ndarray:
    """Depth map (H, W) float32 as a camera `baseline` to the right of its own sees it, through its lens, at the lens's
    size; the nearest surface wins."""
    height, width = target.size
    v, u = np.nonzero(depth)
    z = depth[v, u]
    points = unproject(depth, np.array(source.intrinsics))[v, u] - (baseline, 0.0, 0.0)
    pixels = project(points, np.array(target.intrinsics))
    if target.distorted and len(pixels):
        pixels = distorted(target, np.array(target.intrinsics), pixels)
    pixels = np.rint(pixels).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < (width, height)), axis=1)
    result = np.full(height * width, np.inf, dtype=np.float32)
    np.minimum.at(result, pixels[inside, 1] * width + pixels[inside, 0], z[inside])
    result[np.isinf(result)] = 0.0
    return result.reshape(height, width)


def size_of_depth(color: tuple[int, int], depth: tuple[int, int]) -> tuple[int, int]:
    """(height, width) to register depth maps of another shape than color images to: the images' shape, and no side
    longer than the depth map's, so that no gaps are left between its pixels."""
    if same_shape(color, depth):
        return depth
    scale = min(depth[0] / color[0], depth[1] / color[1])
    return max(1, round(scale * color[0])), max(1, round(scale * color[1]))
