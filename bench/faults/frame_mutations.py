"""Frames that no program of ours would send: good ones damaged, false headers, nesting, Ends and giant fields."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgpack
import numpy as np

import msgs
from msgs import Message
from msgs.codec import MAX_END_HEADER_BYTES, MAX_HEADER_BYTES, VERSION, ArraySpec, array_specs, encode

LARGEST = 1_000_000  # bytes of a mutated frame
ESCAPES = "\x1b]0;owned\x07\x1b[2J\u202e\x00"
_PREFIX = struct.Struct("<4sBBHI")


def good(message_type: type, rng: np.random.Generator) -> Message:
    """A small message of that type with random content."""
    sizes = {name: int(rng.integers(1, 24)) for name in "HWhwKNB"}
    values: dict[str, Any] = {}
    for name, spec in array_specs(message_type).items():
        if isinstance(spec, ArraySpec):
            shape = [dim if isinstance(dim, int) else sizes[dim] for dim in spec.dims]
            values[name] = (rng.random(shape) * 2).astype(spec.dtype)
        else:
            values[name] = {int: 7, float: 0.25, str: "exact", bool: True}.get(spec, {"a": {"b": [1, 2.5, None, "c"]}})
    message: Message = message_type(**values)
    return message


def mutated(rng: np.random.Generator, messages: Sequence[Message] = ()) -> Iterator[bytes]:
    """Without end, made of these messages (none: of some of every type); almost none is a message.

    The same generator gives the same frames.
    """
    kinds: list[Callable[[np.random.Generator, bytes], bytes]] = [
        _damaged, _damaged, _false_header, _false_header, _false_header, _nested, _unfinished, _false_end, _crowded_end,
        _false_length, _renamed, _giant,
    ]  # fmt: skip
    messages = messages or [good(t, rng) for t in msgs.TYPES.values() for _ in range(4)]
    originals = [bytes(encode(message)) for message in messages]
    while True:
        kind = kinds[rng.integers(len(kinds))]
        yield kind(rng, originals[rng.integers(len(originals))])[:LARGEST]


def frame(name: bytes, header: bytes, arrays: bytes = b"", *, header_bytes: int | None = None) -> bytes:
    """Whatever name and header are. `header_bytes` states another length than the header has."""
    stated = len(header) if header_bytes is None else header_bytes
    start = _PREFIX.pack(b"NMVS", VERSION, len(name), 0, stated) + name + header
    return start + (bytes(-len(start) % 64) + arrays if arrays else b"")


def parts(data: bytes) -> tuple[bytes, dict[str, Any], bytes]:
    """Name, header and array section of a good frame."""
    name_bytes, header_bytes = data[5], struct.unpack_from("<I", data, 8)[0]
    start = _PREFIX.size + name_bytes
    end = start + header_bytes
    return data[_PREFIX.size : start], msgpack.unpackb(data[start:end]), data[-(-end // 64) * 64 :]


def _damaged(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, max(1, min(len(changed), 400))))
        how = rng.integers(4)
        if how == 0 and changed:
            changed[at] ^= 1 << int(rng.integers(8))
        elif how == 1:
            del changed[at : at + int(rng.integers(1, 64))]
        elif how == 2:
            changed[at:at] = rng.bytes(int(rng.integers(64)))
        else:
            changed[at : at + 8] = rng.bytes(8)
    return bytes(changed)


def _false_header(rng: np.random.Generator, data: bytes) -> bytes:
    """One value of the header, at any place, is another one."""
    name, content, arrays = parts(data)
    places: list[tuple[Any, Any]] = [(content, key) for key in content]
    for part in (content["scalars"], content["arrays"]):
        places += [(part, key) for key in part]
    for entry in content["arrays"].values():
        places += [(entry, i) for i in range(3)] + [(entry[1], i) for i in range(len(entry[1]))]
    container, key = places[rng.integers(len(places))]
    container[key] = _value(rng)
    return frame(name, msgpack.packb(content), arrays)


def _value(rng: np.random.Generator) -> Any:
    values: list[Any] = [
        None, True, -1, 2**62, 2**63, 2**64 - 1, float("nan"), float("inf"), 1e300, "", ESCAPES, "\x00" * 60_000,
        ["\x00" * 60_000], {}, [], [[2**64 - 1] * 60, []], {ESCAPES: ESCAPES}, [0, 2**63, 3], ["uint8", [1], 0],
        _nest(int(rng.integers(1, 500)), []), _nest(int(rng.integers(1, 500)), {}), list(range(int(rng.integers(64)))),
    ]  # fmt: skip
    return values[rng.integers(len(values))]


def _nest(levels: int, innermost: Any) -> Any:
    for _ in range(levels):
        innermost = [innermost]
    return innermost


def _nested(rng: np.random.Generator, data: bytes) -> bytes:
    """A value inside a thousand lists, where the dtype or the shape of an array is due, or anywhere."""
    name, content, arrays = parts(data)
    levels = b"\x91" * int(rng.integers(900, 1030)) + rng.choice([b"\x00", b"\x80", b"\xa3abc", b"\xcb"])
    mark = f"mark{rng.integers(2**30)}"
    entries = list(content["arrays"].values())
    if entries:
        entries[rng.integers(len(entries))][rng.integers(2)] = mark
    else:
        content["scalars"]["stats"] = mark
    return frame(name, msgpack.packb(content).replace(msgpack.packb(mark), levels), arrays)


def _unfinished(rng: np.random.Generator, data: bytes) -> bytes:
    """Lists that say that they are long, in each other, and end too early."""
    name = parts(data)[0] if rng.integers(2) else b"End"
    size = int(rng.choice([15, 64, 4096, 65535]))
    opening = rng.choice([b"\xdc" + struct.pack(">H", size), b"\xdd" + struct.pack(">I", size * 1000)])
    return frame(name, opening * int(rng.integers(1, 1100)))


def _false_end(rng: np.random.Generator, data: bytes) -> bytes:
    """An End in the robot's stream: real, nearly real, or with random bytes for its header."""
    endings: list[bytes] = [
        bytes(encode(msgs.End({"robot": {"warnings": [ESCAPES]}}))),
        frame(b"End", rng.bytes(int(rng.integers(0, 200)))),
        frame(b"End", msgpack.packb({"sequence": 0, "scalars": {"stats": _value(rng)}, "arrays": {}})),
        frame(b"End", msgpack.packb({"sequence": 0, "scalars": {"stats": {"a": _value(rng)}}, "arrays": {}})),
        frame(b"End", msgpack.packb({"sequence": 0, "scalars": {}, "arrays": {}})) + rng.bytes(8),
    ]
    return endings[rng.integers(1, len(endings))]


