"""Arrays and JSON in an uncompressed .npz, written whole and read back with every value checked; nothing is unpickled.

Every part of the file has a CRC-32, and no header makes the reader ask for more memory than the file is long.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

MAX_META = 64 << 20  # bytes of JSON


def write_arrays(
    path: Path, kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    """kind, version: of what is written, which `read_arrays` asks for.

    Raises OSError; ValueError for a number in `meta` that is not finite.
    """
    head = {"format": kind, "version": version, **meta}
    text = json.dumps(head, allow_nan=False).encode()
    with path.open("wb") as file:
        np.savez(file, meta=np.frombuffer(text, dtype=np.uint8), **arrays)  # type: ignore[arg-type]  # stub: allow_pickle


def read_arrays(path: Path, kind: str, version: int, what: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """`meta` and the arrays, read-only. what: such a file in words.

    Raises ValueError for what is no whole file of this kind and version.
    """
    try:
        arrays = _members(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RuntimeError, EOFError, LookupError, struct.error, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    text = arrays.pop("meta", np.zeros(0, np.uint8)).tobytes()
    if not 0 < len(text) <= MAX_META:
        raise ValueError(f"{path} is no {what}")
    try:
        meta = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(meta, dict) or meta.get("format") != kind:
        raise ValueError(f"{path} is no {what}")
    if meta.get("version") != version:
        raise ValueError(f"{path} has version {meta.get('version')!r} of the format: this program reads {version}")
    return meta, arrays


class Arrays:
    """The arrays of a file, each checked as it is taken. Every method raises ValueError for what does not fit."""

    def __init__(self, arrays: Mapping[str, np.ndarray], prefix: str = "") -> None:
        self._arrays, self._prefix = arrays, prefix

    def of(self, prefix: str) -> Arrays:
        return Arrays(self._arrays, f"{self._prefix}{prefix}/")

    def __contains__(self, name: str) -> bool:
        return self._prefix + name in self._arrays

    def take(self, name: str, dtype: type, shape: tuple[int | None, ...], *, nan: bool = False) -> np.ndarray:
        """An array of this dtype and shape (None: any size), finite unless NaN is allowed."""
        full = self._prefix + name
        value = self._arrays.get(full)
        if value is None:
            raise ValueError(f"{full} is missing")
        fits = len(value.shape) == len(shape) and all(s is None or s == n for s, n in zip(shape, value.shape))
        if value.dtype != dtype or not fits:
            wanted = f"{np.dtype(dtype)} {shape}"
            raise ValueError(f"{full} is {value.dtype} {value.shape}: expected {wanted}")
        if value.dtype.kind == "f" and (np.isinf(value).any() or (not nan and np.isnan(value).any())):
            raise ValueError(f"{full} has values that are not finite")
        return value


def _members(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz: never more memory than the file is long, whatever its headers say."""
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise ValueError(f"{entry.filename!r} is compressed or encrypted")
            if entry.file_size > path.stat().st_size:
                raise ValueError(f"{entry.filename!r} is longer than the file")
            arrays[entry.filename.removesuffix(".npy")] = _array(archive.read(entry), entry.filename)
    return arrays


def _array(data: bytes, name: str) -> np.ndarray:
    """Of the bytes of an .npy."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name!r} has another version of the .npy format")
    shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or (by_column and len(shape) > 1):
        raise ValueError(f"{name!r} has an array of a kind that no such file has")
    if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name!r} has another size than it says")
    return np.frombuffer(data, dtype=dtype, offset=stream.tell()).reshape(shape)


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} in its JSON")


__all__ = ["MAX_META", "Arrays", "read_arrays", "write_arrays"]
