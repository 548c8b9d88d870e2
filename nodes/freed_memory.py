"""What a process has freed goes back to the system.

glibc keeps freed memory where blocks of many sizes come and go, as a mapper's buffers do while its map grows: a process
would come to hold half again as much as it uses.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable

PERIOD = 1.0  # s between two returns: one takes a few milliseconds


class FreedMemory:
    """Give it a chance after each message. Does nothing where the C library has no malloc_trim (macOS, musl)."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._clock = clock
        self._last = clock()

    def give_back(self) -> bool:
        """Whether it was time to, and possible."""
        now = self._clock()
        if self._trim is None or now - self._last < PERIOD:
            return False
        self._last = now
        self._trim(0)
        return True
