"""A camera that goes around again: old keyframes are followed, and hardly any are added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvsgs_core.tracking.places.covisibility import CovisibilityConfig
from mvsgs_core.tracking.tracker import TrackerConfig
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import ate, synthetic, track

ROUND = 80  # frames of a round: every third of 240 of the room's loop


def test_a_second_round_makes_few_keyframes_and_is_as_accurate() -> None:
    once = synthetic(frames=240, loop=True, stride=3)
    items = [replace(once[n % ROUND], index=n, timestamp=n / 7.0) for n in range(2 * ROUND)]
    tracker, trajectory, _ = track(items, TrackerConfig(covisibility=CovisibilityConfig(min_keyframes=24)))
    first, second = (int(half.sum()) for half in np.split(trajectory.keyframe, [ROUND]))
    assert first >= 24
    assert second <= 0.2 * first
    assert tracker.stats.skipped["keyframes spared by covisible ones"] >= 5
    assert np.isfinite(trajectory.world_from_cam).all(), "frames that see what old keyframes see have poses"
    assert (trajectory.state == TrackingState.TRACKED).all()
    assert tracker.publisher.published == set(trajectory.index[trajectory.keyframe].tolist()), (
        "no keyframe that was published is taken back"
    )
    error, length = ate(trajectory, items)
    assert error < 0.0003 * length
    again, length = ate(trajectory, items, trajectory.index >= ROUND)
    assert again < 0.0006 * length, "of the round that has hardly a keyframe of its own"
