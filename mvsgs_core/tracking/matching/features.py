"""Feature matching for what a local search can't find: large motion, old keyframes, a lost camera."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.tracking.image import TrackingImage


def match_descriptors(a: np.ndarray, b: np.ndarray, ratio: float = 0.85) -> np.ndarray:
    """Pairs (N, 2) int of mutual best matches of two sets of binary descriptors that pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = [
        (best.queryIdx, best.trainIdx)
        for best, second in (pair for pair in matcher.knnMatch(a, b, k=2) if len(pair) == 2)
        if best.distance < 64 and best.distance < ratio * second.distance
    ]
    if not forward:
        return np.zeros((0, 2), np.int64)
    asked = np.unique([there for _, there in forward])  # the way back only of those that a pair ends at
    back = {int(asked[m.queryIdx]): m.trainIdx for m in matcher.match(b[asked], a)}
    return np.array([pair for pair in forward if back[pair[1]] == pair[0]], np.int64).reshape(-1, 2)


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
