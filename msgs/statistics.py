"""`End.stats`: what it may hold, so that reading it takes little time and memory whoever wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np

from msgs.header import MAX_TEXT
from mvsgs_core.printable import printable

MAX_ITEMS = 4096  # entries of one list or map
MAX_ENTRIES = 2 * MAX_ITEMS  # of all of them together
MAX_DEPTH = 8  # of maps and lists in each other


def checked(stats: Any) -> dict[str, Any]:
    """A copy in maps with string keys, lists, strings, numbers, booleans and None. Raises ValueError for all else."""
    if not isinstance(stats, Mapping):
        raise ValueError(f"must be a map, not {type(stats).__name__}")
    check = _Check()
    try:
        copy: dict[str, Any] = check.value(stats, MAX_DEPTH)
    except ValueError as error:
        place = printable(".".join(check.path), 100)
        raise ValueError(f"{place}: {error}" if place else str(error)) from None
    return copy


def fits(stats: Mapping[str, Any], max_bytes: int) -> bool:
    """Whether statistics can be sent and take at most so many bytes."""
    try:
        return len(msgpack.packb(checked(stats))) <= max_bytes
    except ValueError:
        return False


class _Check:
    def __init__(self) -> None:
        self.path: list[str] = []  # keys down to the value at hand
        self._entries = 0

    def value(self, value: Any, depth: int) -> Any:
        if value is None or isinstance(value, bool | float):
            return value
        if isinstance(value, str):
            if len(value) > MAX_TEXT // 4 and len(value.encode(errors="replace")) > MAX_TEXT:
                raise ValueError(f"longer than {MAX_TEXT} bytes")
            return value
        if isinstance(value, int):
            if not -(2**63) <= value < 2**63:
                raise ValueError("does not fit 64 bits")
            return int(value)
        if isinstance(value, Mapping | list | tuple):
            return self._entered(value, depth)
        if isinstance(value, np.generic):
            return self.value(value.item(), depth)
        raise ValueError(f"a {type(value).__name__} cannot be sent; use numbers, strings, lists and maps")

    def _entered(self, value: Mapping[str, Any] | list[Any] | tuple[Any, ...], depth: int) -> Any:
        if depth == 0:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        self._entries += len(value)
        if len(value) > MAX_ITEMS or self._entries > MAX_ENTRIES:
            raise ValueError(f"{len(value)} entries; {MAX_ITEMS} may be in one map or list and {MAX_ENTRIES} in all")
        if not isinstance(value, Mapping):
            return [self.value(item, depth - 1) for item in value]
        copy = {}
        for key, item in value.items():
            if not isinstance(key, str):
                raise ValueError("keys must be strings")
            self.path.append(key)
            copy[key] = self.value(item, depth - 1)
            self.path.pop()
        return copy


__all__ = ["MAX_DEPTH", "MAX_ENTRIES", "MAX_ITEMS", "checked", "fits"]
