"""How long a test waits: as good as without end for what must come, as long as promised for what is to be in time."""

from __future__ import annotations

import time
from collections.abc import Callable

LONG = 120.0  # seconds in which whatever must come has come, however busy the machine is


def until(condition: Callable[[], object], seconds: float = LONG, what: object = "") -> None:
    """Returns as soon as it holds; `what`, or what it gives when called, is said where it never does."""
    limit = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < limit, what() if callable(what) else what or "waited in vain"
        time.sleep(0.005)


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._began = time.monotonic()

    def within(self, seconds: float) -> bool:
        """Whether a promise of so many seconds was kept."""
        return time.monotonic() - self._began < seconds
