"""How long a test waits: without end to speak of for what must come, and a promise of the product for what is in time.

A test that waits for a condition has a limit that is reached only in failure. A promise ("down within 5 s") is
measured, but what other work on the machine took of that time is not the product's fault.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

LONG = 120.0  # seconds in which whatever must come has come, however busy the machine is
PRESSURE = Path("/proc/pressure/cpu")
BUSY = 6.0  # times as long as promised is too long at any load


def until(condition: Callable[[], object], seconds: float = LONG, what: object = "") -> None:
    """Returns as soon as it holds; `what`, or what it gives when called, is said where it never does."""
    limit = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < limit, what() if callable(what) else what or "waited in vain"
        time.sleep(0.005)


class Stopwatch:
    """Since it was made: seconds, without those in which somebody had to wait for a core of this machine."""

    def __init__(self) -> None:
        self._began, self._waited = time.monotonic(), waited()

    def within(self, seconds: float) -> bool:
        """Whether a promise of so many seconds was kept."""
        elapsed, now = time.monotonic() - self._began, waited()
        if now is None or self._waited is None:  # a system that does not tell how busy it was
            return elapsed < BUSY * seconds
        return elapsed - (now - self._waited) < seconds and elapsed < BUSY * seconds


def waited() -> float | None:
    """Seconds since the system's start in which some process was ready to run and had no core."""
    try:
        return int(re.findall(r"^some .*total=(\d+)", PRESSURE.read_text(), re.MULTILINE)[0]) / 1e6
    except (OSError, IndexError):
        return None
