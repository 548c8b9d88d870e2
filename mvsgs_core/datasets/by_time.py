"""Times of images: whether they are any, and ascend; what was measured at other times, the nearest, and poses between
two."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mvsgs_core.geometry import interpolate
from mvsgs_core.trajectory_file import LATEST


def check_times(frames: Sequence[tuple[float, str]]) -> None:
    """Raises ValueError for the first of frames (seconds, name) that is at no time."""
    for seconds, name in frames:
        if not abs(seconds) < LATEST:
            raise ValueError(f"{name} is at {seconds:g} s, which is no time: give each frame its own, in seconds")


def standstill(frames: Sequence[tuple[float, str]]) -> list[str]:
    """A warning of frames (seconds, name), in the order of the stream, whose times do not ascend."""
    late = [there for here, there in pairwise(frames) if there[0] <= here[0]]
    if not late:
        return []
    return [
        f"frames whose time is not after that of the frame before: {len(late)} (first: {late[0][1]}, "
        f"{late[0][0]:.6f} s); they are taken in the order of their list, and how fast the camera moves there is not "
        "known, so that a rolling shutter is left as it is: give each frame its own time, or their folder as "
        "dataset=images with dataset.options.rate"
    ]


def nearest(wanted: np.ndarray, available: np.ndarray, max_difference: float) -> dict[int, int]:
    """Index into `wanted` (N,) -> index into `available` (M, sorted) of the nearest time, where it is near enough."""
    if len(available) == 0:
        return {}
    right = np.clip(np.searchsorted(available, wanted), 1, max(len(available) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(available) - 1)
    best = np.where(np.abs(available[left] - wanted) <= np.abs(available[right] - wanted), left, right)
    near = np.abs(available[best] - wanted) <= max_difference
    return {int(i): int(best[i]) for i in np.flatnonzero(near)}


def poses_at(
    times: np.ndarray, known: np.ndarray, poses: np.ndarray, max_difference: float
) -> tuple[dict[int, np.ndarray], list[str]]:
    """Index into `times` (N,), seconds -> pose (4, 4), of `poses` (M, 4, 4) at the times `known` (M, sorted).

    Between two that are near enough it is interpolated, else the nearest one counts; where none is near enough there is
    none. Returns warnings of that, too.
    """
    near = nearest(times, known, max_difference)
    found = {i: _pose_at(times[i], known, poses, j, max_difference) for i, j in near.items()}
    if len(found) == len(times):
        return found, []
    return found, [f"{len(times) - len(found)} of {len(times)} images have no true pose within {max_difference} s"]


def _pose_at(time: float, known: np.ndarray, poses: np.ndarray, closest: int, max_difference: float) -> np.ndarray:
    """Half the time between two poses of motion capture is a millimeter, or a pixel, at the speed of a hand."""
    other = closest + (1 if time > known[closest] else -1)
    if not 0 <= other < len(known) or not 0.0 < abs(known[other] - time) <= max_difference:
        return np.asarray(poses[closest])
    span = known[other] - known[closest]
    if span == 0.0:
        return np.asarray(poses[closest])
    return interpolate(poses[closest], poses[other], (time - known[closest]) / span)
