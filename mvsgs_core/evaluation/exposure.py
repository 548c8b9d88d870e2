"""Exposure and white balance of every frame: the tracker's, in the gauge of the map.

Nothing is fitted to a frame that is scored: the tracker's exposure comes from the frame's matches to keyframes. What a
map has for its keyframes beside the tracker's, the gauge and what was trained, is interpolated in time, as
`trajectory.along` has it; photographs in any order have what the nearest one in space has.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mvsgs_core.photometry import IDENTITY, compose, inverse
from mvsgs_core.trajectory import along, nearest


def frame_exposures(
    timestamps: np.ndarray, measured: np.ndarray | None, rows: np.ndarray, affines: np.ndarray,
    centers: np.ndarray | None = None,
) -> np.ndarray | None:  # fmt: skip
    """(N, 3, 4) float32 color affines from the map's colors to the photographs' of frames at `timestamps` (N,); None
    where the map was made without any.

    measured: (N, 3, 4) the tracker's, NaN where not known (then interpolated in time from those that are); None: it
    has none. rows: (K,) the keyframes among the frames, ascending; affines: (K, 3, 4) the map's of those. Before the
    first and after the last one theirs holds. Where no frame is a keyframe, as in a map that another stream made, the
    tracker's hold. centers: (N, 3) camera positions of photographs in any order, of which time tells nothing, NaN of
    those outside of the part that the map shows: in place of an interpolation they have what the nearest one has.
    """
    known = np.zeros(len(timestamps), bool) if measured is None else np.isfinite(measured).all(axis=(1, 2))
    if np.array_equal(affines, np.broadcast_to(IDENTITY, affines.shape)) and (len(rows) or not known.any()):
        return None
    if centers is not None:
        known &= np.isfinite(centers).all(axis=1)
    times = along(timestamps)

    def for_all(some: np.ndarray, of_some: np.ndarray) -> np.ndarray:
        if centers is None:
            return _interpolated(times, times[some], of_some)
        found = of_some[nearest(centers, centers[some])].astype(np.float64)
        found[some] = of_some  # those of a bracket of exposures are all at one place
        return found

    tracked = np.tile(IDENTITY.astype(np.float64), (len(timestamps), 1, 1))
    if measured is not None and known.any():
        tracked = for_all(np.flatnonzero(known), measured[known])
    if not len(rows):
        return tracked.astype(np.float32)
    remainders = compose(inverse(tracked[rows]), affines)
    return compose(tracked, for_all(rows, remainders)).astype(np.float32)


def gains(affines: np.ndarray) -> np.ndarray:
    """(N, 3) of red, green and blue: by how much affines (N, 3, 4) brighten gray."""
    return np.asarray(affines[:, :, :3].sum(axis=2))


def summary(
    keyframes: np.ndarray, affines: np.ndarray, found: np.ndarray | None, vignetting: np.ndarray | None
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
