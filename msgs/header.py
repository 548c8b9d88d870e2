"""The msgpack of a frame's header, read within limits: its values are counted before an object is made of any."""

from __future__ import annotations

import struct
from typing import Any

import msgpack

MAX_TEXT = 64 * 2**10  # bytes of one string

_LENGTH = {1: struct.Struct(">B"), 2: struct.Struct(">H"), 4: struct.Struct(">I")}
_FIXED = {0xCA: 4, 0xCB: 8} | {0xCC + i: 1 << i for i in range(4)} | {0xD0 + i: 1 << i for i in range(4)}  # bytes
_TEXTS = {0xD9: 1, 0xDA: 2, 0xDB: 4}  # bytes of the length
_LISTS, _MAPS = {0xDC: 2, 0xDD: 4}, {0xDE: 2, 0xDF: 4}
_SINGLE = frozenset({0xC0, 0xC2, 0xC3})  # nil, false, true


def unpack(header: memoryview, max_values: int) -> Any:
    """The one object that the header is. Raises ValueError for what is no msgpack and for more than `max_values`."""
    _check(bytes(header), max_values)
    try:
        return msgpack.unpackb(header, strict_map_key=True, max_str_len=MAX_TEXT, max_bin_len=0, max_ext_len=0)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise ValueError(str(error) or type(error).__name__) from None


def _check(data: bytes, max_values: int) -> None:
    """A false length, or a million empty lists, would take time and memory long before msgpack is through with it."""
    at, read, known, end = 0, 0, 1, len(data)  # byte; values read, and those that are known to come
    while read < known:
        if at >= end:
            raise ValueError("it is cut off")
        code = data[at]
        at += 1
        read += 1
        if code < 0x80 or code >= 0xE0 or code in _SINGLE:
            continue
        if code < 0x90:
            known += 2 * (code & 15)
        elif code < 0xA0:
            known += code & 15
        elif code < 0xC0:
            at += code & 31
        elif code in _FIXED:
            at += _FIXED[code]
        else:
            size = _TEXTS.get(code) or _LISTS.get(code) or _MAPS.get(code)
            if size is None:
                raise ValueError(f"byte {code:#x} begins no value of a header")
            if size > end - at:
                raise ValueError("it is cut off")
            (length,) = _LENGTH[size].unpack_from(data, at)
            at += size
            if code in _TEXTS:
                at += length
            else:
                known += length if code in _LISTS else 2 * length
        if known > max_values:
            raise ValueError(f"more than {max_values} values")


__all__ = ["MAX_TEXT", "unpack"]
