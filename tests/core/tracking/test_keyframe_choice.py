"""Held-out frames are no keyframes where the next frame can be; the stream's last frames become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.held_out import is_held_out
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.keyframe_choice import HELD_OUT, KeyframeChoice, KeyframeChoiceConfig, newest
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import Localization
from mvsgs_core.tracking.tracker import Tracker
from tests.support.sequences import ate, synthetic, track, tracked_room

SIDE, LIMIT = 320, 0.05  # a keyframe after 16 pixels


def step(flow: float, fraction: float = 0.9) -> Step:
    return Step(0, Matches(np.zeros((0, 2)), np.zeros(0)), fraction, flow, False, None)


def chosen(flows: list[float], fractions: list[float] | None = None, first: int = 1) -> list[int]:
    """Frames that are wanted as keyframes, all of them seen from one reference."""
    choice = KeyframeChoice(KeyframeChoiceConfig())
    steps = [step(f, s) for f, s in zip(flows, fractions or [0.9] * len(flows))]
    return [n for n, s in enumerate(steps, start=first) if choice.wants(n, s, SIDE, LIMIT)]


def test_a_held_out_frame_leaves_its_place_to_the_next() -> None:
    assert chosen([4, 8, 12, 15, 18, 21]) == [6]
    assert chosen([4, 8, 12, 17, 18, 21])[0] == 4


def test_a_held_out_frame_stays_where_the_next_would_be_too_late() -> None:
    assert chosen([15.9, 30.0], first=4)[0] == 5, "the next would have moved by 44 pixels"
    assert chosen([5, 10], [0.8, 0.45], first=4)[0] == 5, "of the next, too few points would be found"
    assert chosen([20.0], first=5) == [5], "wide steps: the next moves by 40"


def test_the_newest_frame_that_is_not_held_out_ends_the_stream() -> None:
    assert newest([]) is None
    assert newest([18, 19]) == 19
    assert newest([19, 20]) == 19
    assert newest([20]) == 20


def test_few_matches_that_agree_with_the_pose_make_a_keyframe_after_half_the_flow() -> None:
    choice = KeyframeChoice(KeyframeChoiceConfig())
    for flow, inliers, wanted in ((9.0, 0.7, True), (7.0, 0.7, False), (9.0, 0.8, False), (17.0, 0.8, True)):
        seen = replace(step(flow), localization=Localization(np.eye(4), inliers))
        assert choice.moved(seen, SIDE, LIMIT) == wanted


@pytest.mark.parametrize(("dark", "first"), [(0, 0), (3, 3), (5, 6)])
def test_a_map_begins_with_the_first_frame_that_shows_anything_or_the_next_where_that_is_held_out(
    dark: int, first: int
) -> None:
    tracker = Tracker()
    for item in synthetic(frames=80)[: dark + 2]:
        image = np.zeros_like(item.image) if item.index < dark else item.image
        tracker.add(item.index, item.timestamp, image, item.intrinsics).whole()
    assert tracker.session is not None
    assert list(tracker.session.initializer.waiting) == [first]


@pytest.mark.slow
def test_no_frame_of_the_room_that_is_held_out_is_mapped() -> None:
    tracker, trajectory, _ = tracked_room()
    keyframes = trajectory.index[trajectory.keyframe].tolist()
    assert not [k for k in keyframes if is_held_out(k)]
    assert keyframes[0] == 0, "the first view that a user gives"
    assert tracker.stats.counts[HELD_OUT] == 0
    assert np.isfinite(trajectory.world_from_cam).all()
    assert keyframes[-1] == len(trajectory.index) - 1, "the newest view"


@pytest.mark.slow
def test_frames_that_had_to_stay_are_counted() -> None:
    items = [replace(i, index=n, timestamp=n / 20.0) for n, i in enumerate(synthetic(frames=80)[::5])]
    tracker, trajectory, _ = track(items)
    stayed = [k for k in trajectory.index[trajectory.keyframe].tolist() if is_held_out(k)]
    assert stayed, "one keyframe follows the other"
    assert tracker.stats.counts[HELD_OUT] == len(stayed)


@pytest.mark.slow
def test_a_camera_that_comes_to_rest_makes_no_keyframe_in_the_end() -> None:
    items = synthetic(frames=80)
    moving = list(items[:41])
    still = [replace(items[40], index=n, timestamp=n / 20.0) for n in range(41, 50)]
    _, trajectory, _ = track([*moving, *still])
    last = trajectory.index[trajectory.keyframe].tolist()[-1]
    assert last <= 40
    assert last >= 39, "the newest view that is not held out, or the last frame before the rest"


def upright(item: Item) -> Item:
    """The same frame of the same camera, turned by 90 degrees."""
    fx, fy, cx, cy = item.intrinsics
    intrinsics = np.array([fy, fx, cy, item.image.shape[1] - 1 - cx])
    return replace(item, image=np.ascontiguousarray(np.rot90(item.image)), intrinsics=intrinsics)


@pytest.mark.slow
def test_a_camera_that_is_held_upright_makes_as_many_keyframes() -> None:
    items = synthetic(frames=50, size=(216, 384))
    across, along = (track(some)[1] for some in (items, [upright(item) for item in items]))
    error, length = ate(along, items)
    assert error < 0.003 * length
    assert abs(int(across.keyframe.sum()) - int(along.keyframe.sum())) <= 1
