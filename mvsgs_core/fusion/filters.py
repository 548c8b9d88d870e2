"""Masks of what to reject of a depth map (H, W), 0 unknown, by what surrounds a pixel, (H, W) bool."""

from __future__ import annotations

import cv2
import numpy as np

_STEPS = 5000  # of a filter in int16: per unit of the logarithm of depth, so 1 % is 50


def discontinuity_mask(depth: np.ndarray, radius: int, jump: float = 0.05) -> np.ndarray:
    """True within `radius` pixels of a depth that is farther by more than `jump`, relative, than a slope makes it.

    The windows of stereo let a near surface grow over what lies behind it, in all views alike: no other view objects.
    A plane's inverse depth is linear in the pixel: what falls on one side as it rises on the other is a slope, such as
    a road, whose depth changes by more than `jump` over a few pixels. Where the other side is unknown, any fall counts.
    """
    if radius <= 0:
        return np.zeros(depth.shape, dtype=bool)
    unknown = np.finfo(np.float32).max
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-30), unknown).astype(np.float32)
    side = 2 * radius + 1
    farthest = cv2.erode(inverse, np.ones((side, side), np.uint8))
    mask = np.asarray((depth > 0) & (farthest <= (1.0 - jump) * inverse))
    rows, columns = np.nonzero(mask)
    mask[rows, columns] = _falls_at(inverse, rows, columns, radius, jump)
    return mask


def _falls_at(inverse: np.ndarray, rows: np.ndarray, columns: np.ndarray, radius: int, jump: float) -> np.ndarray:
    """(K,) bool: whether an inverse depth (H, W), huge where unknown, falls by `jump` around pixels, slope aside."""
    unknown = np.finfo(np.float32).max
    here, padded = inverse[rows, columns], np.pad(inverse, radius, constant_values=unknown)
    width, side = padded.shape[1], 2 * radius + 1
    middle = (rows + radius) * width + columns + radius
    around = padded.ravel()
    limit = here - jump * here
    falls = np.zeros(len(rows), dtype=bool)
    for k in range(side * side // 2):  # a place around the pixel and the one opposite to it
        step = (k // side - radius) * width + k % side - radius
        one, other = around[middle + step], around[middle - step]
        for there, opposite in ((one, other), (other, one)):
            slope = np.where(opposite < unknown, np.maximum(opposite - here, 0), 0)
            falls |= there <= limit - slope
    return falls


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
