"""One way in which a file is damaged, or made to do damage, drawn by a generator."""

from __future__ import annotations

import re

import numpy as np

_HUGE = (0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0xFFFF, 2**40, 2**63 - 1, 2**64 - 1, 0, 1, 100_000_000)
_NUMBERS = (
    b"nan", b"inf", b"-inf", b"1e999", b"1e300", b"-1e300", b"0", b"-1", b"1e9", b"1e-300", b"99999999999999999999",
    b"null", b"{}", b"[]", b'""', b"true", b"x", b"", b"9" * 5000, b"[" * 3000,
)  # fmt: skip
_NAMES = (b"../../../../../../etc/passwd", b"/etc/passwd", b"/dev/zero", b".", b"..", b"\x00", b"\xff\xfe", b"a" * 5000)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` cut off, with bits flipped, spliced, or with sizes and numbers that cannot be."""
    kinds = [_cut, _flip, _flip, _splice, _blank, _huge, _huge, _insert]
    if _is_text(data):
        kinds += [_number, _number, _number, _name]
    kind = kinds[int(rng.integers(len(kinds)))]
    return kind(data, rng)


def _is_text(data: bytes) -> bool:
    return len(data) > 0 and all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in data[:200])


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Half of the places lie in the first 100 bytes or the last 200, where headers and indices are."""
    size = max(len(data), 1)
    draw = rng.random()
    if draw < 0.3:
        return int(rng.integers(min(size, 100)))
    if draw < 0.5:
        return max(0, size - 1 - int(rng.integers(min(size, 200))))
    return int(rng.integers(size))


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(int(2 ** rng.uniform(0, 6))):
        changed[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _splice(data: bytes, rng: np.random.Generator) -> bytes:
    """A piece of the file over, or between, what is elsewhere in it."""
    start, to = _place(data, rng), _place(data, rng)
    piece = data[start : start + int(2 ** rng.uniform(0, 10))]
    after = to + (len(piece) if rng.random() < 0.5 else 0)
    return data[:to] + piece + data[after:]


def _blank(data: bytes, rng: np.random.Generator) -> bytes:
    start, length = _place(data, rng), int(2 ** rng.uniform(0, 10))
    filled = bytes([int(rng.choice([0, 255]))]) * min(length, len(data) - start)
    return data[:start] + filled + data[start + len(filled) :]


def _huge(data: bytes, rng: np.random.Generator) -> bytes:
    """A whole number, of 2, 4 or 8 bytes in either order, that is no size of anything."""
    size = int(rng.choice([2, 4, 8]))
    value = _HUGE[int(rng.integers(len(_HUGE)))] % 2 ** (8 * size)
    number = value.to_bytes(size, "little" if rng.random() < 0.6 else "big")
    start = _place(data, rng)
    return data[:start] + number + data[start + size :]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    start = _place(data, rng)
    return data[:start] + rng.bytes(int(2 ** rng.uniform(0, 8))) + data[start:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replaced(data, rb"-?\d+(\.\d+)?([eE]-?\d+)?", _NUMBERS, rng)


def _name(data: bytes, rng: np.random.Generator) -> bytes:
    return _replaced(data, rb"[A-Za-z0-9_./-]*\.[a-z]{3}|\"[a-z_]+\"", _NAMES, rng)


def _replaced(data: bytes, pattern: bytes, values: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    found = list(re.finditer(pattern, data))
    if not found:
        return _flip(data, rng)
    one = found[int(rng.integers(len(found)))]
    return data[: one.start()] + values[int(rng.integers(len(values)))] + data[one.end() :]
