"""A bag whose recorder was killed: it has no index, so that no library reads it. It is walked record by record.

Only what a sequence needs is read: images, their calibration and the times at which they were recorded. Definitions of
messages are not, since sensor_msgs has been the same in all of ROS 1 and of ROS 2.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from mvsgs_core.bad_file import BadFileError, brief
from mvsgs_core.datasets.compression import decompress
from mvsgs_core.datasets.files import natural_order, visible
from mvsgs_core.datasets.mcap_file import ROS_2, McapFile, profile_of
from mvsgs_core.datasets.sequence import Notices

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = b"\2", b"\5", b"\7"  # op of a record of ROS 1 (wiki.ros.org/Bags/Format/2.0)
_OP_OF_A_CHUNK = b"op=" + _CHUNK  # none lies in another
_LENGTH, _TIME = struct.Struct("<I"), struct.Struct("<II")
_MAX_HEADER = 2**20  # bytes
_NUMBERED = re.compile(r"_\d+$")


@dataclass(frozen=True)
class Topic:
    """As `rosbags` gives a connection."""

    topic: str
    msgtype: str
    msgcount: int = 0


_Message = tuple[Topic, int, bytes]  # with nanoseconds


class CutOffBag:
    """One or more files of ROS 1 or ROS 2, in the order in which they are given and in that of their records.

    `connections`: topics and how many messages of each there are. `warnings`: why it is walked, where the files end too
    early, and what of them was left out.
    Raises BadFileError where not one message can be read.
    """

    def __init__(self, paths: Sequence[Path], largest: int, why: str, known: Sequence[Topic] = ()) -> None:
        """largest: bytes of a chunk or a message, decompressed. why: it cannot be opened. known: `connections`, where
        the same bag was walked before: counting reads all of it."""
        from rosbags.typesys import Stores, get_typestore

        self._paths, self._largest = paths, largest
        self._ros_1 = _is_ros_1(paths[0])
        self._types: Typestore = get_typestore(Stores.ROS1_NOETIC if self._ros_1 else Stores.ROS2_HUMBLE)
        self.warnings = Notices()
        self.warnings.append(f"read record by record, in their order, as it cannot be opened: {why}")
        self.connections = list(known)
        if known:
            return
        counts = Counter((topic.topic, topic.msgtype) for topic, _, _ in self._walked(self.warnings))
        if not counts:
            raise BadFileError(f"{paths[0]}: no message could be read: " + "; ".join(self.warnings))
        self.connections = [Topic(topic, kind, number) for (topic, kind), number in counts.items()]

    def messages(self, connections: Collection[Topic]) -> Iterator[_Message]:
        """(topic, nanoseconds, data) of these topics."""
        wanted = {(connection.topic, connection.msgtype) for connection in connections}
        for topic, nanoseconds, data in self._walked(Notices()):  # which are those of the first walk
            if (topic.topic, topic.msgtype) in wanted:
                yield topic, nanoseconds, data

    def deserialize(self, data: bytes, kind: str) -> Any:
        """The message. Raises what damaged bytes make of the library's code."""
        return self._types.deserialize_ros1(data, kind) if self._ros_1 else self._types.deserialize_cdr(data, kind)

    def _walked(self, notices: Notices) -> Iterator[_Message]:
        for path in self._paths:
            yield from (self._of_ros_1 if self._ros_1 else self._of_mcap)(path, notices)

    def _of_mcap(self, path: Path, notices: Notices) -> Iterator[_Message]:
        file = McapFile(path, self._largest)
        for message in file.messages():
            if message.encoding == "cdr":
                yield Topic(message.topic, message.kind), message.nanoseconds, message.data
        notices += file.warnings

    def _of_ros_1(self, path: Path, notices: Notices) -> Iterator[_Message]:
        """The last chunk's length is still 0 where its recorder was killed: its records then stand in the file."""
        size, topics = path.stat().st_size, dict[int, Topic]()
        with path.open("rb") as file:
            file.seek(len(_MAGIC))
            while (at := file.tell()) < size:
                try:
                    header, length = _record(file)
                    if length > size - file.tell():
                        raise ValueError("a record ends early")
                except ValueError as error:
                    what = f"{path.name} was cut off or is damaged: read are {at} of {size} bytes"
                    notices.append(f"{what} ({brief(error)})")
                    return
                after = file.tell() + length
                yield from self._of_record(header, file, length, topics, notices)
                file.seek(after)

    def _of_record(
        self, header: bytes, file: BinaryIO, length: int, topics: dict[int, Topic], notices: Notices
    ) -> Iterator[_Message]:
        """The messages of a record, of which `length` bytes follow; none of a damaged one, which is counted.

        topics: by the number of their connection, to which what is met is added.
        """
        try:
            fields = _fields(header)
            if fields.get(b"op") in (_CHUNK, _CONNECTION, _MESSAGE):
                if length > self._largest:
                    raise ValueError(f"it has {length} bytes")
                yield from self._of_data(fields, file.read(length), topics, notices)
        except Exception as error:  # what damaged bytes make of the libraries' code
            notices.tally("records of the bag left out because they are damaged", brief(error))

    def _of_data(
        self, header: dict[bytes, bytes], data: bytes, topics: dict[int, Topic], notices: Notices
    ) -> Iterator[_Message]:
        from rosbags.typesys.msg import normalize_msgtype

        op = header[b"op"]
        if op == _CHUNK:
            content = BytesIO(decompress(data, header[b"compression"].decode(), self._largest))
            while content.tell() < len(content.getbuffer()):
                inner, length = _record(content)
                after = content.tell() + length
                if _OP_OF_A_CHUNK not in inner:
                    yield from self._of_record(inner, content, length, topics, notices)
                content.seek(after)
        elif op == _CONNECTION:
            kind = _fields(data)[b"type"].decode()
            topics.setdefault(_number(header[b"conn"]), Topic(header[b"topic"].decode(), normalize_msgtype(kind)))
        elif op == _MESSAGE:
            seconds, nanoseconds = _TIME.unpack(header[b"time"])
            yield topics[_number(header[b"conn"])], 10**9 * seconds + nanoseconds, data


