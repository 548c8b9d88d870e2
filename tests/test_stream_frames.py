"""Frames of a sender whose clock is set: the stream's time goes on, the stamp stays the sender's."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from msgs import Frame
from mvsgs_core.mapping.keyframe_checks import checked_keyframe
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.stats import Stats
from nodes.stream_frames import StreamFrames


def frame(number: int, timestamp: float, stamp: int = 0) -> Frame:
    image = np.random.default_rng(number).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return Frame(number, timestamp, image, np.array([25.0, 25.0, 15.5, 11.5]), stamp=stamp)


def test_a_stamp_is_by_the_senders_clock_wherever_that_was_set_to() -> None:
    stream = StreamFrames(Stats(), "robot")
    own = [1.76e9 + k / 10 for k in range(5)]
    own += [own[0] - 3600.0 + k / 10 for k in range(30)]  # set back by an hour: some are taken for late ones first
    taken = [found for k, at in enumerate(own) if (found := stream.accept(frame(k, at))) is not None]
    assert len(taken) > 15
    assert (np.diff([found.timestamp for found in taken]) > 0).all()
    for found in taken:
        assert abs(found.stamp - 1e9 * own[found.index]) < 1000
        assert found.stamp % 1000 == 0


def test_a_stamp_that_is_given_stays_and_a_time_of_no_clock_gives_none() -> None:
    stream = StreamFrames(Stats(), "robot")
    given = [frame(0, -2.0), frame(1, 0.5, stamp=1_760_000_000_123_456_789), frame(2, 1e10)]
    taken = [stream.accept(each) for each in given[:2]]
    assert [found.stamp for found in taken if found] == [0, 1_760_000_000_123_456_789]
    late = StreamFrames(Stats(), "robot").accept(given[2])
    assert late is not None
    assert late.stamp == 0


def test_each_frame_keeps_the_intrinsics_with_which_it_was_taken() -> None:
    """As autofocus moves them; trackers resample."""
    stats = Stats()
    stream, ours = StreamFrames(stats, "the robot"), frame(0, 0.0).intrinsics
    for k in range(6):
        taken = stream.accept(replace(frame(k, k / 10), intrinsics=(1.0 + 0.01 * k) * ours))
        assert taken is not None
        np.testing.assert_array_equal(taken.intrinsics, (1.0 + 0.01 * k) * ours)
    assert not stats.warnings


@pytest.mark.parametrize(
    ("center", "usable"), [((79.0, 11.5), True), ((81.0, 11.5), False), ((15.5, -35.0), True), ((15.5, -37.0), False)]
)
def test_a_principal_point_that_the_mapper_refuses_is_refused_at_once(
    center: tuple[float, float], usable: bool
) -> None:
    first = replace(frame(0, 0.0), intrinsics=np.array([25.0, 25.0, *center]))
    assert (StreamFrames(Stats(), "robot").accept(first) is not None) == usable
    mapped = RGBDKeyframe(0, first.image, first.intrinsics, np.eye(4), np.ones((24, 32), np.float32))
    assert (checked_keyframe(mapped, Stats()) is not None) == usable


@pytest.mark.parametrize(
    ("unit", "jump", "said"), [(1000.0, 0.0, True), (1.0, 0.0, False), (30.0, 0.0, False), (1.0, 3000.0, False)],
    ids=["milliseconds", "seconds", "a recording played faster", "a clock that is set"],
)  # fmt: skip
def test_stamps_in_milliseconds_are_told(unit: float, jump: float, said: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    now = count(1000.0, 1 / 15)
    stats, came = Stats(), 0.0
    stream = StreamFrames(stats, "the robot")
    monkeypatch.setattr(time, "monotonic", lambda: came)
    for k in range(45):
        came = next(now)
        assert stream.accept(frame(k, unit * k / 15 + (jump if k > 20 else 0.0))) is not None
        assert k > 10 or not stats.warnings  # not at once
    assert any("look like milliseconds" in line for line in stats.warnings) == said
