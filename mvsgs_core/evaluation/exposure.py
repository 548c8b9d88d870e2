"""Exposure and white balance of frames that were not mapped: between those that the mapper found for its keyframes."""

from __future__ import annotations

import numpy as np

from mvsgs_core.mapping.exposure import IDENTITY


def between_keyframes(timestamps: np.ndarray, keyframes: np.ndarray, affines: np.ndarray) -> np.ndarray | None:
    """Color affines [A | b] (N, 3, 4) float32 at `timestamps` (N,), linear in time; None if no keyframe has one.

    keyframes: (K,) timestamps, ascending; affines: (K, 3, 4). Before the first and after the last keyframe theirs hold.
    Nothing is fitted to a frame that is scored: a camera's exposure drifts, so its neighbors in time tell most of it.
    """
    if not len(affines) or np.allclose(affines, IDENTITY):
        return None
    found = np.empty((len(timestamps), 3, 4), dtype=np.float32)
    for row, column in np.ndindex(3, 4):
        found[:, row, column] = np.interp(timestamps, keyframes, affines[:, row, column])
    return found
