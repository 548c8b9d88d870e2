"""Surface normals of a depth map: a plane's inverse depth is linear in the pixel, so its gradient gives the normal."""

from __future__ import annotations

import cv2
import numpy as np


def normals_of(depth: np.ndarray, intrinsics: np.ndarray, radius: int = 2, max_jump: float = 0.05) -> np.ndarray:
    """(H, W, 3) float32 unit normals in the camera frame, toward the camera; 0 where depth (H, W) is 0.

    For n·X = d in front of the camera, 1 / z = a u + b v + c with (a, b, c) = K⁻ᵀ n / d. Differences across a relative
    jump of depth above `max_jump` are left out; the rest is averaged over (2 radius + 1)² pixels. A pixel without
    any usable difference faces the camera.
    """
    known = depth > 0
    inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0).astype(np.float32)
    slope_u = _mean_difference(inverse, known, 1, radius, max_jump)
    slope_v = _mean_difference(inverse, known, 0, radius, max_jump)
    u, v = np.arange(depth.shape[1]), np.arange(depth.shape[0])[:, None]
    fx, fy, cx, cy = (float(k) for k in intrinsics)
    x, y, z = fx * slope_u, fy * slope_v, inverse - slope_u * (u - cx) - slope_v * (v - cy)
    length = np.sqrt(x * x + y * y + z * z)
    factor = np.where(known, -1.0, 0.0) / np.maximum(length, 1e-12)  # n·X = d > 0 points away from the camera
    return cv2.merge([(part * factor).astype(np.float32) for part in (x, y, z)])


def _mean_difference(inverse: np.ndarray, known: np.ndarray, axis: int, radius: int, max_jump: float) -> np.ndarray:
    """(H, W) float64: mean, over the window, of the differences between neighboring pixels along `axis`."""
    here = (slice(None), slice(None, -1)) if axis == 1 else (slice(None, -1), slice(None))
    there = (slice(None), slice(1, None)) if axis == 1 else (slice(1, None), slice(None))
    difference = np.zeros(inverse.shape, np.float32)
    usable = np.zeros(inverse.shape, np.float32)
    step = inverse[there] - inverse[here]
    good = known[there] & known[here]
    good &= np.abs(step) < np.float32(max_jump) * np.maximum(inverse[there], inverse[here])
    difference[here] = step * good
    usable[here] = good
    window = (2 * radius + 1, 2 * radius + 1)
    total = cv2.boxFilter(difference, cv2.CV_64F, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(usable, cv2.CV_32F, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(total / np.maximum(count, 1.0))
