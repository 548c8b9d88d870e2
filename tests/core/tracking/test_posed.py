"""The tracker with true poses: their unit may be anything."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from mvsgs_core.held_out import is_held_out
from mvsgs_core.tracking.config import PosedConfig
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.posed import PosedTracker
from tests.support.sequences import synthetic


def depths(factor: float, count: int = 40) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By keyframe: its depths, which of them are triangulated, and its position, poses being `factor` times larger."""
    items = synthetic(frames=80)[:count]
    tracker = PosedTracker(PosedConfig(), (240, 320), items[0].intrinsics)
    complete: list[int] = []
    for item in items:
        pose = np.array(item.world_from_cam)
        pose[:3, 3] *= factor
        complete += tracker.add(item.index, item.timestamp, item.image, pose)
    complete += tracker.finish()
    keyframes = {index: tracker.keyframe(index) for index in complete}
    return {
        i: (1.0 / k.inverse_depth, k.triangulated, np.linalg.inv(k.cam_from_world)[:3, 3]) for i, k in keyframes.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_the_unit_of_the_poses_does_not_matter(factor: float) -> None:
    plain, scaled = depths(1.0), depths(factor)
    assert plain.keys() == scaled.keys()
    for index, (depth, known, position) in plain.items():
        other, other_known, other_position = scaled[index]
        assert np.mean(known == other_known) > 0.99
        np.testing.assert_allclose(other_position, factor * position, rtol=1e-9, atol=1e-9 * factor)
        both = known & other_known
        assert np.quantile(np.abs(other[both] / (factor * depth[both]) - 1.0), 0.99) < 0.01


@pytest.mark.slow
def test_held_out_frames_are_no_keyframes_and_the_newest_view_is_one() -> None:
    keyframes = list(depths(1.0))
    assert len(keyframes) >= 5
    assert not [k for k in keyframes if is_held_out(k)]
    assert keyframes[0] == 0, "the first view that a user gives"
    assert keyframes[-1] >= 38, "the newest view"


@pytest.mark.parametrize("first", [0, 3, 5])
def test_a_camera_that_is_known_from_a_held_out_frame_on_begins_with_the_next(first: int) -> None:
    tracker = PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS)
    for index, x in enumerate([0.0, 0.01, 0.02], first):
        tracker.add(index, index / 30.0, view(pose(0.0, x)), pose(0.0, x))
    assert list(tracker.graph.keyframes) == [6 if first == 5 else first]


def test_of_a_camera_that_stands_two_poses_are_kept() -> None:
    tracker = PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS)
    for index in range(12):
        tracker.add(index, index / 30.0, view(pose(0.0, 0.0)), pose(0.0, 0.0))
    assert set(tracker._poses) == tracker._tail.indices == {10, 11}


def test_the_frame_after_a_held_out_one_is_the_keyframe_however_far_the_camera_has_moved() -> None:
    tracker = PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS)
    for index, x in [(3, 0.0), (4, 0.15), (5, 0.35), (6, 0.36), (7, 0.37)]:
        tracker.add(index, index / 30.0, view(pose(0.0, x)), pose(0.0, x))
    assert list(tracker.graph.keyframes) == [3, 6]
    assert tracker.keyframe(6).triangulated.mean() > 0.5
    assert tracker.stats.counts["keyframes"] == 2


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0, 2, 8])
def test_frames_between_keyframes_have_their_given_poses_and_no_held_out_one_is_among_them(limit: int) -> None:
    items = synthetic(frames=80)[:40]
    tracker = PosedTracker(PosedConfig(frames_between=limit), (240, 320), items[0].intrinsics)
    found, keyframes = [], []
    for item in [*items, None]:
        if item is None:
            complete = tracker.finish()
        else:
            complete = tracker.add(item.index, item.timestamp, item.image, item.world_from_cam)
        for index in complete:
            keyframes.append(index)
            between = tracker.between(index)
            assert len(between) <= limit
            found += between
    indices = [each.index for each in found]
    assert len(set(indices)) == len(indices)
    assert not any(is_held_out(index) or index in keyframes for index in indices)
    if limit == 8:
        assert len(indices) + len(keyframes) == sum(not is_held_out(item.index) for item in items)
    for each in found:
        true = np.linalg.inv(items[each.keyframe].world_from_cam) @ items[each.index].world_from_cam
        np.testing.assert_allclose(each.keyframe_from_cam, true, atol=1e-9)
        assert each.exposure is None  # under steady light
    assert tracker.pending == set()
    with pytest.raises(ValueError, match=r"tracker\.frames_between=-1"):
        PosedConfig(frames_between=-1)


HEIGHT, WIDTH, FOCAL, DISTANCE = 240, 320, 300.0, 3.0
INTRINSICS = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])


