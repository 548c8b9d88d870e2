"""Confidence of a fused depth as a calibrated probability that it is an inlier (within 5 % of the truth)."""

from __future__ import annotations

import numpy as np

from mvsgs_core.fusion.backend import Fused

# Logistic regression on `features`.
WEIGHTS = np.array([-2.0, 3.0, 1.5, -1.5, 0.5])


def features(fused: Fused, consistent: np.ndarray) -> np.ndarray:
    """(F, H, W) float32, the first all ones."""
    return np.stack(
        [np.ones_like(fused.own), fused.own, np.sqrt(fused.support), fused.violation, consistent.astype(np.float32)]
    ).astype(np.float32)


def probability_of_inlier(fused: Fused, consistent: np.ndarray) -> np.ndarray:
    """(H, W) float32 in [0, 1], 0 where there is no depth. `consistent` (H, W): neighbors that agree."""
    logit = np.tensordot(WEIGHTS.astype(np.float32), features(fused, consistent), axes=1)
    probability = 1.0 / (1.0 + np.exp(-logit))
    return np.where(fused.depth > 0, probability, 0.0).astype(np.float32)
