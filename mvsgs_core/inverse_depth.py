"""The tracker's coarse depth as a depth map: linear between known cells, nothing where none is near."""

from __future__ import annotations

import cv2
import numpy as np


def enlarge_inverse_depth(
    inverse_depth: np.ndarray, weight: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and confidence, (H, W) float32 each, of a grid (h, w) with weights; 0 where less than half is known.

    Weighted linear interpolation: an unknown cell takes no part.
    """
    known = np.isfinite(inverse_depth) & (inverse_depth > 0)
    part = np.where(known, np.clip(weight, 0.0, 1.0), 0.0).astype(np.float32)
    values = np.where(known, inverse_depth, 0.0).astype(np.float32)
    order = (size[1], size[0])
    total = cv2.resize(part, order, interpolation=cv2.INTER_LINEAR)
    mixed = cv2.resize(part * values, order, interpolation=cv2.INTER_LINEAR)
    near = cv2.resize(known.astype(np.float32), order, interpolation=cv2.INTER_LINEAR) >= 0.5
    good = near & (total > 1e-6) & (mixed > 0)
    depth = np.where(good, total / np.where(good, mixed, 1.0), 0.0).astype(np.float32)
    return depth, np.where(good, np.minimum(total, 1.0), 0.0).astype(np.float32)