def _crowded_end(rng: np.random.Generator, data: bytes) -> bytes:
    """An End filled to its limit with the smallest values, or with long keys above many values."""
    item = rng.choice([b"\x80", b"\x90", b"\x91\xc0", b"\x81\xa0\xc0", b"\xc3", b"\xa1\x1b"])
    inner = b"\xdc" + struct.pack(">H", 4000) + item * 4000
    room = int(rng.choice([MAX_HEADER_BYTES, MAX_END_HEADER_BYTES, LARGEST])) - 100
    if rng.integers(2):
        key = msgpack.packb("k" * 60_000)
        lists = min(4000, (room - len(key)) // len(inner))
        stats = b"\x81" + key + b"\xdc" + struct.pack(">H", lists) + inner * lists
    else:
        lists = min(4000, room // len(inner))
        stats = b"\x81\xa1a\xdc" + struct.pack(">H", lists) + inner * lists
    return frame(b"End", b"\x83\xa8sequence\x00\xa6arrays\x80\xa7scalars\x81\xa5stats" + stats)


def _false_length(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    stated = int(rng.choice([0, 1, 2**16 - 1, 2**16, 2**20, 2**31, 2**32 - 1]))
    changed[8:12] = struct.pack("<I", stated)
    return bytes(changed)


def _renamed(rng: np.random.Generator, data: bytes) -> bytes:
    _, content, arrays = parts(data)
    names = [t.encode() for t in msgs.TYPES] + [b"\x1b[2J", b"\xff" * 255, b"x" * 255, b""]
    return frame(names[rng.integers(len(names))], msgpack.packb(content), arrays)


def _giant(rng: np.random.Generator, data: bytes) -> bytes:
    """Sizes beyond everything, zeros among them; or as many bytes as a header may have, in one string."""
    name, content, arrays = parts(data)
    entries = list(content["arrays"].values())
    if entries and rng.integers(4):
        entry = entries[rng.integers(len(entries))]
        sizes = [0, 1, 3, 2**16, 2**31, 2**32, 2**40, 2**62, 2**63, 2**64 - 1]
        entry[1] = [sizes[rng.integers(len(sizes))] for _ in entry[1]]
        entry[2] = int(rng.choice([0, 64, 2**40])) if rng.integers(2) else entry[2]
    else:
        content["scalars"][ESCAPES] = "\x1b" * int(rng.integers(1, MAX_HEADER_BYTES))
    return frame(name, msgpack.packb(content), arrays + bytes(int(rng.integers(2)) * 900_000))


__all__ = ["ESCAPES", "LARGEST", "frame", "good", "mutated", "parts"]
