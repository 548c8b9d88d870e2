"""Recorded frames at their own pace, as a camera would have given them."""

from __future__ import annotations

import time
from collections.abc import Callable


class Playback:
    """Holds frames back until the time at which they were recorded, counted from the first one."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], object] = time.sleep
    ) -> None:  # fmt: skip
        self._clock, self._sleep = clock, sleep
        self._offset: float | None = None  # clock minus timestamp, seconds

    def wait(self, timestamp: float) -> float:
        """Returns when it is time for the frame of this timestamp (seconds); gives when that was, seconds since 1970.

        What is read too late goes out at once: it was due before.
        """
        now = self._clock()
        if self._offset is None:
            self._offset = now - timestamp
        due = timestamp + self._offset
        self._sleep(max(0.0, due - now))
        return time.time() - (self._clock() - due)


__all__ = ["Playback"]
