"""What is said of frames and poses: by state, with and without a pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.evaluation.trajectory_metrics import counts, known_poses
from mvsgs_core.trajectory import Trajectory

N = 12


def trajectory(**given: Any) -> Trajectory:
    poses = np.array([geometry.se3_exp(np.array([0.1 * k, 0.02 * k * k, 0.0, 0.0, 0.0, 0.0])) for k in range(N)])
    index = np.arange(N)
    usual = {"index": index, "timestamp": index / 30, "world_from_cam": poses, "keyframe": index % 3 == 0,
             "state": np.zeros(N, np.uint8), "segment": np.zeros(N, np.int32)}  # fmt: skip
    return Trajectory(**(usual | given))


def test_frames_are_counted_by_state_and_pose() -> None:
    state = np.array([2, 2, 0, 0, 0, 3, 1, 1, 0, 0, 0, 9], np.uint8)
    poses = trajectory().world_from_cam.copy()
    poses[[0, 1, 6, 9, 11]] = np.nan  # 7 is lost, but has a pose that nothing verified; 9 is tracked without one
    found = counts(trajectory(state=state, world_from_cam=poses))
    assert found["frames"] == N
    assert found["frames_tracked"] == 5
    assert found["frames_without_pose"] == {"tracked": 1, "lost": 1, "not_initialized": 2, "state 9": 1}
    assert found["frames_degenerate"] == 1
    assert (found["first_tracked"], found["last_tracked"]) == (2, 10)


def test_held_out_frames_that_became_keyframes_are_named() -> None:
    keyframe = np.isin(np.arange(N), [0, 3, 5, 10])  # the first frame is no held-out one
    assert counts(trajectory(keyframe=keyframe))["held_out_keyframes"] == [5, 10]


def test_no_frame_has_a_pose() -> None:
    found = counts(trajectory(world_from_cam=np.full((N, 4, 4), np.nan), state=np.full(N, 2, np.uint8)))
    assert found["frames_tracked"] == found["segments"] == 0
    assert found["frames_without_pose"] == {"not_initialized": N}
    assert found["first_tracked"] is None


def test_the_number_of_poses_behind_an_error_is_said() -> None:
    truth = {int(i): pose for i, pose in zip(range(N), trajectory().world_from_cam) if i not in (1, 3)}
    poses = known_poses(trajectory(), truth)
    assert poses.alignment.scale == pytest.approx(1.0)
    assert poses.keyframe.sum() == 3
    assert len(poses.errors) == 10
