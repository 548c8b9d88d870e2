"""Whether the sender of a live stream is there: its loss is said at once, its return too, both are counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from mvsgs_core.stats import Stats

SILENT = 2.0  # s without a frame after which a stream that came faster counts as lost
SLOW = 5.0  # times the last interval: a stream of few frames is no silent one
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 2.0  # s between two attempts to reach a sender; each is twice the one before


def pauses(timeout_s: float) -> Iterator[float]:
    """Seconds to wait before each attempt, growing; short enough for several of them within the timeout."""
    pause = FIRST_PAUSE
    while True:
        yield min(pause, LONGEST_PAUSE, timeout_s / 4)
        pause *= 2


class Presence:
    """Of one sender, whom warnings name as `sender`. It is waited for up to `timeout_s` seconds.

    In the counts: how often it was `lost`, and for how many `seconds_lost` in all.
    """

    def __init__(
        self, stats: Stats, sender: str, timeout_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._stats = stats
        self._sender = sender
        self._timeout = timeout_s
        self._clock = clock
        self._came: float | None = None  # the last frame
        self._interval = 0.0  # s between the last two
        self._lost_since: float | None = None

    def came(self) -> None:
        """A frame came."""
        now = self._clock()
        if self._lost_since is not None:
            away = now - self._lost_since
            self._stats.count("seconds_lost", away)
            self._stats.warn(f"{self._sender} is back after {away:.1f} s (loss {self._losses})")
        elif self._came is not None:
            self._interval = now - self._came
        self._came, self._lost_since = now, None

    def wait(self, since: float) -> None:
        """Nothing came although it was waited for since then (by the clock), or since the last frame."""
        silence = min(max(SILENT, SLOW * self._interval), self._timeout / 2)
        if self._came is not None and self._clock() - max(since, self._came) >= silence:
            self.lost(f"nothing came for {silence:.3g} s")

    def lost(self, why: str) -> None:
        """It is gone; said once until a frame comes."""
        if self._lost_since is None:
            self._lost_since = self._clock()
            self._stats.count("lost")
            self._stats.warn(
                f"{self._sender} was lost ({why}; loss {self._losses}): it is waited for up to {self._timeout:g} s"
            )

    @property
    def _losses(self) -> int:
        return int(self._stats.counts["lost"])
