"""Messages of an MCAP file (https://mcap.dev/spec), of which damaged parts are left out and the rest is read.

The file is walked record by record. Its index is only a help: where a record's length is damaged, the walk goes on at
the next chunk that the index knows.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Header, Message, Schema

from mvsgs_core.bad_file import BadFileError, brief, reading
from mvsgs_core.datasets.compression import decompress
from mvsgs_core.datasets.sequence import Notices

MAGIC = b"\x89MCAP0\r\n"
ROS_2 = "ros2"  # profile of the bags of ROS 2
_HEAD = struct.Struct("<BQ")  # opcode, length
_BESIDE = 2 * 2**20  # bytes of a chunk beside its largest message: writers close a chunk at about one million
_SMALL = 2**20  # bytes: no index is longer
_SKIPPED = frozenset(Opcode) | set(range(0x80, 0x100))  # with those that the specification leaves to its users


@dataclass(frozen=True)
class Recorded:
    """One message."""

    topic: str
    kind: str  # name of its schema, "" without one
    encoding: str
    sequence: int
    nanoseconds: int  # when it was recorded
    data: bytes


def profile_of(path: Path) -> str:
    """Whose messages an MCAP file holds, as its header says, "" where none is there that can be read.

    Raises OSError for a file that cannot be read.
    """
    with path.open("rb") as file:
        magic, head = file.read(len(MAGIC)), file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        if magic != MAGIC or opcode != Opcode.HEADER or length > _SMALL:
            return ""
        with suppress(BadFileError), reading(path, "has no header"):
            return str(Header.read(ReadDataStream(BytesIO(file.read(length)))).profile)
    return ""


class McapFile:
    """`indexed`: the topics that its index names, none where it is missing.

    `warnings`: what was left out, as it is met.
    max_message: bytes; a message, and what a chunk is decompressed to, may not be (much) longer.
    Raises BadFileError for a file that is no MCAP file at all.
    """

    def __init__(self, path: Path, max_message: int) -> None:
        self._path = path
        self._largest = max_message + _BESIDE
        self._schemas: dict[int, str] = {}  # their names
        self._channels: dict[int, Channel] = {}
        self.warnings = Notices()
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise BadFileError(f"{path} is no recording: an .mcap file starts otherwise")
        self.indexed, self._chunks = self._index()

    def messages(self) -> Iterator[Recorded]:
        """In the order of the file."""
        with self._path.open("rb") as file:
            for opcode, data in self._records(file):
                if opcode == Opcode.CHUNK:
                    yield from self._of_chunk(data)
                elif (message := self._message(opcode, data)) is not None:
                    yield message

    def leave_out(self, what: str) -> None:
        """Counts damage among the warnings, also that of a message's own bytes, which only its reader knows."""
        self.warnings.tally(f"parts of {self._path.name} left out because they are damaged", what)

    def _records(self, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
        """Schemas, channels, messages and chunks."""
        size = self._path.stat().st_size
        at = len(MAGIC)
        while True:
            file.seek(at)
            head = file.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            after = at + _HEAD.size + length
            following = next(iter(self._chunks[bisect_right(self._chunks, at) :]), size)
            ends = opcode in (Opcode.DATA_END, Opcode.FOOTER)
            if ends and following >= size:
                return
            if ends or opcode not in _SKIPPED or after > size:
                if following >= size:
                    self.warnings.append(f"{self._path.name} was cut off or is damaged: read are {at} of {size} bytes")
                    return
                self.leave_out(f"bytes {at} to {following}")
                at = following
                continue
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
                if length <= self._largest:
                    yield opcode, file.read(length)
                else:
                    self.leave_out(f"a record of {length} bytes; read are up to {self._largest}")
            at = after

    def _of_chunk(self, data: bytes) -> Iterator[Recorded]:
        try:
            chunk = Chunk.read(ReadDataStream(BytesIO(data)))
            if chunk.uncompressed_size > self._largest:
                raise ValueError(
                    f"{chunk.uncompressed_size} bytes, decompressed, are more than the {self._largest} read"
                )
            content = decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
            if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
                raise ValueError("its checksum is another")
        except Exception as error:  # the library raises what damaged bytes make of its code
            self.leave_out(f"a chunk of {len(data)} bytes: {brief(error)}")
            return
        at = 0
        while at + _HEAD.size <= len(content):
            opcode, length = _HEAD.unpack_from(content, at)
            at += _HEAD.size
            if length > len(content) - at:
                self.leave_out("the end of a chunk")
                return
            message = self._message(opcode, content[at : at + length])
            if message is not None:
                yield message
            at += length

    def _message(self, opcode: int, data: bytes) -> Recorded | None:
        """What a record is if it is a message; schemas and channels are kept for the messages to come."""
        stream = ReadDataStream(BytesIO(data))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas.setdefault(schema.id, schema.name)
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._channels.setdefault(channel.id, channel)
            elif opcode == Opcode.MESSAGE:
                message = Message.read(stream, len(data))
                channel = self._channels[message.channel_id]
                return Recorded(
                    channel.topic, self._schemas.get(channel.schema_id, ""), channel.message_encoding,
                    message.sequence, message.log_time, message.data,
                )  # fmt: skip
        except Exception as error:  # as above
            self.leave_out(f"a record of {len(data)} bytes: {brief(error)}")
        return None

    def _index(self) -> tuple[set[str], list[int]]:
        """Topics, and where chunks begin, of the index at the end; nothing where it is missing or damaged."""
        try:
            with self._path.open("rb") as file, reading(self._path, "has no index"):
                summary = SeekingReader(file, record_size_limit=_SMALL).get_summary()
        except BadFileError:
            summary = None
        if summary is None:
            return set(), []
        self._schemas = {number: schema.name for number, schema in summary.schemas.items()}
        self._channels = dict(summary.channels)
        topics = {channel.topic for channel in summary.channels.values()}
        return topics, sorted({chunk.chunk_start_offset for chunk in summary.chunk_indexes})