@cache
def wall() -> np.ndarray:
    """Noise in octaves, 1200 pixels high and 2400 wide: at DISTANCE before the camera, as fine as its pixels."""
    random, found = np.random.default_rng(0), np.zeros((1200, 2400), np.float32)
    for size in (4, 8, 16, 40):
        noise = random.normal(size=(1200 // size, 2400 // size)).astype(np.float32)
        found += cv2.resize(noise, (2400, 1200), interpolation=cv2.INTER_CUBIC) * size**0.5
    return np.asarray(cv2.cvtColor(np.clip(128 + 18 * found, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2RGB))


def pose(yaw: float, x: float) -> np.ndarray:
    """(4, 4) world_from_cam."""
    found = np.eye(4)
    found[:3, :3] = cv2.Rodrigues(np.array([0.0, yaw, 0.0]))[0]
    found[0, 3] = x
    return found


def view(world_from_cam: np.ndarray) -> np.ndarray:
    """The wall from there."""
    on_wall = np.array([[DISTANCE / FOCAL, 0, -4 * DISTANCE], [0, DISTANCE / FOCAL, -2 * DISTANCE], [0, 0, DISTANCE]])
    camera = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    seen = camera @ world_from_cam[:3, :3].T @ (on_wall - np.outer(world_from_cam[:3, 3], [0, 0, 1]))
    return np.asarray(cv2.warpPerspective(wall(), seen, (WIDTH, HEIGHT)))


@pytest.mark.parametrize(("factor", "error"), [(1.0, 0.0), (1.0, 1e-6), (1000.0, 1e-3)])
def test_a_camera_that_turns_before_it_moves_gives_depths_once_it_moves(factor: float, error: float) -> None:
    """error: of the given positions, as tracked ones have it, over the distance of what is seen."""
    random, tracker, complete = np.random.default_rng(0), PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS), []
    ways = [*((0.01 * n, 0.0) for n in range(18)), *((0.17, 0.03 * n) for n in range(1, 20))]
    for index, (yaw, x) in enumerate(ways, 1):
        true = pose(yaw, x)
        given = true.copy()
        given[:3, 3] = factor * (true[:3, 3] + [1.7, -2.3, 0.9] + error * DISTANCE * random.normal(size=3))
        complete += tracker.add(index, index / 30.0, view(true), given)
    last = tracker.keyframe([*complete, *tracker.finish()][-1])
    assert tracker.unit == pytest.approx(factor * DISTANCE, rel=0.1)
    assert last.triangulated.mean() > 0.8
    assert last.median_depth == pytest.approx(factor * DISTANCE, rel=0.06)


def test_a_camera_that_keeps_what_it_circles_in_the_middle_makes_keyframes() -> None:
    tracker, flows = PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS), []
    follow = tracker.front_end.follow

    def watched(*arguments: Any, **options: Any) -> Step:
        flows.append((step := follow(*arguments, **options)).flow)
        return step

    tracker.front_end.follow = watched  # type: ignore[method-assign]
    for index in range(1, 12):
        x = 0.3 * (index - 6)  # what stands still in the middle of the wall shifts by 30 pixels a frame beside it
        camera = pose(-float(np.arctan2(x, DISTANCE)), x)
        tracker.add(index, index / 30.0, view(camera), camera)
    limit = tracker.config.keyframe_choice.max_flow * WIDTH
    assert max(flows) < limit, "else the flow makes the keyframes"
    assert list(tracker.graph.keyframes) == [index for index in range(1, 12) if not is_held_out(index)]


@pytest.mark.parametrize("decided", [False, True], ids=["at the start", "later"])
def test_frames_that_can_not_be_followed_are_keyframes_where_they_show_another_place(decided: bool) -> None:
    tracker = PosedTracker(PosedConfig(), (HEIGHT, WIDTH), INTRINSICS)
    for index, x in enumerate(0.06 * np.arange(8 if decided else 1), 1):
        tracker.add(index, index / 30.0, view(pose(0.0, x)), pose(0.0, x))
    assert tracker._undecided != decided
    before = len(tracker.graph.keyframes)
    standing = np.linalg.inv(tracker.keyframe(max(tracker.graph.keyframes)).cam_from_world)
    gone = standing @ pose(0.0, 2.0)
    dark, hand = np.full((HEIGHT, WIDTH, 3), 12, np.uint8), np.ascontiguousarray(view(pose(0.0, 2.0))[::-1])
    for index, image, where in [(31, dark, standing), (32, dark, gone), (33, hand, standing), (35, hand, gone)]:
        assert tracker.add(index, index / 30.0, image, where) == []
        assert len(tracker.graph.keyframes) == before
    tracker.add(36, 36 / 30.0, hand, gone)
    assert max(tracker.graph.keyframes) == 36
    assert len(tracker.graph.keyframes) == before + 1


@pytest.mark.slow
def test_a_camera_that_is_held_upright_makes_as_many_keyframes() -> None:
    counts = []
    for turned in (False, True):
        items = synthetic(frames=50, size=(216, 384))
        fx, fy, cx, cy = items[0].intrinsics
        size, intrinsics = (
            ((384, 216), np.array([fy, fx, cy, 383 - cx])) if turned else ((216, 384), items[0].intrinsics)
        )
        tracker = PosedTracker(PosedConfig(), size, intrinsics)
        turn = np.eye(4)
        if turned:  # what lay to the right lies above
            turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
        keyframes: list[int] = []
        for item in items:
            image = np.ascontiguousarray(np.rot90(item.image)) if turned else item.image
            keyframes += tracker.add(item.index, item.timestamp, image, item.world_from_cam @ turn)
        counts.append(len(keyframes + tracker.finish()))
    assert abs(counts[0] - counts[1]) <= 1
