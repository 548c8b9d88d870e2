"""Timestamps of a stream that somebody else makes: made to go forward, whatever their clock does."""

from __future__ import annotations

import time
from collections.abc import Callable

LATEST = 1e11  # s: the year 5138; what is beyond it is in other units than seconds, and loses fractions of them
LEAP = 3600.0  # s that a stream may jump ahead by itself: a recording with gaps is no broken clock
FASTEST_PLAYBACK = 1000.0  # times the recorded rate
MIN_STEP = 1e-4  # s between two frames where they came at once; what is nearer is the same time
CLEARLY = 5.0  # times as far off what passed here: stamps are given twice more often than clocks stand still
ENOUGH = 5  # frames in a row that do not follow from those before: their clock jumped
PATIENCE = 1.0  # s of such frames, where they come slowly


class StreamTimes:
    """Times of frames as they come.

    A frame from before the last one is late, one from hours after it no better. Where several in a row are, it is the
    sender's clock that was set, as when its program starts again: the stream's time then goes on by as much as passed
    here, and from there by the sender's clock again. So it does where that clock stands still. Where it then goes on as
    if it had not, as where one stamp was given twice, the stream's time goes on by it as before.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: by which a frame comes, seconds; of a recording, the recorder's."""
        self.repaired = 0
        self._clock = clock
        self._shift = 0.0  # s added to the sender's times
        self._before: tuple[float, float, float] | None = None  # of a standstill: shift, time and coming, at its begin
        self._last: float | None = None
        self._stamp = 0.0  # of the last one, by the sender's clock
        self._came = 0.0
        self._odd = 0  # frames in a row that did not follow
        self._odd_since = 0.0

    def accept(self, timestamp: float, restarted: bool = False) -> float | None:
        """The time of the frame that came now, later than all before it; None for one that does not follow or is at
        no time in seconds. restarted: it is the first of a sender that began anew."""
        if not abs(timestamp) <= LATEST:
            return None
        now = self._clock()
        shown = timestamp + self._shift
        if self._last is not None:
            passed, step = now - self._came, timestamp - self._stamp
            if not MIN_STEP <= step <= LEAP + FASTEST_PLAYBACK * passed:
                if not restarted and abs(step) >= MIN_STEP and not self._jumped(now):
                    return None
                self.repaired += 1
                stands = not restarted and abs(step) < MIN_STEP
                self._before = (
                    (self._before or (self._shift, self._stamp + self._shift, self._came)) if stands else None
                )
                shown = self._last + max(passed, MIN_STEP)
                self._shift = shown - timestamp
            elif self._before is not None:
                shift, begin, came = self._before
                expected = begin + now - came
                if abs(timestamp + shift - expected) < CLEARLY * abs(shown - expected):  # stamps stood still, no clock
                    self._shift, shown = shift, timestamp + shift
                self._before = None
            shown = max(shown, self._last + MIN_STEP)  # one that stood still was shown when it came, perhaps later
        self._last, self._stamp, self._came, self._odd = shown, timestamp, now, 0
        return shown

    def _jumped(self, now: float) -> bool:
        """Whether it is the clock: enough frames in a row do not follow."""
        self._odd += 1
        if self._odd == 1:
            self._odd_since = now
        return self._odd >= ENOUGH or (self._odd > 1 and now - self._odd_since >= PATIENCE)


__all__ = ["LATEST", "LEAP", "StreamTimes"]
