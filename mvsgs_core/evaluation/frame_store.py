"""Frames that wait on disk until the map is finished: memory stays flat however long the run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class StoredArray:
    offset: int
    dtype: np.dtype
    shape: tuple[int, ...]


class FrameStore:
    """Arrays by key in one unnamed temporary file, which goes when the process does, however that ends."""

    def __init__(self, folder: Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - lives as long as the store
        self._stored: dict[tuple[str, int], StoredArray] = {}

    def put(self, kind: str, index: int, array: np.ndarray) -> None:
        offset = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(array).data)
        self._stored[kind, index] = StoredArray(offset, array.dtype, array.shape)

    def get(self, kind: str, index: int) -> np.ndarray | None:
        stored = self._stored.get((kind, index))
        if stored is None:
            return None
        self._file.seek(stored.offset)
        count = int(np.prod(stored.shape))
        return np.frombuffer(self._file.read(count * stored.dtype.itemsize), stored.dtype).reshape(stored.shape)

    def indices(self, kind: str) -> Iterator[int]:
        return (index for k, index in self._stored if k == kind)

    def close(self) -> None:
        self._file.close()
