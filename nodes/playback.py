"""Recorded frames at their own pace, as a camera would have given them."""

from __future__ import annotations

import time
from collections.abc import Callable

LONGEST_PAUSE = 60.0  # s between two frames that is waited for: more is a clock that was set, or nobody's wish


class Playback:
    """Holds frames back until the time at which they were recorded, counted from the first one.

    Where timestamps go back, or by more than `LONGEST_PAUSE` ahead, the next frame comes after the usual interval.
    """

    def __init__(
        self,
        warn: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """warn: takes what a user should know."""
        self._warn, self._clock, self._sleep = warn, clock, sleep
        self._last: float | None = None  # timestamp
        self._interval = 0.0  # s between the last two that followed one another
        self._offset = 0.0  # clock minus timestamp, seconds

    def wait(self, timestamp: float) -> float:
        """Returns when it is time for the frame of this timestamp (seconds); gives when that was, seconds since 1970.

        What is read too late goes out at once: it was due before.
        """
        now = self._clock()
        if self._last is None:
            self._offset = now - timestamp
        elif 0.0 <= (step := timestamp - self._last) <= LONGEST_PAUSE:
            self._interval = step
        else:
            self._offset += self._interval - step
            self._warn(
                f"timestamps went back, or ahead by more than {LONGEST_PAUSE:g} s: playing went on after the usual "
                "interval there"
            )
        self._last = timestamp
        due = timestamp + self._offset
        self._sleep(max(0.0, due - now))
        return time.time() - (self._clock() - due)


__all__ = ["Playback"]
