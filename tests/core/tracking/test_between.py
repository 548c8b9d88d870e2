"""Frames between keyframes wait for the next one: those that no keyframe will see wait no longer, and few wait."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core.stats import Stats
from mvsgs_core.tracking import initializer
from mvsgs_core.tracking.between import HELD, FramesBetween, _with_neighbors
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.photometer import Photometer
from mvsgs_core.tracking.steps import Steps
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import synthetic


def failing(*_: Any) -> Steps[Any]:
    """A start of keyframes that have no parallax."""
    yield
    return SimpleNamespace(failure="no parallax: in a test")


@pytest.mark.slow
def test_no_more_frames_wait_however_long_there_is_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initializer, "reconstructing", failing)
    config = TrackerConfig(initialization=initializer.InitializationConfig(min_keyframes=2, max_keyframes=3))
    tracker, waited = Tracker(config), 0
    for item in synthetic(frames=80)[:40]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        waiting = tracker.session.initializer.waiting
        assert min(tracker.pending) >= waiting[0]
        waited = max(waited, len(tracker.session.waiting.indices))
    assert waiting[0] > 20, "starts failed and their keyframes went"
    assert waited > 4


def frames_between(limit: int) -> FramesBetween:
    graph = KeyframeGraph(np.array([20.0, 20.0, 8.0, 8.0]))
    return FramesBetween(graph, Photometer(graph, Stats()), limit, 1)


def come(between: FramesBetween, *indices: int) -> None:
    for index in indices:
        image = TrackingImage(index, index / 20.0, np.zeros((16, 16), np.uint8))
        between.add(image, FrameRecord(index, image.timestamp, TrackingState.TRACKED))


def test_a_keyframe_that_is_none_after_all_leaves_no_more_than_the_limit() -> None:
    between = frames_between(limit=2)
    come(between, 1, 2)
    between.end()
    come(between, 3, 4)
    between.reopen()
    assert between.waiting == {1, 2, 3, 4}
    come(between, 6)
    assert len(between.waiting) == 2


def test_frames_before_the_first_keyframe_that_is_left_are_forgotten() -> None:
    between = frames_between(limit=2)
    come(between, 1, 2)
    between.end()
    come(between, 6, 7)
    between.end()
    come(between, 9)
    between.forget_before(4)
    assert between.waiting == {6, 7, 9}
    assert between.close() == {6, 7}


def test_few_frames_wait_with_keyframes_that_wait_themselves_spread_evenly() -> None:
    between = frames_between(limit=8)
    come(between, 1, 2, 3, 4, 6, 7, 8, 9)
    between.end()
    come(between, 11, 12, 13, 14, 16, 17, 18, 19)
    between.end()
    between.hold(2)
    kept = sorted(between.waiting)
    assert len(kept) == 2 * HELD
    assert max(np.diff([0, *kept, 20])) <= 8
    between.forget()
    assert sorted(between.waiting) == kept, "another part of the map begins"
    come(between, 21)
    between.reopen()
    assert between.waiting == {*kept, 21}, "the keyframes are solved"
    assert between.close() == set(kept)


def test_around_a_frame_are_those_that_show_something_else() -> None:
    """Its velocity is that between them, however often an image is shown."""
    records = [
        FrameRecord(n, n / 20.0, TrackingState.TRACKED, same_as=None if n % 4 == 0 else n - n % 4) for n in range(16)
    ]
    assert [r.index for r in _with_neighbors(records, {4})] == [0, 3, 4, 7, 8]
    assert [r.index for r in _with_neighbors(records, {12})] == [8, 11, 12, 15]
