"""Exposure and white balance of every frame: the tracker's, in the gauge of the map.

Nothing is fitted to a frame that is scored: the tracker's exposure comes from the frame's matches to keyframes. What a
map has for its keyframes beside the tracker's, the gauge and what was trained, is interpolated in time, as
`trajectory.along` has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mvsgs_core.photometry import IDENTITY, compose, inverse
from mvsgs_core.trajectory import along


@dataclass(frozen=True)
class FrameExposures:
    """Color affines of N frames, from the map's colors to the photographs'."""

    affines: np.ndarray  # (N, 3, 4) float32


def frame_exposures(
    timestamps: np.ndarray, measured: np.ndarray | None, rows: np.ndarray, affines: np.ndarray
) -> FrameExposures | None:
    """Of frames at `timestamps` (N,); None where the map was made without any.

    measured: (N, 3, 4) the tracker's, NaN where not known (then interpolated in time from those that are); None: it
    has none. rows: (K,) the keyframes among the frames, ascending; affines: (K, 3, 4) the map's of those. Before the
    first and after the last one theirs holds. Where no frame is a keyframe, as in a map that another stream made, the
    tracker's hold.
    """
    known = np.zeros(len(timestamps), bool) if measured is None else np.isfinite(measured).all(axis=(1, 2))
    if np.array_equal(affines, np.broadcast_to(IDENTITY, affines.shape)) and (len(rows) or not known.any()):
        return None
    times = along(timestamps)
    tracked = np.tile(IDENTITY.astype(np.float64), (len(timestamps), 1, 1))
    if measured is not None and known.any():
        tracked = _interpolated(times, times[known], measured[known])
    if not len(rows):
        return FrameExposures(tracked.astype(np.float32))
    remainders = compose(inverse(tracked[rows]), affines)
    found = compose(tracked, _interpolated(times, times[rows], remainders))
    return FrameExposures(found.astype(np.float32))


def gains(affines: np.ndarray) -> np.ndarray:
    """(N, 3) of red, green and blue: by how much affines (N, 3, 4) brighten gray."""
    return np.asarray(affines[:, :, :3].sum(axis=2))


def summary(
    keyframes: np.ndarray, affines: np.ndarray, found: FrameExposures | None, vignetting: np.ndarray | None
) -> dict[str, Any] | None:
    """For report.json, of the keyframes `keyframes` (K,) and the map's affines (K, 3, 4) of them; None: nothing known.

    `gain`: of red, green and blue for each keyframe.
    """
    if found is None and vignetting is None:
        return None
    return {
        "keyframes": keyframes.tolist(),
        "gain": gains(affines).tolist(),
        "vignetting": None if vignetting is None else vignetting.tolist(),
    }


def _interpolated(times: np.ndarray, known: np.ndarray, affines: np.ndarray) -> np.ndarray:
    """(N, 3, 4) float64 at `times` (N,), linear between the affines (M, 3, 4) of `known` (M,), ascending."""
    found = np.empty((len(times), 3, 4))
    for row, column in np.ndindex(3, 4):
        found[:, row, column] = np.interp(times, known, affines[:, row, column])
    return found
