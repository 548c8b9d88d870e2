"""What a process has freed goes back to the system.

glibc keeps freed memory where blocks of many sizes come and go, as a mapper's buffers do while its map grows: a process
would come to hold half again as much as it uses.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable

PERIOD = 0.2  # s between two returns, at least
SHARE = 0.02  # of the time that returns may take: where one is slow, they are rarer
LARGE = 2**20  # bytes of a block that goes back as soon as it is freed, where a process asks for that
_MMAP_THRESHOLD = -3  # glibc's name of it in mallopt


def return_large_blocks() -> None:
    """From now on a block of at least `LARGE` bytes goes back to the system when it is freed.

    Otherwise glibc raises that limit to the largest block that was freed, up to 32 MiB: what a growing map leaves
    behind then stays, in pieces that the next, larger block does not fit in. Fresh memory costs time each time; this is
    for who keeps large blocks for long. Does nothing where the C library has no mallopt.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, LARGE)


class FreedMemory:
    """Give it a chance after each message, and in long work.

    Does nothing where the C library has no malloc_trim (macOS, musl).
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._clock = clock
        self._next = clock() + PERIOD

    def give_back(self) -> bool:
        """Whether it was time to, and possible."""
        start = self._clock()
        if self._trim is None or start < self._next:
            return False
        self._trim(0)
        end = self._clock()
        self._next = end + max(PERIOD, (end - start) / SHARE)
        return True
