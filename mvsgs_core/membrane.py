"""A map continued from where it is known: a smooth sheet through those pixels that may bend at edges of an image."""

from __future__ import annotations

import cv2
import numpy as np


def membrane(values: np.ndarray, weight: np.ndarray, guide: np.ndarray, stiffness: float, edge: float) -> np.ndarray:
    """(H, W) float32: a weighted least-squares smoother of `values` (H, W), by `weight` (H, W) >= 0.

    guide: (H, W) or (H, W, 3) uint8; a step of `edge` gray levels in it loosens the sheet. Far from any weight the
    nearest known values go on; where the weight is 0 everywhere, so is the result.
    """
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, stiffness, edge)
    weight = np.ascontiguousarray(weight, dtype=np.float32)
    total = smoother.filter(weight)
    mixed = smoother.filter(weight * values.astype(np.float32))
    return np.asarray(mixed / np.maximum(total, 1e-30), dtype=np.float32)
