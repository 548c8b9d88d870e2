"""A camera that is lost, begins anew, and sees the first part again: the two segments become one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.tracker import Tracker
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import ate

pytestmark = pytest.mark.slow

BEFORE, COVERED = 30, 3


def out_and_back() -> list[Item]:
    """30 frames of a loop, a hand before the lens, a walk from elsewhere back to where it began."""
    room = Synthetic(frames=300, loop=True, threads=1)
    way = [*range(BEFORE), *[BEFORE] * COVERED, *range(110, 30, -2), *range(30, 14, -1)]
    items = [replace(room[k], index=n, timestamp=n / 20.0) for n, k in enumerate(way)]
    for n in range(BEFORE, BEFORE + COVERED):
        items[n] = replace(items[n], image=np.zeros_like(items[n].image))
    return items


def test_a_lost_segment_is_joined_by_a_loop() -> None:
    items = out_and_back()
    tracker = Tracker()
    published: dict[int, int] = {}  # segment of each keyframe when it was published
    states, joined_at, moved, last_published = [], None, set(), {}
    for item in items:
        update = tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        states.append(update.state)
        published |= {index: tracker.keyframe(index).segment for index in update.keyframes}
        if update.correction is not None:
            moved |= set(update.correction.index.tolist()) if joined_at is None else set()
            assert update.correction.segment is not None
            last_published |= dict(zip(update.correction.index.tolist(), update.correction.segment.tolist()))
        if joined_at is None and tracker.stats.counts.get("segments joined"):
            joined_at = item.index
            assert update.correction is not None
            moved = set(update.correction.index.tolist())
    list(tracker.finish())
    trajectory = tracker.trajectory()
    assert all(state == TrackingState.LOST for state in states[BEFORE : BEFORE + COVERED])
    second = {index for index, segment in published.items() if segment == 1}
    assert len(second) >= 6, "there was no segment of its own"
    assert min(second) > BEFORE + COVERED
    assert joined_at is not None
    assert second <= moved | {joined_at}, "the second segment must be published where it lies in the first"
    assert all(last_published[index] == 0 for index in second), "receivers must hear of the join"
    assert tracker.session.publisher.highest_segment == 1  # so that a later loss does not give the number again
    assert set(trajectory.segment[trajectory.keyframe]) == {0}
    assert set(trajectory.segment[np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))]) == {
        0
    }  # one map for the evaluator
    assert not any("segments" in warning for warning in tracker.stats.warnings)
    posed = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    assert posed[: BEFORE - 1].all()
    assert not posed[BEFORE : BEFORE + COVERED].any()
    assert posed[BEFORE + COVERED :].all()
    error, length = ate(trajectory, items)
    assert error < 0.003 * length
