"""A focal length that is only guessed: found where the motion shows it, kept with a warning where it does not."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.lens import guess_lens
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.between import HELD
from mvsgs_core.tracking.estimation import calibration
from mvsgs_core.tracking.estimation.focal import focal_of_all, observability
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig, Update
from mvsgs_core.trajectory import Trajectory
from tests.support.sequences import ate, synthetic
from tests.support.true_maps import tie, true_graph

pytestmark = pytest.mark.slow

SIZE = (240, 320)
GUESS = np.array(guess_lens(SIZE).intrinsics)


@functools.cache
def room(focal: float) -> tuple[Item, ...]:
    """The room through a lens with this focal length, in image widths."""
    sequence = Synthetic(frames=60, size=SIZE, threads=1)
    sequence.intrinsics = sequence.intrinsics * [focal / 0.8, focal / 0.8, 1.0, 1.0]
    return tuple(sequence)


@functools.cache
def straight(focal: float = 0.8) -> tuple[Item, ...]:
    """A camera that never turns: depths of any scale along the axis go with some focal length."""
    sequence = Synthetic(frames=2, size=SIZE, threads=1)
    sequence.intrinsics = sequence.intrinsics * [focal / 0.8, focal / 0.8, 1.0, 1.0]
    items = []
    for n in range(45):
        pose = np.array(sequence[0].world_from_cam)
        pose[:3, 3] += pose[:3, :3] @ np.array([0.024, 0.008, 0.012]) * n
        items.append(Item(n, n / 20.0, sequence.render(pose, sequence.intrinsics, SIZE)[0], sequence.intrinsics, pose))
    return tuple(items)


def track_guessing(items: tuple[Item, ...]) -> tuple[Tracker, Trajectory, list[Update]]:
    tracker = Tracker()
    updates = [tracker.add(i.index, i.timestamp, i.image, GUESS, guessed=True) for i in items]
    updates += tracker.finish()
    return tracker, tracker.trajectory(), updates


def lost_soon(again: int) -> tuple[Tracker, list[int], list[Item]]:
    """Six keyframes of a camera that does not turn, six frames of elsewhere, and so many of one that does, in the same
    room, which is not recognized.

    The tracker, the keyframes of the first part, and the frames of both.
    """
    tracker, seen, first = Tracker(TrackerConfig(loops=False)), list[Item](), list[int]()
    while len(first) < 6:
        seen.append(straight(1.3)[len(seen)])
        item = seen[-1]
        assert tracker.add(item.index, item.timestamp, item.image, GUESS, guessed=True).keyframes == ()
        first = list(tracker.session.publisher.held if tracker.phase is Phase.TRACKING else ())
    tracker.session.relocalizer.relocalize = lambda frame: None  # type: ignore[method-assign]
    elsewhere = [replace(item, world_from_cam=None) for item in synthetic(frames=40, scene="aerial")[:6]]
    for item in [*elsewhere, *room(1.3)[:again]]:
        item = replace(item, index=len(seen), timestamp=len(seen) / 20.0)
        tracker.add(item.index, item.timestamp, item.image, GUESS, guessed=True)
        seen.append(item)
    return tracker, first, seen


@pytest.mark.parametrize("focal", [0.5, 1.3])  # fields of view of 90 and 42 degrees; the guess is 65
def test_the_focal_length_is_found(focal: float) -> None:
    items = room(focal)
    tracker, trajectory, updates = track_guessing(items)
    true = focal * SIZE[1] / GUESS[0]
    assert abs(true - 1.0) > 0.3, "the guess must be wrong"
    assert tracker.focal_factor == pytest.approx(true, rel=0.03)
    error, length = ate(trajectory, items)
    assert error < 0.004 * length
    assert np.isfinite(trajectory.world_from_cam).all()
    published = [index for update in updates for index in update.keyframes]
    assert published == trajectory.index[trajectory.keyframe].tolist()
    assert tracker.stats.warnings == []
    values = tracker.stats.values
    assert values["focal_px"] == pytest.approx(focal * SIZE[1], rel=0.03)
    assert 0.0 < values["focal_sigma_percent"] < 4.0
    assert abs(values["radial_k1"]) < 2 * values["radial_k1_sigma"]
    assert abs(values["focal_px"] / (focal * SIZE[1]) - 1.0) < 3 * values["focal_sigma_percent"] / 100
    if trajectory.keyframe.sum() >= tracker.config.focal.min_keyframes:
        assert values["focal_checked_px"] == pytest.approx(focal * SIZE[1], rel=0.03)


def test_keyframes_wait_until_the_focal_length_is_settled() -> None:
    tracker, limit = Tracker(), TrackerConfig().frames_between
    for item in room(1.3):
        update = tracker.add(item.index, item.timestamp, item.image, GUESS, guessed=True)
        if update.keyframes:
            break
        assert tracker.pending >= set(tracker.session.graph.keyframes), "an image that is still needed"
        held = len(tracker.session.publisher.held)
        if held:
            assert len(tracker.session.waiting.indices) <= HELD * held + limit, "each holds its image"
    settled = tracker.focal_factor
    assert len(update.keyframes) >= 8
    between = [frame.index for frame in update.between]
    for before, after in pairwise(update.keyframes):
        assert after - before <= 2 or any(before < index < after for index in between), "they wait as the keyframes do"
    for later in room(1.3)[item.index + 1 :]:
        tracker.add(later.index, later.timestamp, later.image, GUESS, guessed=True)
        assert tracker.focal_factor == settled


@pytest.mark.parametrize("lost", [False, True])
def test_frames_between_keyframes_that_waited_to_the_end_of_their_part_go_out_with_them(lost: bool) -> None:
    tracker, items = Tracker(), iter(room(1.3))
    while len(tracker.session.publisher.held if tracker.phase is Phase.TRACKING else ()) < 6:
        item = next(items)
        assert tracker.add(item.index, item.timestamp, item.image, GUESS, guessed=True).keyframes == ()
    held, updates = list(tracker.session.publisher.held), list[Update]()
    for n, other in enumerate(synthetic(frames=40, scene="aerial")[:6] if lost else (), item.index + 1):
        updates.append(tracker.add(n, n / 20.0, other.image, GUESS, guessed=True))
    assert (tracker.phase is Phase.INITIALIZING) == lost, "another part begins"
    assert not any(update.keyframes for update in updates), "it may tell the focal length"
    (update,) = [update for update in tracker.finish() if update.keyframes]
    assert update.keyframes == tuple(held)
    between = [frame.index for frame in update.between]
    for before, after in pairwise(held):
        assert any(before < index < after for index in between)


def test_a_camera_that_is_lost_soon_gets_the_focal_length_of_all_parts() -> None:
    tracker, first, seen = lost_soon(60)
    assert tracker.session.calibration.settled
    assert tracker.focal_factor == pytest.approx(1.3 * SIZE[1] / GUESS[0], rel=0.02)
    list(tracker.finish())
    trajectory = tracker.trajectory()
    for segment in (0, 1):
        here = trajectory.segment == segment
        error, length = ate(trajectory, seen, here)
        assert error < 0.004 * length
    assert set(first) == set(trajectory.index[trajectory.keyframe & (trajectory.segment == 0)])


def test_keyframes_of_a_part_that_was_lost_soon_go_out_when_the_next_one_tells_the_focal_length() -> None:
    tracker, first, _ = lost_soon(0)
    held, between = tracker.session.publisher.held, tracker.session.waiting.indices
    assert held == first
    assert between, "frames between them wait, too"
    for n, item in enumerate(room(1.3), len(tracker.session.records)):
        update = tracker.add(n, n / 20.0, item.image, GUESS, guessed=True)
        if update.keyframes:
            break
        assert tracker.pending >= between.union(first)
    assert list(update.keyframes[:6]) == first
    assert {tracker.keyframe(index).segment for index in update.keyframes} == {0, 1}
    assert {frame.keyframe in first for frame in update.between} == {False, True}


def test_another_part_begins_at_the_guess_however_far_off_the_first_one_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of half of the guess, three times as much is too little."""
    monkeypatch.setattr(calibration, "refine_focal", lambda *_: "")
    tracker, _, _ = lost_soon(0)
    given = tracker.session.calibration.given
    tracker.session.graph.intrinsics = given * [0.5, 0.5, 1.0, 1.0]
    for n, item in enumerate(room(1.3), len(tracker.session.records)):
        tracker.add(n, n / 20.0, item.image, GUESS, guessed=True)
        if tracker.phase is Phase.TRACKING:
            break
    assert tracker.focal_factor == pytest.approx(1.3 * SIZE[1] / GUESS[0], rel=0.1)


