"""Message <-> one frame of bytes: `prefix | type name | msgpack header | 64-byte-aligned arrays`. See WIRE.md.

Nothing in a frame is trusted: version, type, field names, dtypes, shapes, sizes, offsets and nesting are checked
against the dataclasses of `msgs` before an array is made, so that a bad frame is a `CodecError` that says what is
wrong with it, and never a crash or a large allocation. Decoded arrays are read-only, the large ones views on the frame.
"""

from __future__ import annotations

import math
import struct
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any, NamedTuple

import msgpack
import numpy as np

import msgs
from msgs import statistics
from msgs.header import MAX_TEXT, unpack
from mvsgs_core.printable import printable

VERSION = 2
RELIABLE = b"R"  # first byte of a frame, which readers subscribe to: every message ...
NEWEST = b"N"  # ... or only the newest
AGAIN = b"A"  # a message of the first kind once more, to a reader that was started again
SMALL_BYTES = 4096  # an array up to this is copied: who keeps a pose does not keep its frame's images
ALIGNMENT = 64  # bytes, of each array from the frame's start
MAX_MESSAGE_BYTES = 256 * 2**20
MAX_MAP_BYTES = 4 * 2**30  # a SplatMap: about 16 million splats with all their spherical harmonics
MAX_HEADER_BYTES = 64 * 2**10
MAX_END_HEADER_BYTES = 2**20  # End carries the statistics of the whole graph
MAX_VALUES = 1000  # keys and values in a header, in all; of an End:
MAX_END_VALUES = MAX_VALUES + 2 * statistics.MAX_ENTRIES

_PREFIX = struct.Struct("<c3sBBHI")  # delivery, magic, version, length of the name, zero, length of the header
_MAGIC = b"MVS"
_HEADER_KEYS = {"sequence", "scalars", "arrays"}
_ORDER_KEY = "before"  # left out where it says nothing: programs that know no other topic need not send it
_BEGUN_KEY = "begun"  # as well: most processes are not started again
_IMAGE_SIZES = frozenset("HWhw")  # named sizes that may not be 0


class CodecError(ValueError):
    """A message that cannot be sent, or a frame that is not a message."""


class VersionError(CodecError):
    """A frame of another version of the wire format."""


class Decoded(NamedTuple):
    message: msgs.Message
    sequence: int  # position of the message in its topic, from 0
    before: Mapping[str, int] = types.MappingProxyType({})  # messages that its sender had sent of its other types
    begun: int = 0  # when its sender's process began, ns since 1970 by that host's clock; 0: it is not said


@dataclass(frozen=True)
class ArraySpec:
    """What an annotation such as `Annotated[np.ndarray, "float32 h w 3"] | None` asks for."""

    name: str  # of the dtype
    dtype: np.dtype  # little-endian
    dims: tuple[int | str, ...]  # a size, or the name of one
    optional: bool


FieldSpec = ArraySpec | type  # `type`: int, float, str, bool or Mapping


def _allocate(size: int) -> np.ndarray:
    return np.empty(size, np.uint8)


