"""Arrays by frame that wait on disk until the map is finished: memory stays flat however long the run.

Compressed without loss, in a few milliseconds a frame: differences between neighbors (images) or planes of bytes
(floats), then Zstandard. PNG makes images no smaller and takes six times as long.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
import zstandard


@dataclass(frozen=True)
class Stored:
    """Where the arrays of one frame lie in the file: one after the other."""

    offset: int
    parts: dict[str, tuple[int, np.dtype, tuple[int, ...]]]  # by name: compressed bytes, dtype, shape

    @property
    def size(self) -> int:
        return sum(size for size, _, _ in self.parts.values())


class FrameStore:
    """Arrays by frame and name in one unnamed temporary file, which goes when the process does, however that ends."""

    def __init__(self, folder: Path | None = None) -> None:
        """folder: where the file lies; the system's temporary folder if None. It is made with the first frame."""
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._stored: dict[int, Stored] = {}
        self._end = 0

    @property
    def size(self) -> int:
        """Of the file, in bytes."""
        return self._end

    def __contains__(self, index: int) -> bool:
        return index in self._stored

    def put(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Stores the arrays of a frame in the place of those that it had.

        Raises OSError where the disk takes no more; what was stored before stays.
        """
        packed = {name: _packed(array) for name, array in arrays.items()}
        data = b"".join(packed.values())
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115 - lives as long as this
        try:
            self._write(data, self._end)
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._end)  # others may need what room there was
            raise
        parts = {name: (len(packed[name]), array.dtype, array.shape) for name, array in arrays.items()}
        replaced = index in self._stored
        self._stored[index] = Stored(self._end, parts)
        self._end += len(data)
        if replaced and self._end > 2 * sum(stored.size for stored in self._stored.values()):
            self.keep(self._stored)  # more than half of the file was replaced

    def get(self, index: int, name: str) -> np.ndarray | None:
        stored = self._stored.get(index)
        if stored is None or name not in stored.parts:
            return None
        offset = stored.offset
        for part, (size, dtype, shape) in stored.parts.items():
            if part == name:
                return _unpacked(self._read(size, offset), dtype, shape)
            offset += size
        return None

    def keep(self, indices: Iterable[int]) -> None:
        """Forgets all other frames and gives their room back: the rest moves together within the file."""
        wanted, end = set(indices), 0
        for index, stored in sorted(self._stored.items(), key=lambda item: item[1].offset):
            del self._stored[index]
            if index not in wanted:
                continue
            if stored.offset != end:
                self._write(self._read(stored.size, stored.offset), end)
            self._stored[index] = replace(stored, offset=end)
            end += stored.size
        self._end = end
        if self._file is not None:
            self._file.truncate(end)

    def close(self) -> None:
        """Gives the room on disk back; what was stored is gone."""
        if self._file is not None:
            self._file.close()
        self._file, self._stored, self._end = None, {}, 0

    def __del__(self) -> None:
        self.close()

    def _write(self, data: bytes, offset: int) -> None:
        assert self._file is not None
        rest = memoryview(data)
        while rest:  # a disk that fills up takes a part first, and refuses the rest
            written = os.pwrite(self._file.fileno(), rest, offset)
            rest, offset = rest[written:], offset + written

    def _read(self, size: int, offset: int) -> bytes:
        assert self._file is not None
        return os.pread(self._file.fileno(), size, offset)


def _packed(array: np.ndarray) -> bytes:
    if array.dtype == np.uint8 and array.ndim > 1:
        plain = array.copy()
        plain[:, 1:] -= array[:, :-1]  # wraps around
    else:
        values = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        plain = np.ascontiguousarray(values.reshape(-1, array.dtype.itemsize).T)
    return zstandard.ZstdCompressor(level=1).compress(np.ascontiguousarray(plain).data)


def _unpacked(data: bytes, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    plain = np.frombuffer(zstandard.ZstdDecompressor().decompress(data), np.uint8)
    if dtype == np.uint8 and len(shape) > 1:
        return np.asarray(np.cumsum(plain.reshape(shape), axis=1, dtype=np.uint8))
    return np.ascontiguousarray(plain.reshape(dtype.itemsize, -1).T).reshape(-1).view(dtype).reshape(shape)
