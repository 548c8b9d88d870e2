"""Trajectory metrics after similarity alignment (Sturm et al. 2012; Umeyama 1991), and which frames have a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.held_out import is_held_out
from mvsgs_core.trajectory import TrackingState, Trajectory

ALIGNED = 3  # poses at least, for an alignment


def align(estimate: np.ndarray, truth: np.ndarray) -> geometry.Similarity:
    """Least-squares Sim(3) from estimated to true camera positions; both (N, 4, 4) world_from_cam.

    Raises ValueError where no alignment exists: fewer than 3 poses, or positions that coincide.
    """
    for poses, which in ((truth, "true"), (estimate, "estimated")):
        if len(poses) >= ALIGNED and not geometry.moves(poses[:, :3, 3]):
            raise ValueError(f"the {which} poses do not move: their positions coincide")
    # the truth's own origin may be far away: solved around its mean inside umeyama, in float64
    return geometry.umeyama(estimate[:, :3, 3], truth[:, :3, 3])


def absolute_errors(estimate: np.ndarray, truth: np.ndarray, alignment: geometry.Similarity) -> np.ndarray:
    """(N,) distances of aligned to true camera positions, in the unit of the truth."""
    return np.linalg.norm(alignment.apply(estimate[:, :3, 3]) - truth[:, :3, 3], axis=1)


def rmse(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def relative_errors(estimate: np.ndarray, truth: np.ndarray, scale: float, step: int = 1) -> tuple[float, float]:
    """Relative pose error over `step` poses: RMSE of translation (truth's unit) and of rotation (degrees)."""
    if len(estimate) <= step:
        raise ValueError(f"relative errors over {step} poses need more than {step} poses")
    scaled = geometry.scaled(estimate, scale)
    move_e = geometry.inverse(scaled[:-step]) @ scaled[step:]
    move_t = geometry.inverse(truth[:-step]) @ truth[step:]
    error = geometry.inverse(move_t) @ move_e
    angles = np.linalg.norm(geometry.so3_log(error[:, :3, :3]), axis=1)
    return rmse(np.linalg.norm(error[:, :3, 3], axis=1)), float(np.degrees(rmse(angles)))


def path_length(world_from_cam: np.ndarray) -> float:
    """Length of the way through camera positions (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(world_from_cam[:, :3, 3], axis=0), axis=1).sum())


@dataclass(frozen=True)
class KnownPoses:
    """Estimated poses whose true ones are known, and how they compare after alignment of the keyframes; of all of them
    where too few are keyframes, as where a stream is only localized in a map."""

    estimate: np.ndarray  # (N, 4, 4) world_from_cam
    truth: np.ndarray  # (N, 4, 4)
    keyframe: np.ndarray  # (N,) bool

    @property
    def by_keyframes(self) -> bool:
        """Whether the keyframes are what is aligned."""
        return int(self.keyframe.sum()) >= ALIGNED

    @cached_property
    def alignment(self) -> geometry.Similarity:
        """Raises ValueError where there is none, as `align` does; so do `errors` and `relative`."""
        aligned = self.keyframe if self.by_keyframes else slice(None)
        return align(self.estimate[aligned], self.truth[aligned])

    @property
    def keyframe_error(self) -> float | None:
        """RMSE in the unit of the truth; None where they are not what is aligned."""
        return rmse(self.errors[self.keyframe]) if self.by_keyframes else None

    @property
    def keyframe_percent(self) -> float | None:
        """The same, in percent of the path."""
        error = self.keyframe_error
        return 100 * error / self.path_length if error is not None and self.path_length else None

    @cached_property
    def errors(self) -> np.ndarray:
        """(N,) in the unit of the truth."""
        return absolute_errors(self.estimate, self.truth, self.alignment)

    @cached_property
    def relative(self) -> tuple[float, float] | tuple[None, None]:
        """As `relative_errors`; None of a single pose."""
        if len(self.estimate) < 2:
            return None, None
        return relative_errors(self.estimate, self.truth, self.alignment.scale)

    @cached_property
    def path_length(self) -> float:
        return path_length(self.truth)


def known_poses(
    trajectory: Trajectory, truth: Mapping[int, np.ndarray], keyframes: np.ndarray | Sequence[int] = ()
) -> KnownPoses:
    """Those of the part with the map's `keyframes`, by index; truth: poses (4, 4) by frame index."""
    known = trajectory.main(keyframes) & np.isin(trajectory.index, list(truth))
    true = poses_of(truth, trajectory.index[known])
    return KnownPoses(trajectory.world_from_cam[known], true, trajectory.keyframe[known])


@dataclass(frozen=True)
class AlignedPath:
    """Where the camera was, in the frame of the truth where an alignment to it is known, else of the map."""

    index: np.ndarray  # (N,) frames with a pose
    estimate: np.ndarray  # (N, 3) positions
    rotations: np.ndarray  # (N, 3, 3) world from camera
    truth: np.ndarray | None  # (M, 3) positions of those whose true pose is known; None: no alignment
    known: np.ndarray  # (M,) their frames
    errors: np.ndarray | None  # (M,) their distances
    unit: str  # of lengths, in words


def aligned_path(
    trajectory: Trajectory, truth: Mapping[int, np.ndarray], alignment: geometry.Similarity | None,
    keyframes: np.ndarray | Sequence[int] = (),
) -> AlignedPath:  # fmt: skip
    """Of the part with the map's `keyframes`, by index; truth: poses (4, 4) by frame index."""
    main = trajectory.main(keyframes)
    index, poses = trajectory.index[main], trajectory.world_from_cam[main]
    if alignment is None:
        nobody = np.zeros(0, np.int64)
        return AlignedPath(index, poses[:, :3, 3], poses[:, :3, :3], None, nobody, None, "the map's unit (arbitrary)")
    known = np.isin(index, list(truth))
    true = poses_of(truth, index[known])
    return AlignedPath(
        index, alignment.apply(poses[:, :3, 3]), alignment.rotation @ poses[:, :3, :3], true[:, :3, 3], index[known],
        absolute_errors(poses[known], true, alignment), "unit of the true poses",
    )  # fmt: skip


def poses_of(truth: Mapping[int, np.ndarray], indices: np.ndarray) -> np.ndarray:
    """(N, 4, 4) float64 true poses of these frames. Raises KeyError for one that has none."""
    return np.array([truth[int(i)] for i in indices], dtype=np.float64).reshape(-1, 4, 4)


def counts(trajectory: Trajectory) -> dict[str, Any]:
    """How many frames have which state and a pose; held-out frames that became keyframes all the same."""
    posed = trajectory.posed
    tracked = trajectory.index[posed & (trajectory.state == TrackingState.TRACKED)]
    without = trajectory.state[~posed]
    return {
        "frames": len(trajectory.index),
        "frames_tracked": len(tracked),
        "frames_without_pose": {_name(int(state)): int((without == state).sum()) for state in np.unique(without)},
        "frames_degenerate": int((posed & (trajectory.state == TrackingState.DEGENERATE)).sum()),
        "first_tracked": int(tracked.min()) if len(tracked) else None,
        "last_tracked": int(tracked.max()) if len(tracked) else None,
        "keyframes": int(trajectory.keyframe.sum()),
        "held_out_keyframes": [int(i) for i in trajectory.index[trajectory.keyframe] if is_held_out(int(i))],
        "segments": len(np.unique(trajectory.segment[posed])),
    }


def _name(state: int) -> str:
    names = {s.value: s.name.lower() for s in TrackingState}
    return names.get(state, f"state {state}")