def encode(
    message: msgs.Message,
    sequence: int = 0,
    *,
    before: Mapping[str, int] | None = None,
    begun: int = 0,
    delivery: bytes = RELIABLE,
    allocate: Callable[[int], np.ndarray] = _allocate,
) -> memoryview:
    """The message as one frame, in memory of which `allocate(n)` gives at least n bytes (uint8, contiguous).

    before: how many messages of each other type the sender has sent so far, by which a reader of several of its topics
    keeps their order; begun: when the sender's process began, by which a reader knows one that was started again.
    Raises CodecError where a field differs from its annotation or the frame would be larger than `max_message_bytes`
    of its type.
    """
    name = type(message).__name__
    scalars: dict[str, Any] = {}
    arrays: dict[str, list[Any]] = {}
    values: list[tuple[np.ndarray, int]] = []  # with their offsets
    end = 0  # of the array section
    for field, value in _checked_fields(message):
        if isinstance(value, np.ndarray):
            offset = _aligned(end)
            end = offset + value.nbytes
            arrays[field] = [value.dtype.name, value.shape, offset]
            values.append((value, offset))
        elif field not in _DEFAULTS[name] or value != _DEFAULTS[name][field]:
            scalars[field] = value  # a default is left out: programs from before the field was there read the rest
    content: dict[str, Any] = {"sequence": sequence, "scalars": scalars, "arrays": arrays}
    if before:
        content[_ORDER_KEY] = dict(before)
    if begun:
        content[_BEGUN_KEY] = begun
    try:
        header = msgpack.packb(content)
    except (ValueError, OverflowError, TypeError) as error:
        raise CodecError(f"{name}: {error}") from error
    limit = _header_limit(name)
    max_bytes = max_message_bytes(type(message))
    header_at = _PREFIX.size + len(name)
    header_end = header_at + len(header)
    section = _aligned(header_end)
    total = section + end if arrays else header_end
    if len(header) > limit or total > max_bytes:
        raise CodecError(
            f"{name} takes {total} bytes with a header of {len(header)}; a message may have {max_bytes} and {limit}"
        )
    buffer = allocate(total)[:total]
    frame = memoryview(buffer)  # type: ignore[arg-type]
    _PREFIX.pack_into(frame, 0, delivery, _MAGIC, VERSION, len(name), 0, len(header))
    frame[_PREFIX.size : header_at] = name.encode()
    frame[header_at:header_end] = header
    end = header_end
    for value, offset in values:
        start = section + offset
        buffer[end:start] = 0  # no stray memory on the wire
        end = start + value.nbytes
        buffer[start:end].view(value.dtype).reshape(value.shape)[...] = value
    return frame


def check(message: msgs.Message) -> None:
    """Raises CodecError where a field differs from its annotation, as `encode` does, and copies nothing."""
    for _ in _checked_fields(message):
        pass


def decode(frame: Any, *, expect: tuple[type, ...] | None = None) -> Decoded:
    """The message of a frame (any bytes-like object). Its arrays are read-only; those over `SMALL_BYTES` are views that
    keep the frame alive.

    `expect` restricts the types that are accepted. Raises CodecError for everything that `encode` would not write.
    """
    view = memoryview(frame)
    name, header = _split(view)
    allowed = _TYPES if expect is None else expect
    message_type = msgs.TYPES.get(name)
    if message_type is None or message_type not in allowed:
        raise CodecError(f"a frame of type {name!r} where {' or '.join(t.__name__ for t in allowed)} is expected")
    max_bytes = max_message_bytes(message_type)
    if view.nbytes > max_bytes:
        raise CodecError(f"a frame of {view.nbytes} bytes, more than the {max_bytes} that a {name} may have")
    sequence, scalars, arrays, before, begun = _unpack_header(header, name)
    specs = _SPECS[name]
    scalars = {**{field: value for field, value in _DEFAULTS[name].items() if field not in arrays}, **scalars}
    if len(scalars) + len(arrays) != len(specs) or (scalars.keys() | arrays.keys()) != specs.keys():
        given = printable(", ".join(map(str, (*scalars, *arrays))), 300)
        raise CodecError(f"{name} has the fields {', '.join(specs)}; this frame has {given or 'none'}")
    built: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    end = _PREFIX.size + len(name) + len(header)
    section = view[_aligned(end) :]
    for field, spec in specs.items():
        where = f"{name}.{field}"
        if not isinstance(spec, ArraySpec):
            if field not in scalars:
                raise CodecError(f"{where} is no array")
            built[field] = _checked_scalar(scalars[field], spec, where)
        elif field in scalars:
            if scalars[field] is not None or not spec.optional:
                raise CodecError(f"{where} must be an array" + (" or nil" if spec.optional else ""))
            built[field] = None
        else:
            built[field], stop = _array(section, arrays[field], spec, sizes, where)
            end = max(end, view.nbytes - section.nbytes + stop)
    if view.nbytes != end:
        raise CodecError(f"the frame of a {name} has {view.nbytes} bytes, its content ends at {end}")
    return Decoded(message_type(**built), sequence, before, begun)


def type_name(frame: Any) -> str:
    """The message type that a frame says it is, without decoding the rest. Raises CodecError."""
    return _split(memoryview(frame))[0]


def max_message_bytes(message_type: type) -> int:
    """The largest frame of a type."""
    return MAX_MAP_BYTES if message_type is msgs.SplatMap else MAX_MESSAGE_BYTES


def array_specs(message_type: type) -> dict[str, FieldSpec]:
    """Field name -> what the annotation asks for."""
    return dict(_SPECS[message_type.__name__])


