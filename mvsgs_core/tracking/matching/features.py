"""Feature matching for what a local search can't find: large motion, old keyframes, a lost camera."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core import native
from mvsgs_core.tracking.image import TrackingImage

FARTHEST = 64  # bits of 256 from which on two descriptors are no match
RATIO = 0.85  # of the distance to the second best match, that of the best is less than this


def match_descriptors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) int64 of mutual best matches of two sets (N, 32) of binary descriptors that pass the ratio test.

    None where a set has fewer than two: nothing tells then whether the best is better than another.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    return np.asarray(native.load("tracking").match_binary(a, b, FARTHEST, RATIO))


def match_features(a: TrackingImage, b: TrackingImage, threshold: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Matched points, (N, 2) in `a` and in `b`, that agree with one fundamental matrix (MAGSAC, Barath 2020).

    threshold: pixels from the epipolar line. Empty where fewer than 15 agree.
    """
    points_a, descriptors_a = a.features()
    points_b, descriptors_b = b.features()
    pairs = match_descriptors(descriptors_a, descriptors_b)
    none = np.zeros((0, 2), np.float64)
    if len(pairs) < 15:
        return none, none
    from_a, in_b = points_a[pairs[:, 0]], points_b[pairs[:, 1]]
    cv2.setRNGSeed(0)
    try:
        matrix, mask = cv2.findFundamentalMat(from_a, in_b, cv2.USAC_MAGSAC, threshold, 0.999, 2000)
    except cv2.error:  # OpenCV throws where it finds no model at all, as between images with hardly any texture
        return none, none
    if matrix is None or mask is None or int(mask.sum()) < 15:
        return none, none
    keep = mask.ravel() > 0
    return from_a[keep].astype(np.float64), in_b[keep].astype(np.float64)


__all__ = ["match_descriptors", "match_features"]
