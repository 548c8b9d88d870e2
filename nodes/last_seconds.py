"""The end of a live stream: how long the map may settle before it is handed out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

LAST_SECONDS = 2.0  # after the last keyframe of a live stream the map is handed out, before its refinement


class LastSeconds:
    """By a clock that nobody sets: what another host's says of a capture can only shorten the time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._came = self._until = -math.inf

    def came(self, captured: float) -> None:
        """A keyframe came. captured: by the wall clock of the camera's host."""
        self._came = self._clock()
        self._until = max(self._until, self._came + min(LAST_SECONDS, captured + LAST_SECONDS - time.time()))

    @property
    def running(self) -> bool:
        """Whether the last keyframe has only just come."""
        return self._clock() - self._came < LAST_SECONDS

    def passed(self) -> Iterator[float]:
        """While they last, the part of the time from now on that has passed."""
        start = now = self._clock()
        while now < self._until:
            yield (now - start) / (self._until - start)
            now = self._clock()


__all__ = ["LAST_SECONDS", "LastSeconds"]
