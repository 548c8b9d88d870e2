"""How far apart the keyframes of a live stream are: farther where the tracker takes too much of the machine.

A keyframe costs the tracker as much as several frames, and each later stage its part. Where the tracker takes more than
its share of the processor's time, keyframes get farther apart, by degrees, and closer together again where it takes
less. Poses are hardly worse for it, and no other stage is asked.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from mvsgs_core.machine import available_cores

SHARE = 0.5  # of all cores: the map needs the rest
SATURATED = 0.9  # of a core: the work is that of one thread, which must be able to catch up
WIDEST = 2.4  # times the usual flow, at most: two keyframes then still share seven eighths of their images
RATE = 2.0  # by which the factor's logarithm grows in a second in which the tracker takes twice what it may
PERIOD = 0.5  # s over which its load is taken, at least


class KeyframeSpacing:
    """A factor on the usual flow between keyframes, for as long as somebody looks at each frame."""

    def __init__(
        self,
        share: float,
        clock: Callable[[], float] = time.monotonic,
        spent: Callable[[], float] = time.thread_time,
    ) -> None:
        """share: of a core's time that the tracker may take. clock, spent: seconds that passed, and that it took."""
        self.share = share
        self.factor = 1.0  # now
        self.spared = 0.0  # keyframes, about, that the usual flow would have made beside those that were
        self._clock, self._spent = clock, spent
        self._then: tuple[float, float] | None = None

    def look(self) -> None:
        """To be called frame by frame, in the tracker's thread."""
        now = self._clock(), self._spent()
        self._then = self._then or now
        passed, taken = now[0] - self._then[0], now[1] - self._then[1]
        if passed >= PERIOD:
            self._then = now
            step = RATE * (taken / passed / self.share - 1.0) * passed
            self.factor = min(max(self.factor * math.exp(min(step, 1.0)), 1.0), WIDEST)

    def made(self, flow: float, usual: float) -> None:
        """A keyframe, after this flow where another is usual."""
        self.spared += max(min(self.factor, flow / usual) - 1.0, 0.0) if usual > 0.0 else 0.0


def spacing_of(share: float | None, cores: int | None = None) -> KeyframeSpacing:
    """share: of a core's time; None: `SHARE` of all cores (None: of this process), but no more than one thread can."""
    return KeyframeSpacing(min(SHARE * (cores or available_cores()), SATURATED) if share is None else share)


__all__ = ["KeyframeSpacing", "spacing_of"]
