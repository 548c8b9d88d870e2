"""Memory for frames on their way out, used again when ZeroMQ has sent them.

Fresh memory for every frame costs more than filling it: the kernel clears each page first.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

MIN_BYTES = 64 * 2**10  # below, ZeroMQ copies the frame and frees it at once
MAX_BYTES = 16 * 2**20  # above, a frame is rare, and not worth holding the memory for
PAGE = 4096  # bytes: a header that is a little longer still fits


class Tracker(Protocol):
    """Says whether a frame has left."""

    @property
    def done(self) -> bool: ...


class FramePool:
    """Buffers in the order in which they were sent, the order in which they become free. For one thread."""

    def __init__(self) -> None:
        self._sent: deque[tuple[np.ndarray, Tracker]] = deque()

    def take(self, size: int) -> np.ndarray:
        """At least `size` bytes, of any content."""
        if not MIN_BYTES <= size <= MAX_BYTES:
            return np.empty(size, np.uint8)
        while self._sent and self._sent[0][1].done:
            buffer, _ = self._sent.popleft()
            if size <= buffer.size <= 2 * size:
                return buffer
        return np.empty(-(-size // PAGE) * PAGE, np.uint8)

    def give(self, buffer: np.ndarray, tracker: Tracker) -> None:
        """The buffer is on its way; it is free again when the tracker says so."""
        if MIN_BYTES <= buffer.size <= MAX_BYTES:
            self._sent.append((buffer, tracker))