@pytest.mark.parametrize("unit", [1.0, 2000.0])
def test_keyframes_far_beyond_the_map_s_unit_tell_the_focal_length_as_well(unit: float) -> None:
    frames = (0, 8, 16, 24, 32, 40)
    graph = true_graph(*frames, unit=1.0 / unit)
    tie(graph, *frames)
    tie(graph, *reversed(frames))
    graph.intrinsics = graph.intrinsics * [1.05, 1.05, 1.0, 1.0]
    assert focal_of_all(graph, list(frames), 1, steps=30) == pytest.approx(1.0 / 1.05, rel=2e-3)
    assert observability(graph, list(frames), 0.1, 1, 1.0 / 1.05) > 1.0


def test_a_camera_that_never_turns_keeps_the_guess_and_says_so() -> None:
    tracker, trajectory, _ = track_guessing(straight())
    assert tracker.focal_factor == 1.0
    assert any("guess is kept" in warning for warning in tracker.stats.warnings)
    assert trajectory.keyframe.sum() >= 4


@pytest.mark.parametrize(("off", "said"), [(1.0, False), (0.95, True), (1.05, True)])
def test_a_known_focal_length_is_left_alone_and_a_wrong_one_is_said(off: float, said: bool) -> None:
    tracker, true = Tracker(), 1.3 * SIZE[1]
    for item in room(1.3):
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics * [off, off, 1.0, 1.0])
    assert tracker.phase is Phase.TRACKING
    list(tracker.finish())
    assert tracker.focal_factor == 1.0
    assert ("focal_doubt" in tracker.stats.values) == said
    if said:
        assert tracker.stats.values["focal_checked_px"] == pytest.approx(true, rel=0.015)
        (warning,) = [w for w in tracker.stats.warnings if "contradict" in w]
        assert "px in the original images, " in warning
        assert f"times the {off * true:.0f} px that were given" in warning
        assert "dataset.intrinsics" in warning
    else:
        assert tracker.stats.warnings == []


