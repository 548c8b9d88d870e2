"""Frames of a sender whose clock is set: the stream's time goes on, the stamp stays the sender's."""

from __future__ import annotations

import numpy as np

from msgs import Frame
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
