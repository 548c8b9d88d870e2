"""Confidence of a fused depth as a calibrated probability that it is an inlier (within 5 % of the truth)."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.fusion.interface import Fused

# Logistic regression on `features_of`, by `python -m bench.depth.calibration`, which is given .7, the map's mean's.
WEIGHTS = np.array([-1.332, 1.117, 1.636, -0.918, -0.127, -0.331, 1.004, -0.187, -0.538, -0.149, 0.7, 0.726, -0.416])

_LOCATED = 1.0  # pixels to which the neighbors together locate a point
_DOUBTS = (0.005, 0.2)  # relative depth: a doubt below the first and above the second is told from no other


def uncertainty_of(parallax: np.ndarray) -> np.ndarray:
    """Relative uncertainty of depth (H, W) float32 from a back end's `parallax`, huge where that is 0."""
    return np.asarray(_LOCATED / np.maximum(parallax, 1e-6), dtype=np.float32)


def features_of(
    fused: Fused, confidence: np.ndarray, consistent: np.ndarray, seeing: np.ndarray, doubt: np.ndarray
) -> np.ndarray:
    """(F, H, W) float32, the first all ones.

    From stereo's confidence, the number of neighbors that agree, and of those that have a depth there at all, each
    (H, W): that few agree where few look, at the image's border or behind an edge, doesn't speak against a depth.
    The mean of the whole map speaks for its pose and its range: where these are wrong, little matches anywhere.
    From `uncertainty_of` (H, W) too: where parallax is small, what agrees says less.
    """
    around = cv2.blur(confidence, (9, 9))  # errors come in patches
    agreeing = cv2.blur((consistent >= 2).astype(np.float32), (5, 5))
    # Windows make a near surface grow over what lies behind it: its edge, close to something farther, is doubtful.
    inverse = np.where(fused.depth > 0, 1.0 / np.maximum(fused.depth, 1e-9), 0.0).astype(np.float32)
    kernel = np.ones((7, 7), np.uint8)
    before = np.clip(1.0 - cv2.erode(inverse, kernel) / np.maximum(inverse, 1e-9), 0.0, 0.25)
    behind = np.clip(cv2.dilate(inverse, kernel) / np.maximum(inverse, 1e-9) - 1.0, 0.0, 0.25)
    return np.stack(
        [
            np.ones_like(fused.own),
            fused.own,
            np.sqrt(fused.support),
            fused.violation,
            consistent.astype(np.float32),
            np.maximum(seeing.astype(np.float32) - consistent, 0.0),
            around,
            agreeing,
            4.0 * before,
            4.0 * behind,
            np.full_like(confidence, confidence.mean()),
            cv2.erode(confidence, np.ones((5, 5), np.uint8)),
            np.log(np.clip(doubt, *_DOUBTS) / 0.02),
        ]
    ).astype(np.float32)


def probability_of_inlier(features: np.ndarray) -> np.ndarray:
    """(H, W) float32 in [0, 1] from `features_of`."""
    logit = np.tensordot(WEIGHTS.astype(np.float32), features, axes=1)
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), dtype=np.float32)
