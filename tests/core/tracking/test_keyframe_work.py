"""A keyframe that the map contradicts leaves nothing behind, and a bundle adjustment that fails is counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.steps import Steps
from mvsgs_core.tracking.tracker import Tracker
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import members_of, synthetic

pytestmark = pytest.mark.slow

TAKEN_BACK, FAILED = "keyframes taken back", "failed bundle adjustments"


def add(tracker: Tracker, number: int, view: int | None = None) -> TrackingState:
    """The next frame of the room, or another view of it in its place."""
    item = synthetic(frames=80)[number]
    image = item.image if view is None else synthetic(frames=80)[view].image
    return tracker.add(item.index, item.timestamp, image, item.intrinsics).state


def tracking() -> Tracker:
    """After the first 30 frames, more than the keyframes of a start."""
    tracker = Tracker()
    for number in range(30):
        add(tracker, number)
    assert tracker.phase is Phase.TRACKING
    return tracker


def solved(tracker: Tracker) -> dict[int, tuple[np.ndarray, ...]]:
    keyframes = tracker.session.graph.keyframes
    return {i: (k.cam_from_world, k.inverse_depth, k.information, k.static) for i, k in keyframes.items()}


def until_one_is_taken_back(tracker: Tracker, monkeypatch: pytest.MonkeyPatch) -> int:
    """The map contradicts the next keyframe, and the camera is not found in it; the frame."""
    with monkeypatch.context() as contradicted:
        contradicted.setattr(tracker.session.local_map, "agreement", lambda index: 0.0)
        contradicted.setattr(tracker.session.relocalizer, "relocalize", lambda frame: None)
        for number in range(30, 50):
            state = add(tracker, number)
            if tracker.stats.counts.get(TAKEN_BACK):
                assert state == TrackingState.LOST
                return number
    raise AssertionError("no keyframe was to be made")


def test_a_keyframe_that_is_taken_back_leaves_the_map_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracking()
    before = solved(tracker)
    number = until_one_is_taken_back(tracker, monkeypatch)
    after = solved(tracker)
    assert number not in after
    assert after.keys() == before.keys()
    for index, arrays in before.items():
        for then, now in zip(arrays, after[index]):
            np.testing.assert_array_equal(then, now)
    assert not any(number in pair for pair in tracker.session.graph.edges)


def test_a_camera_that_stops_where_it_was_lost_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracking()
    number = until_one_is_taken_back(tracker, monkeypatch)
    assert tracker.phase is Phase.RELOCALIZING
    assert add(tracker, number + 1, number) == TrackingState.TRACKED
    assert tracker.stats.counts["relocalized"] == 1
    assert add(tracker, number + 2, number) == TrackingState.TRACKED


def test_a_camera_that_stays_lost_where_it_stopped_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracking()
    number = until_one_is_taken_back(tracker, monkeypatch)
    monkeypatch.setattr(tracker.session.relocalizer, "relocalize", lambda frame: None)
    for n in range(1, tracker.config.relocalization.patience):
        assert tracker.phase is Phase.RELOCALIZING
        add(tracker, number + n, number)
    assert tracker.phase is Phase.INITIALIZING


def test_a_stream_that_ends_with_one_that_is_none_after_five_lost_frames_reports_no_pose_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is the sixth: a part of its own begins with it, which never comes to be."""
    tracker, noise = tracking(), np.random.default_rng(0)
    while not (last := tracker.session._tail.last(tracker.session.choice)):
        add(tracker, len(tracker.session.records))
    monkeypatch.setattr(tracker.session.local_map, "agreement", lambda index: 0.0)
    monkeypatch.setattr(tracker.session.relocalizer, "relocalize", lambda frame: None)
    monkeypatch.setattr(tracker.session.recovery, "fill_in", lambda records: 0)
    item, before = synthetic(frames=80)[0], set(tracker.session.graph.keyframes)
    for _ in range(tracker.config.relocalization.patience - 1):
        image, number = noise.integers(0, 256, item.image.shape, np.uint8), len(tracker.session.records)
        assert tracker.add(number, number / 20.0, image, item.intrinsics).state == TrackingState.LOST
    list(tracker.finish())
    assert tracker.stats.counts[TAKEN_BACK] == 1
    assert set(tracker.session.graph.keyframes) == before
    trajectory = tracker.trajectory()
    assert trajectory.state[last[0].index] != TrackingState.TRACKED
    assert not trajectory.posed[last[0].index]


def test_each_window_whose_bundle_adjustment_fails_is_counted_and_told_of_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, first = Tracker(), synthetic(frames=80)[0]
    window = tracker.begin((240, 320), first.intrinsics).local_map
    adjust = window.adjust_window
    monkeypatch.setattr(window, "adjust_window", lambda newest: replace(adjust(newest), failure="in a test"))
    failed = []
    for number in range(30):
        before = tracker.stats.counts.get("keyframes", 0)
        add(tracker, number)
        if tracker.stats.counts.get("keyframes", 0) > before:
            failed.append(tracker.stats.counts.get(FAILED))
    assert failed == list(range(1, len(failed) + 1)), "one of the start, and one of each keyframe"
    assert len(failed) > 1
    assert list(tracker.stats.warnings) == ["local bundle adjustment failed: in a test"]


def test_background_work_that_fails_is_counted_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracking()

    def failing(segment: int) -> Steps[str]:
        yield
        return "in a test"

    monkeypatch.setattr(tracker.session.back_end, "working", failing)
    before = len(members_of(tracker))
    for number in range(30, 40):
        add(tracker, number)
    assert tracker.stats.counts[FAILED] == len(members_of(tracker)) - before > 0
    assert list(tracker.stats.warnings) == ["background bundle adjustment failed: in a test"]
