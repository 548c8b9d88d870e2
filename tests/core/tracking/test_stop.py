"""A camera that stands still in the middle of a stream: for long, and with bad frames among those that it takes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.tracker import Tracker
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import synthetic

pytestmark = pytest.mark.slow
STOP = 30  # frame that the camera stops at


def stopped() -> Tracker:
    tracker = Tracker()
    for item in synthetic(frames=80)[: STOP + 1]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    assert tracker.phase is Phase.TRACKING
    return tracker


def show(tracker: Tracker, images: list[np.ndarray]) -> list[TrackingState]:
    last = synthetic(frames=80)[STOP]
    return [
        tracker.add(last.index + n, last.timestamp + n / 20.0, image, last.intrinsics).state
        for n, image in enumerate(images, len(tracker.session.records) - STOP)
    ]


@pytest.mark.parametrize("bad", ["covered", "noise"])
def test_a_bad_frame_costs_no_other_than_itself(bad: str) -> None:
    view = synthetic(frames=80)[STOP].image
    noise = np.random.default_rng(0).integers(0, 255, view.shape, dtype=np.uint8)
    tracker = stopped()
    tracked, lost = TrackingState.TRACKED, TrackingState.LOST
    states = show(tracker, [view, noise if bad == "noise" else np.zeros_like(view), view, view])
    assert states == [tracked, lost, tracked, tracked]
    assert tracker.phase is Phase.TRACKING
    assert tracker.newest_pose() is not None
    assert tracker.session.relocalizer.lost_frames == 0
    assert [record.same_as for record in tracker.session.records[-2:]] == [STOP, STOP]
    list(tracker.finish())
    np.testing.assert_array_equal(tracker.trajectory().state[-4:], states)


def test_a_camera_that_rests_where_its_map_began_is_as_sure_as_its_keyframe() -> None:
    tracker = Tracker()
    for item in synthetic(frames=80):
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        if tracker.phase is Phase.TRACKING:
            break
    last = tracker.session.records[-1].index
    assert last in tracker.session.graph.keyframes
    for n in range(2):
        pose = tracker.newest_pose()
        assert pose is not None
        assert pose.confidence == 1.0
        if n == 0:
            tracker.add(last + 1, item.timestamp + 0.05, item.image, item.intrinsics)
            assert tracker.session.records[-1].same_as == last


class Counted(list[FrameRecord]):
    """How often one was looked at."""

    reads = 0

    def __getitem__(self, key: Any) -> Any:
        assert not isinstance(key, slice), "a copy of many"
        self.reads += 1
        return super().__getitem__(key)

    def __reversed__(self) -> Any:
        raise AssertionError("a walk through all")


def test_the_pose_of_a_frame_takes_no_longer_after_a_long_stop() -> None:
    tracker = stopped()
    records = Counted(tracker.session.records)
    last = records[-1]
    records += [replace(last, index=n, same_as=STOP) for n in range(STOP + 1, 20_000)]
    tracker.session.records = records
    records.reads = 0
    pose = tracker.newest_pose()
    assert pose is not None
    np.testing.assert_array_equal(pose.world_from_cam, pose.world_from_previous)
    assert show(tracker, [synthetic(frames=80)[STOP].image]) == [TrackingState.TRACKED]
    assert records[-1].same_as == STOP
    assert records.reads < 200
