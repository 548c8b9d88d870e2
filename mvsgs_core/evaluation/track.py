"""What the tracker says of each frame, and how true its poses are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mvsgs_core.evaluation import trajectory
from mvsgs_core.held_out import is_held_out

TRACKED, DEGENERATE = 0, 3
STATES = ("tracked", "lost", "not_initialized", "degenerate")  # what the numbers in `Track.state` mean


@dataclass(frozen=True)
class Track:
    """All frames that the tracker saw: arrays over N frames."""

    index: np.ndarray
    timestamp: np.ndarray
    world_from_cam: np.ndarray  # (N, 4, 4), NaN without a pose
    keyframe: np.ndarray
    state: np.ndarray  # see STATES
    segment: np.ndarray
    focal_factor: float = 1.0  # on the focal lengths of the frames, where they were guessed
    readout_time: float = 0.0  # seconds of the rolling shutter

    @property
    def posed(self) -> np.ndarray:
        """(N,) bool: frames with a pose, verified or not."""
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))

    def main(self) -> np.ndarray:
        """(N,) bool: frames with a pose in the part of the map that has most frames."""
        posed = self.posed
        if not posed.any():
            return posed
        segments, counts = np.unique(self.segment[posed], return_counts=True)
        return np.asarray(posed & (self.segment == segments[np.argmax(counts)]))

    def counts(self) -> dict[str, Any]:
        """How many frames have which state and a pose; held-out frames that became keyframes all the same."""
        posed = self.posed
        tracked = self.index[posed & (self.state == TRACKED)]
        without = self.state[~posed]
        return {
            "frames": len(self.index),
            "frames_tracked": len(tracked),
            "frames_without_pose": {_name(state): int((without == state).sum()) for state in np.unique(without)},
            "frames_degenerate": int((posed & (self.state == DEGENERATE)).sum()),
            "first_tracked": int(tracked.min()) if len(tracked) else None,
            "last_tracked": int(tracked.max()) if len(tracked) else None,
            "keyframes": int(self.keyframe.sum()),
            "held_out_keyframes": [int(i) for i in self.index[self.keyframe] if is_held_out(int(i))],
            "segments": len(np.unique(self.segment[posed])),
        }


NO_TRACK: dict[str, Any] = {
    "frames_tracked": 0, "frames_without_pose": {}, "frames_degenerate": 0, "first_tracked": None,
    "last_tracked": None, "keyframes": 0, "held_out_keyframes": [], "segments": 0,
}  # fmt: skip

NO_SCORE: dict[str, Any] = {
    "ate_rmse": None, "ate_rmse_frames": None, "ate_percent": None, "rpe_translation": None, "rpe_rotation": None,
    "path_length": None, "scale": None, "ate_keyframes": 0, "ate_frames": 0,
}  # fmt: skip


def score(
    track: Track, truth: Mapping[int, np.ndarray], notes: list[str]
) -> tuple[trajectory.Alignment | None, dict[str, Any]]:
    """Errors of the poses of the main part against the true ones by index, and the Sim(3) that brings them together.

    None, with the reason in `notes`, where there is none.
    """
    known = track.main() & np.isin(track.index, list(truth))
    estimate, true = track.world_from_cam[known], poses_of(truth, track.index[known])
    is_keyframe = track.keyframe[known]
    report = {**NO_SCORE, "ate_keyframes": int(is_keyframe.sum()), "ate_frames": len(estimate)}
    try:
        alignment = trajectory.align(estimate[is_keyframe], true[is_keyframe])
    except ValueError as error:
        notes.append(f"no trajectory error: {error}" if len(truth) else "no trajectory error: no true poses")
        return None, report
    errors = trajectory.absolute_errors(estimate, true, alignment)
    length = trajectory.path_length(true)
    report |= {
        "ate_rmse": trajectory.rmse(errors[is_keyframe]),
        "ate_rmse_frames": trajectory.rmse(errors),
        "ate_percent": 100 * trajectory.rmse(errors[is_keyframe]) / length if length else None,
        "path_length": length,
        "scale": alignment.scale,
    }
    if len(estimate) > 1:
        report["rpe_translation"], report["rpe_rotation"] = trajectory.relative_errors(estimate, true, alignment.scale)
    return alignment, report


def poses_of(truth: Mapping[int, np.ndarray], indices: np.ndarray) -> np.ndarray:
    """(N, 4, 4) float64 true poses of these frames. Raises KeyError for one that has none."""
    return np.array([truth[int(i)] for i in indices], dtype=np.float64).reshape(-1, 4, 4)


def _name(state: int) -> str:
    return STATES[state] if state < len(STATES) else f"state {state}"
