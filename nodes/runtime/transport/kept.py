"""What a publisher keeps of what it has sent, for a reader that is started again in the midst of a run."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from msgs.codec import AGAIN

RECENT = 16  # messages: the keyframes that stereo and fusion hold in their windows, and some more
BUFFERS = 3  # times the buffer: here, in ZeroMQ on the other host, and in the reader
ON_THE_WAY = 16 * 2**20  # bytes that the kernels of both hosts may hold: of small messages that is many
MAX_BYTES = 256 * 2**20  # of one topic


class Kept:
    """The newest messages of a topic: as many as a reader can have had and not worked off, and those before them that
    it needs beside, within a bound of bytes."""

    def __init__(self, buffer: int) -> None:
        """buffer: messages that the publisher holds for a reader that is behind."""
        self._frames: deque[bytes] = deque()
        self._max_frames = BUFFERS * buffer + RECENT
        self._bytes = 0

    def add(self, frame: memoryview) -> None:
        """A frame that was sent, or would have been to a reader that is away; a copy is kept."""
        self._frames.append(AGAIN + frame[len(AGAIN) :])
        self._bytes += frame.nbytes
        while self._bytes > (ON_THE_WAY if len(self._frames) > self._max_frames else MAX_BYTES):
            self._bytes -= len(self._frames.popleft())

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[bytes]:
        """From the oldest on."""
        return iter(tuple(self._frames))


__all__ = ["Kept"]
