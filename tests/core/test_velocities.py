"""The camera's velocity between the poses of a trajectory."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.trajectory import Trajectory, velocities

VELOCITY = np.array([0.3, -0.2, 0.4, 0.2, -0.1, 0.3])


def test_velocity_of_a_steady_motion_is_found_at_every_frame() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.25, 0.35])
    start = geometry.se3_exp(np.array([1.0, 2.0, 3.0, 0.5, 0.2, 0.1]))
    poses = np.array([start @ geometry.se3_exp(VELOCITY * t) for t in times])
    found = velocities(times, poses, np.ones(5, dtype=bool))
    np.testing.assert_allclose(found, np.tile(VELOCITY, (5, 1)), atol=1e-9)


def test_velocity_is_zero_where_no_neighbor_in_time_is_known() -> None:
    times = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    poses = np.array([geometry.se3_exp(VELOCITY * t) for t in times])
    poses[1] = np.nan
    found = velocities(times, poses, np.array([True, False, True, True, False]))
    np.testing.assert_allclose(found[[0, 2]], [VELOCITY, VELOCITY], atol=1e-9)
    assert not found[[1, 3, 4]].any()


def test_velocity_is_zero_where_times_go_back() -> None:
    """Of the poses before and after, whose times are .02 s apart, it would be ten times too large."""
    times = np.array([0.0, 0.1, 0.02, 0.12])
    poses = np.array([geometry.se3_exp(VELOCITY * t) for t in (0.0, 0.1, 0.2, 0.3)])
    found = velocities(times, poses, np.ones(4, dtype=bool))
    np.testing.assert_allclose(found[[0, 3]], [VELOCITY, VELOCITY], atol=1e-9)
    assert not found[[1, 2]].any()


def test_frames_of_two_segments_say_nothing_of_each_others_velocity() -> None:
    times = np.arange(6) / 10.0
    poses = np.array([geometry.se3_exp(VELOCITY * t) for t in times])
    poses[3:, :3, 3] += 100.0  # another frame of reference
    poses[5] = np.nan
    segment = np.array([0, 0, 0, 1, 1, -1], np.int32)
    track = Trajectory(7 + np.arange(6), times, poses, np.zeros(6, bool), np.zeros(6, np.uint8), segment)
    found = track.velocities_of(np.array([9, 10, 12]))
    np.testing.assert_allclose(found[:2], [VELOCITY, VELOCITY], atol=1e-9)
    assert np.isnan(found[2]).all()


def test_of_a_stream_without_frames_no_velocity_is_known() -> None:
    found = Trajectory.empty().velocities_of(np.array([3]))
    assert found.shape == (1, 6)
    assert np.isnan(found).all()
