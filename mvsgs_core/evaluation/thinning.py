"""Frames of a stream of unknown length, thinned out evenly while it goes on: bounded in number and in bytes on disk.

Each frame has a place in [0, 1), the fractional part of its number times the golden ratio: the multiples of no other
number lie as evenly, whatever their step. Kept are those whose place is below a fraction, which is halved where they
become too many. So which frames stay depends on the stream alone, and what two kinds of frames keep is nested.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from mvsgs_core.frame_store import FrameStore
from mvsgs_core.held_out import HELD_OUT_EVERY, is_held_out

T = TypeVar("T")
_GOLDEN = 0x9E3779B97F4A7C15  # of 2^64


class Thinned(Generic[T]):
    """What is kept of one kind of frames: arrays on disk, a note of each in memory."""

    def __init__(self, folder: Path | None, max_frames: int, max_bytes: float) -> None:
        """max_frames: kept; max_bytes: on disk. Both may be exceeded by the frame that is being added."""
        self._store = FrameStore(folder)
        self._max_frames, self._max_bytes = max_frames, max_bytes
        self._fraction = 1.0
        self.notes: dict[int, T] = {}  # by index
        self.seen = 0
        self.too_large = False  # the bound on bytes has bitten
        self.lost = 0  # frames that the disk had no room for
        self.error = ""  # what it said last

    def add(self, index: int, note: T, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes a frame, in the place of the one of this index if there is one; it may be dropped now or later."""
        self.seen += index not in self.notes
        if _place(index) >= self._fraction:
            return
        try:
            self._store.put(index, arrays)
            self.notes[index] = note
            while self.notes and (len(self.notes) > self._max_frames or self._store.size > self._max_bytes):
                self.too_large = self.too_large or len(self.notes) <= self._max_frames
                self._halve()
        except OSError as error:
            self.lost += 1
            self.error = error.strerror or str(error)
            self.notes = {i: kept for i, kept in self.notes.items() if i in self._store}

    def get(self, index: int, name: str) -> np.ndarray | None:
        return self._store.get(index, name) if index in self.notes else None

    @property
    def size(self) -> int:
        """On disk, in bytes."""
        return self._store.size

    def close(self) -> None:
        self._store.close()

    def _halve(self) -> None:
        self._fraction /= 2
        self.notes = {index: note for index, note in self.notes.items() if _place(index) < self._fraction}
        self._store.keep(self.notes.keys())


def _place(index: int) -> float:
    """Where a frame stands among those of its kind, held out or not."""
    number = index // HELD_OUT_EVERY if is_held_out(index) else index
    return ((number + 1) * _GOLDEN % 2**64) / 2**64


__all__ = ["Thinned"]
