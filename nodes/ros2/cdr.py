"""CDR, the encoding of ROS 2's messages on the wire (OMG DDSI-RTPS 2.5, section 10; XTypes 1.3, XCDR version 1).

A message type is a dataclass whose annotations say how each field is written: `str`, another message type,
`Annotated[int, "u4"]` and the like for numbers and booleans, `Annotated[np.ndarray, "f8", 9]` for so many of them,
`Annotated[np.ndarray, "u1", None]` for any number, `list[T]` for any number of messages.

What is read comes from strangers: every length is checked against what is left of the data before anything is made.
"""

from __future__ import annotations

import struct
import typing
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

BIG, LITTLE = b"\0\0", b"\0\1"  # the header of a message begins with its representation
OPTIONS = b"\0\0"  # behind it; XTypes writers say there how many bytes of padding follow the message
HEADER = len(LITTLE + OPTIONS)  # bytes
PADDING = 3  # bytes that DDS may add behind a message: to a multiple of four
MAX_STRING = 2**16  # bytes: names of frames and encodings are short

T = TypeVar("T")


class CdrError(ValueError):
    """Data that is no message of the type."""


@dataclass(frozen=True)
class Number:
    code: str  # NumPy's, without its byte order


@dataclass(frozen=True)
class Numbers:
    code: str
    count: int | None  # None: any number


@dataclass(frozen=True)
class Text:
    pass


@dataclass(frozen=True)
class Nested:
    of: type


@dataclass(frozen=True)
class NestedSequence:
    of: type


Kind = Number | Numbers | Text | Nested | NestedSequence
_kinds: dict[type, tuple[tuple[str, Kind], ...]] = {}  # of the types that were met


def kinds(message_type: type) -> tuple[tuple[str, Kind], ...]:
    """Name and kind of each field. Raises TypeError for a type that is no message."""
    if message_type not in _kinds:
        hints = typing.get_type_hints(message_type, include_extras=True)
        _kinds[message_type] = tuple((each.name, _kind(hints[each.name])) for each in fields(message_type))
    return _kinds[message_type]


def _kind(hint: Any) -> Kind:
    if hint is str:
        return Text()
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is list:
        return NestedSequence(arguments[0])
    if len(arguments) == 2:
        return Number(arguments[1])
    if len(arguments) == 3:
        return Numbers(arguments[1], arguments[2])
    if isinstance(hint, type):
        return Nested(hint)
    raise TypeError(f"{hint} is no field of a message")


def encode(message: Any, big: bool = False) -> bytes:
    """A message with its header. Raises ValueError for an array of another length than its type says."""
    writer = _Writer(">" if big else "<")
    writer.message(message)
    return b"".join(writer.parts)


def decode(message_type: type[T], data: bytes) -> T:
    """The message in `data`, whose arrays are views of it. Raises CdrError."""
    if len(data) < HEADER or data[:2] not in (BIG, LITTLE):
        raise CdrError(f"header {data[:HEADER].hex()} is not that of plain CDR")
    reader = _Reader(memoryview(data)[HEADER:], ">" if data[:2] == BIG else "<")
    message = reader.message(message_type)
    if len(reader.data) - reader.at > PADDING:
        raise CdrError(f"{len(reader.data) - reader.at} bytes too many for {message_type.__name__}")
    return message


class _Writer:
    def __init__(self, order: str) -> None:
        self.parts: list[bytes | memoryview] = [(BIG if order == ">" else LITTLE) + OPTIONS]
        self._order = order
        self._size = 0  # behind the header: from there alignment counts

    def message(self, message: Any) -> None:
        for name, kind in kinds(type(message)):
            self._field(getattr(message, name), kind)

    def _field(self, value: Any, kind: Kind) -> None:
        match kind:
            case Number(code):
                self._array(np.asarray(value, self._order + code).reshape(1))
            case Text():
                text = value.encode() + b"\0"
                self._length(len(text))
                self._bytes(text)
            case Numbers(code, count):
                array = np.ascontiguousarray(value, self._order + code).reshape(-1)
                if count is None:
                    self._length(array.size)
                elif array.size != count:
                    raise ValueError(f"{array.size} numbers where there must be {count}")
                if array.size:
                    self._array(array)
            case Nested():
                self.message(value)
            case NestedSequence():
                self._length(len(value))
                for each in value:
                    self.message(each)

    def _length(self, length: int) -> None:
        self._align(4)
        self._bytes(struct.pack(self._order + "I", length))

    def _array(self, array: np.ndarray) -> None:
        self._align(array.itemsize)
        self._bytes(array.data.cast("B"))

    def _align(self, size: int) -> None:
        if self._size % size:
            self._bytes(bytes(-self._size % size))

    def _bytes(self, part: bytes | memoryview) -> None:
        self.parts.append(part)
        self._size += len(part)


class _Reader:
    def __init__(self, data: memoryview, order: str) -> None:
        self.data = data
        self.at = 0
        self._order = order

    def message(self, message_type: type[T]) -> T:
        return message_type(**{name: self._field(name, kind) for name, kind in kinds(message_type)})

    def _field(self, name: str, kind: Kind) -> Any:
        match kind:
            case Number(code):
                return self._array(name, code, 1)[0].item()
            case Text():
                return self._text(name)
            case Numbers(code, count):
                return self._array(name, code, self._length(name) if count is None else count)
            case Nested(of):
                return self.message(of)
            case NestedSequence(of):
                count = self._length(name)
                if count > len(self.data) - self.at:  # each has a byte at least
                    raise CdrError(f"{name}: {count} of them in {len(self.data) - self.at} bytes")
                return [self.message(of) for _ in range(count)]

    def _text(self, name: str) -> str:
        length = self._length(name)
        if not 1 <= length <= MAX_STRING:
            raise CdrError(f"{name}: a text of {length} bytes")
        text = bytes(self._take(name, length))
        if text[-1] or 0 in text[:-1]:
            raise CdrError(f"{name}: a text that does not end where it should")
        try:
            return text[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"{name}: a text that is not UTF-8") from error

    def _length(self, name: str) -> int:
        return int(self._array(name, "u4", 1)[0])

    def _array(self, name: str, code: str, count: int) -> np.ndarray:
        """In the machine's byte order; a view where that is the data's."""
        dtype = np.dtype(self._order + code)
        if count:  # an empty sequence is its length alone
            self.at += -self.at % dtype.itemsize
        raw = np.frombuffer(self._take(name, count * dtype.itemsize), np.uint8)
        if code == "?" and raw.max(initial=0) > 1:
            raise CdrError(f"{name}: {raw.max()} is neither true nor false")
        return raw.view(dtype).astype(dtype.newbyteorder("="), copy=False)

    def _take(self, name: str, size: int) -> memoryview:
        if size > len(self.data) - self.at:
            raise CdrError(f"{name}: {size} bytes where {max(0, len(self.data) - self.at)} are left")
        taken = self.data[self.at : self.at + size]
        self.at += size
        return taken