def _checked_fields(message: msgs.Message) -> Iterator[tuple[str, Any]]:
    """Its fields by name: arrays as they are, numbers and texts as Python's own."""
    name = type(message).__name__
    specs = _SPECS.get(name)
    if specs is None or msgs.TYPES[name] is not type(message):
        raise CodecError(f"{type(message).__qualname__} is no message; the types are {', '.join(_SPECS)}")
    sizes: dict[str, int] = {}
    for field, spec in specs.items():
        value, where = getattr(message, field), f"{name}.{field}"
        if not isinstance(spec, ArraySpec):
            value = _checked_scalar(value, spec, where)
        elif value is not None or not spec.optional:
            if not isinstance(value, np.ndarray):
                raise CodecError(f"{where} is a {type(value).__name__}, not an array")
            if value.dtype != spec.dtype:
                raise CodecError(f"{where} must be {spec.name}, not {value.dtype}")
            _check_shape(spec, value.shape, sizes, where)
        yield field, value


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def _header_limit(name: str) -> int:
    return MAX_END_HEADER_BYTES if name == "End" else MAX_HEADER_BYTES


def _split(view: memoryview) -> tuple[str, memoryview]:
    """Type name and header of a frame."""
    if view.ndim != 1 or view.format != "B" or not view.contiguous:
        raise CodecError("a frame must be contiguous bytes")
    if view.nbytes < _PREFIX.size:
        raise CodecError(f"a frame of {view.nbytes} bytes is too short")
    delivery, magic, version, name_length, zero, header_length = _PREFIX.unpack_from(view)
    if magic != _MAGIC or delivery not in (RELIABLE, NEWEST, AGAIN):
        raise CodecError(f"no message: it starts with {bytes(view[:4])!r}, not b'RMVS' or b'NMVS'")
    if version != VERSION:
        raise VersionError(f"a frame of wire version {version}; this program writes and reads version {VERSION}")
    if zero:
        raise CodecError(f"a frame with flags {zero}, which must be 0")
    start = _PREFIX.size + name_length
    try:
        name = bytes(view[_PREFIX.size : start]).decode("ascii")
    except UnicodeDecodeError:
        raise CodecError("the type name is not ASCII") from None
    if header_length > _header_limit(name):
        raise CodecError(f"a header of {header_length} bytes, more than {_header_limit(name)}")
    if start + header_length > view.nbytes:
        raise CodecError(
            f"a frame of {view.nbytes} bytes is cut off in its header, which ends at {start + header_length}"
        )
    return name, view[start : start + header_length]


def _unpack_header(header: memoryview, name: str) -> tuple[int, dict[str, Any], dict[str, Any], dict[str, int], int]:
    try:
        content = unpack(header, MAX_END_VALUES if name == "End" else MAX_VALUES)
    except ValueError as error:
        raise CodecError(f"{name}: the header is no valid msgpack: {error}") from None
    if not isinstance(content, dict) or content.keys() - {_ORDER_KEY, _BEGUN_KEY} != _HEADER_KEYS:
        raise CodecError(f"{name}: the header must be a map of sequence, scalars and arrays")
    sequence, scalars, arrays = content["sequence"], content["scalars"], content["arrays"]
    if not _is_count(sequence):
        raise CodecError(f"{name}: the sequence number must be an integer from 0")
    before = content.get(_ORDER_KEY, {})
    if not isinstance(before, dict) or not all(t in msgs.TYPES and _is_count(n) for t, n in before.items()):
        raise CodecError(f"{name}: before must be a map of message types to integers from 0")
    begun = content.get(_BEGUN_KEY, 0)
    if not _is_count(begun):
        raise CodecError(f"{name}: begun must be an integer from 0")
    if not isinstance(scalars, dict) or not isinstance(arrays, dict):
        raise CodecError(f"{name}: scalars and arrays must be maps")
    return sequence, scalars, arrays, before, begun


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _array(
    section: memoryview, entry: Any, spec: ArraySpec, sizes: dict[str, int], where: str
) -> tuple[np.ndarray, int]:
    """The array and where its bytes end in the array section."""
    if not isinstance(entry, list) or len(entry) != 3 or not isinstance(entry[1], list):
        raise CodecError(f"{where} must be given as [dtype, shape, offset]")
    dtype, shape, offset = entry
    if dtype != spec.name:
        raise CodecError(f"{where} must be {spec.name}, not {_shown(dtype)}")
    if not all(map(_is_count, (*shape, offset))):  # before any of them is shown: lists in lists have no end
        raise CodecError(f"{where}: the sizes of its shape and its offset must be integers from 0")
    _check_shape(spec, shape, sizes, where)
    stop = offset + math.prod(shape) * spec.dtype.itemsize
    if offset % ALIGNMENT or stop > section.nbytes:
        raise CodecError(
            f"{where}: bytes {offset} to {stop} are not inside the {section.nbytes} bytes of arrays, "
            f"at a multiple of {ALIGNMENT}"
        )
    array = np.frombuffer(section[offset:stop], spec.dtype).reshape(shape)
    if spec.dtype.kind == "b" and array.size and array.view(np.uint8).max() > 1:
        raise CodecError(f"{where}: a bool is 0 or 1")
    if where.endswith(".timestamp") and not np.isfinite(array).all():
        raise CodecError(f"{where} is not finite")
    if array.nbytes <= SMALL_BYTES or not array.flags.aligned:  # a small frame may lie anywhere in memory
        array = array.copy()
    array.flags.writeable = False
    return array, stop


