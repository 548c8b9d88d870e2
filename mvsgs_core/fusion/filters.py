"""Masks of what to reject of a depth map (H, W), 0 unknown, by what surrounds a pixel, (H, W) bool."""

from __future__ import annotations

import cv2
import numpy as np

_STEPS = 5000  # of a filter in int16: per unit of the logarithm of depth, so 1 % is 50


def discontinuity_mask(depth: np.ndarray, radius: int, jump: float = 0.05) -> np.ndarray:
    """True within `radius` pixels of a known depth that is farther by more than `jump`, relative.

    The windows of stereo let a near surface grow over what lies behind it, in all views alike: no other view objects.
    """
    if radius <= 0:
        return np.zeros(depth.shape, dtype=bool)
    unknown = np.finfo(np.float32).max
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-30), unknown).astype(np.float32)
    side = 2 * radius + 1
    farthest = cv2.erode(inverse, np.ones((side, side), np.uint8))
    return np.asarray((depth > 0) & (farthest <= (1.0 - jump) * inverse))


def speckle_mask(depth: np.ndarray, max_pixels: int, relative: float) -> np.ndarray:
    """True in connected patches of up to `max_pixels`; neighboring depths that differ by `relative` are apart."""
    known = depth > 0
    if max_pixels <= 0 or not known.any():
        return np.zeros(depth.shape, dtype=bool)
    logarithm = np.log(np.maximum(depth, 1e-30) / np.median(depth[known]))
    limit = np.iinfo(np.int16)
    steps = np.clip(_STEPS * logarithm, limit.min + 1, limit.max)
    patches = np.where(known, steps, limit.min).astype(np.int16)
    cv2.filterSpeckles(patches, limit.min, max_pixels, int(_STEPS * relative))
    return np.asarray(known & (patches == limit.min))