def test_a_wrong_focal_length_is_said_where_the_stream_ends_elsewhere() -> None:
    """The last frames begin a segment of their own, which gives no map."""
    tracker, elsewhere = Tracker(), synthetic(frames=40, scene="aerial")[:10]
    for n, item in enumerate([*room(1.3), *elsewhere]):
        tracker.add(n, n / 20.0, item.image, room(1.3)[0].intrinsics * [0.95, 0.95, 1.0, 1.0])
    assert tracker.phase is Phase.INITIALIZING
    list(tracker.finish())
    assert tracker.trajectory().segment.max() == 0
    assert tracker.stats.values["focal_checked_px"] == pytest.approx(1.3 * SIZE[1], rel=0.015)
    assert "focal_doubt" in tracker.stats.values


def test_a_motion_that_hardly_tells_a_focal_length_contradicts_none() -> None:
    tracker = Tracker()
    for item in straight():
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics * [1.1, 1.1, 1.0, 1.0])
    list(tracker.finish())
    assert not any("contradict" in w for w in tracker.stats.warnings)


def test_the_check_in_the_end_says_both_focal_lengths_and_how_sure_it_is() -> None:
    """Keyframes went out with a focal length that the whole stream contradicts."""
    tracker = Tracker()
    wrong = GUESS * [1.25, 1.25, 1.0, 1.0]
    for item in room(1.3):
        tracker.add(item.index, item.timestamp, item.image, wrong, guessed=True)
        if not tracker.session.calibration.settled and tracker.phase is Phase.TRACKING:
            tracker.session.graph.intrinsics = wrong * 1.0  # as if nothing better had been found
            tracker.session.calibration.settled = True
    list(tracker.finish())
    values = tracker.stats.values
    true = 1.3 * SIZE[1]
    assert abs(values["focal_checked_px"] / true - 1.0) < abs(wrong[0] / true - 1.0)
    (warning,) = [w for w in tracker.stats.warnings if "all keyframes together" in w]
    assert f"{values['focal_checked_px']:.0f} px" in warning
    assert f"{wrong[0]:.0f} px" in warning
    assert "%" in warning


def test_a_focal_length_that_few_turns_tell_is_doubted() -> None:
    items = room(1.3)[:30]
    tracker, _, _ = track_guessing(items)
    values = tracker.stats.values
    off = abs(values["focal_px"] / (1.3 * SIZE[1]) - 1.0)
    doubted = any("uncertain" in w or "guess is kept" in w for w in tracker.stats.warnings)
    assert doubted or off < 0.03