def _check_shape(spec: ArraySpec, shape: Sequence[int], sizes: dict[str, int], where: str) -> None:
    if len(shape) != len(spec.dims):
        given = printable(tuple(shape), 100)
        raise CodecError(f"{where} must have the shape ({' '.join(map(str, spec.dims))}), not {given}")
    for size, dim in zip(shape, spec.dims):
        expected = dim if type(dim) is int else sizes.setdefault(dim, size)  # type: ignore[arg-type]
        if size != expected:
            raise CodecError(f"{where} has the shape {tuple(shape)}, but {dim} is {expected}")
        if size == 0 and dim in _IMAGE_SIZES:
            raise CodecError(f"{where} is an empty image: shape {tuple(shape)}")
    if 0 in shape and math.prod(filter(None, shape)) > MAX_MAP_BYTES:  # it takes no bytes, but numpy has no such shape
        raise CodecError(f"{where} is larger than any message: shape {tuple(shape)}")


def _shown(value: Any) -> str:
    """Any value of a header, in an error: a list may be nested deeper than Python can print."""
    return f"a {type(value).__name__}" if isinstance(value, list | dict) else printable(value, 100)


def _checked_scalar(value: Any, kind: Any, where: str) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if kind is float and type(value) is int:
        value = float(value)
    if kind is Mapping:
        try:
            return statistics.checked(value)
        except ValueError as error:
            raise CodecError(f"{where}: {error}") from None
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise CodecError(f"{where} must be {kind.__name__}, not {type(value).__name__}")
    if kind is float and not math.isfinite(value):
        raise CodecError(f"{where} is {value}")
    if kind is int:
        value = int(value)
        if not -(2**63) <= value < 2**63:
            raise CodecError(f"{where} does not fit 64 bits")
    if kind is str and len(value.encode(errors="replace")) > MAX_TEXT:
        raise CodecError(f"{where} is longer than {MAX_TEXT} bytes")
    return value


def _specs_of(message_type: type) -> dict[str, FieldSpec]:
    hints = typing.get_type_hints(message_type, include_extras=True)
    return {f.name: _field_spec(hints[f.name]) for f in fields(message_type)}


def _field_spec(hint: Any) -> FieldSpec:
    optional = False
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
        optional = True
    if typing.get_origin(hint) is typing.Annotated:
        dtype, *dims = hint.__metadata__[0].split()
        sizes = tuple(int(dim) if dim.isdigit() else dim for dim in dims)
        return ArraySpec(dtype, np.dtype(dtype).newbyteorder("<"), sizes, optional)
    return typing.get_origin(hint) or hint


_SPECS: dict[str, dict[str, FieldSpec]] = {name: _specs_of(t) for name, t in msgs.TYPES.items()}
_DEFAULTS: dict[str, dict[str, Any]] = {
    name: {f.name: f.default for f in fields(t) if f.default is not MISSING} for name, t in msgs.TYPES.items()
}
_TYPES = tuple(msgs.TYPES.values())