def cut_off_files(path: Path) -> list[Path]:
    """What can be walked of a bag that cannot be opened: the file itself, or those of a folder of ROS 2, in order."""
    if path.is_dir():
        return [file for file in of_one_bag(path, ".mcap") if _is_ros_2(file)]
    return [path] if path.is_file() and (_is_ros_2(path) or _is_ros_1(path)) else []


def of_one_bag(folder: Path, suffix: str) -> list[Path]:
    """The files of that suffix in their order, where a recorder of ROS 2 has numbered them (walk_0, walk_1) or there is
    but one. None of several bags that lie in one folder, nor beside parts that are compressed as a whole, which would
    be passed over: metadata.yaml alone says which parts there are."""
    if any(folder.glob("*.zstd")):
        return []
    files = filter(Path.is_file, visible(folder, f"*{suffix}"))
    found = sorted(files, key=lambda file: natural_order(file.name))
    names = {_NUMBERED.sub("", file.stem) if _NUMBERED.search(file.stem) else None for file in found}
    return found if len(found) == 1 or (len(names) == 1 and None not in names) else []


def _is_ros_2(path: Path) -> bool:
    with suppress(OSError):
        return path.suffix.lower() == ".mcap" and profile_of(path) == ROS_2
    return False


def _is_ros_1(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def _record(file: BinaryIO) -> tuple[bytes, int]:
    """Header of the record that begins here, and how many bytes of data follow. Raises ValueError at damage."""
    length = _number(file.read(_LENGTH.size))
    if length > _MAX_HEADER:
        raise ValueError(f"a header of {length} bytes")
    return file.read(length), _number(file.read(_LENGTH.size))


def _fields(data: bytes) -> dict[bytes, bytes]:
    """Of a header. Raises ValueError at damage."""
    found, at = dict[bytes, bytes](), 0
    while at < len(data):
        end = at + _LENGTH.size + _number(data[at : at + _LENGTH.size])
        name, separator, value = data[at + _LENGTH.size : end].partition(b"=")
        if not separator or end > len(data):
            raise ValueError("a header that is none")
        found[name], at = value, end
    return found


def _number(data: bytes) -> int:
    if len(data) != _LENGTH.size:
        raise ValueError("the file ends early")
    return int(_LENGTH.unpack(data)[0])
