"""Frames between keyframes move with them to where a map has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.trajectory import Trajectory, velocities

N = 13
FAR = np.array([1e6, -2e6, 3e6])
KEYFRAMES = np.array([3, 6, 10])


def tracked() -> Trajectory:
    twists = np.array([[0.1 * k, 0.02 * k * k, 0.01 * k, 0.0, 0.02 * k, 0.01 * np.sin(k)] for k in range(N)])
    poses = geometry.se3_exp(twists)
    poses[:, :3, 3] += FAR
    index = np.arange(N)
    return Trajectory(
        index, index / 30.0, poses, np.isin(index, KEYFRAMES), np.zeros(N, np.uint8), np.zeros(N, np.int32)
    )


def moved(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """A pose (..., 4, 4) after a motion of the world around FAR."""
    local = pose.copy()
    local[..., :3, 3] -= FAR
    local = motion @ local
    local[..., :3, 3] += FAR
    return np.asarray(local)


def test_frames_between_keyframes_follow_a_motion_of_all() -> None:
    before, motion = tracked(), geometry.se3_exp(np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.1]))
    target = moved(before.world_from_cam[KEYFRAMES], motion)
    shuffled = [2, 0, 1]
    after = before.following(KEYFRAMES[shuffled], target[shuffled])
    np.testing.assert_array_equal(after.world_from_cam[KEYFRAMES], target)
    np.testing.assert_allclose(after.world_from_cam, moved(before.world_from_cam, motion), atol=1e-8)
    np.testing.assert_array_equal(before.world_from_cam, tracked().world_from_cam)


def test_between_two_keyframes_the_motion_is_between_theirs() -> None:
    before = tracked()
    twist = np.array([0.02, 0.01, -0.02, 0.003, 0.004, -0.002])
    target = before.world_from_cam[KEYFRAMES].copy()
    target[1] = moved(target[1], geometry.se3_exp(twist))
    after = before.following(KEYFRAMES, target)
    for frame, share in ((0, 0.0), (3, 0.0), (4, 1 / 3), (5, 2 / 3), (6, 1.0), (7, 0.75), (9, 0.25), (12, 0.0)):
        expected = moved(before.world_from_cam[frame], geometry.se3_exp(share * twist))
        np.testing.assert_allclose(after.world_from_cam[frame], expected, atol=1e-8)


@pytest.mark.parametrize("back", [0.2, 100.0])
def test_where_times_go_back_the_motion_is_between_theirs_by_frames(back: float) -> None:
    """As of a clock that was set, or of two recordings: times then say nothing of which frames are beside another."""
    before, twist = tracked(), np.array([0.02, 0.01, -0.02, 0.003, 0.004, -0.002])
    target = before.world_from_cam[KEYFRAMES].copy()
    target[1] = moved(target[1], geometry.se3_exp(twist))
    expected = before.following(KEYFRAMES, target)
    timestamp = before.timestamp - np.where(before.index >= 5, back, 0.0)
    for times in (timestamp, np.zeros(N)):
        after = replace(before, timestamp=times).following(KEYFRAMES, target)
        np.testing.assert_allclose(after.world_from_cam, expected.world_from_cam, atol=1e-8)


def test_frames_without_a_pose_and_other_parts_of_the_map_stay() -> None:
    before = tracked()
    poses, segment = before.world_from_cam.copy(), before.segment.copy()
    poses[4], segment[11:] = np.nan, 1
    before = replace(before, world_from_cam=poses, segment=segment)
    target = poses[KEYFRAMES].copy()
    target[:, 0, 3] += 0.5
    after = before.following(KEYFRAMES, target)
    assert np.isnan(after.world_from_cam[4]).all()
    np.testing.assert_array_equal(after.world_from_cam[11:], poses[11:])
    np.testing.assert_allclose(after.world_from_cam[5, 0, 3], poses[5, 0, 3] + 0.5)


@pytest.mark.parametrize("times", [1, 2, 4])
def test_an_image_that_is_shown_again_moves_as_the_camera_did_when_it_was_taken(times: int) -> None:
    """As in a video of 15 frames a second that is shown at 30 or 60."""
    twist = np.array([0.02, 0.01, -0.02, 0.003, 0.04, -0.002])
    taken = geometry.se3_exp(np.arange(8)[:, None] * twist)
    shown = np.repeat(taken, times, axis=0)
    seconds = np.arange(len(shown)) / (15.0 * times)
    found = velocities(seconds, shown, np.ones(len(shown), bool))
    np.testing.assert_allclose(found, np.tile(15.0 * twist, (len(shown), 1)), atol=1e-9)


def test_where_no_pose_is_known_no_velocity_is() -> None:
    assert not velocities(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)), np.zeros(3, bool)).any()


def test_a_camera_that_rests_has_no_velocity() -> None:
    poses = np.tile(np.eye(4), (13, 1, 1))
    poses[:3, 0, 3], poses[10:, 0, 3] = [-3.0, -2.0, -1.0], [1.0, 2.0, 3.0]
    found = velocities(np.arange(13) / 20.0, poses, np.ones(13, bool))  # it rests for 0.3 s
    np.testing.assert_allclose(found[:, 0], [20.0] * 3 + [0.0] * 7 + [20.0] * 3, atol=1e-9)


def test_an_image_that_is_shown_again_follows_a_keyframe_as_the_first_time() -> None:
    before = tracked()
    poses = before.world_from_cam.copy()
    poses[[2, 4, 7, 8]] = poses[[1, 3, 6, 6]]
    before, target = replace(before, world_from_cam=poses), poses[KEYFRAMES].copy()
    target[1] = moved(target[1], geometry.se3_exp(np.array([0.02, 0.01, -0.02, 0.003, 0.004, -0.002])))
    after = before.following(KEYFRAMES, target).world_from_cam
    np.testing.assert_array_equal(after[[2, 4, 7, 8]], after[[1, 3, 6, 6]])
    np.testing.assert_array_equal(after[KEYFRAMES], target)


def test_where_no_keyframe_moved_nothing_does() -> None:
    before = tracked()
    assert before.following(KEYFRAMES, before.world_from_cam[KEYFRAMES]) is before
    assert before.following(np.zeros(0, np.int64), np.zeros((0, 4, 4))) is before


def test_of_two_parts_the_one_with_the_maps_keyframes_counts_however_few_its_frames() -> None:
    before = tracked()
    before = replace(before, segment=(before.index >= 9).astype(np.int32))  # keyframe 10, and three frames beside it
    parts = {"map": before.main(np.array([10])), "no map": before.main(), "of another stream": before.main([-7, 99])}
    assert {name: np.flatnonzero(part).tolist() for name, part in parts.items()} == {
        "map": [9, 10, 11, 12],
        "no map": list(range(9)),
        "of another stream": list(range(9)),
    }
    target = before.world_from_cam[[10]].copy()
    target[:, 0, 3] += 0.5
    moves = before.following(np.array([10]), target).world_from_cam - before.world_from_cam
    np.testing.assert_allclose(moves[:, 0, 3], np.where(parts["map"], 0.5, 0.0), atol=1e-8)


def test_photographs_in_any_order_follow_the_keyframe_that_is_nearest_in_space() -> None:
    along = np.array([0.0, 10.0, 2.0, 8.0, 1.0, 9.0])
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = along
    index, keyframe = np.arange(6), np.array([True, False, True, True, False, True])
    before = Trajectory(
        index, index / 10.0, poses, keyframe, np.zeros(6, np.uint8), np.zeros(6, np.int32), in_order=False
    )
    turned = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(1.0), 0.0]))
    target = poses[keyframe].copy()
    target[0] = target[0] @ turned  # where 1.0 lies beside it, and 10.0 comes next
    after = before.following(index[keyframe], target).world_from_cam
    np.testing.assert_array_equal(after[keyframe], target)
    np.testing.assert_allclose(after[1], poses[1], atol=1e-12)
    np.testing.assert_allclose(after[4], turned @ poses[4], atol=1e-12)
