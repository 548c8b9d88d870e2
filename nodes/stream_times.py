"""Timestamps of a stream that somebody else makes: made to go forward, whatever their clock does."""

from __future__ import annotations

import time
from collections.abc import Callable

LATEST = 1e11  # s: the year 5138; what is beyond it is in other units than seconds, and loses fractions of them
LEAP = 3600.0  # s that a stream may jump ahead by itself: a recording with gaps is no broken clock
FASTEST_PLAYBACK = 1000.0  # times the recorded rate
MIN_STEP = 1e-4  # s between two frames where they came at once


class StreamTimes:
    """Times of frames as they come. Where the sender's clock stands still, goes back or leaps ahead, the stream's time
    goes on by as much as passed here, and from there by the sender's clock again."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.repaired = 0
        self._clock = clock
        self._shift = 0.0  # s added to the sender's times
        self._last: float | None = None
        self._came = 0.0

    def accept(self, timestamp: float) -> float | None:
        """The time of the frame that came now, later than all before it; None for what is no time in seconds."""
        if not abs(timestamp) <= LATEST:
            return None
        now = self._clock()
        shown = timestamp + self._shift
        if self._last is not None:
            passed = now - self._came
            if not 0 < shown - self._last <= LEAP + FASTEST_PLAYBACK * passed:
                self.repaired += 1
                shown = self._last + max(passed, MIN_STEP)
                self._shift = shown - timestamp
        self._last, self._came = shown, now
        return shown


__all__ = ["LATEST", "StreamTimes"]
