"""Opens a bag with `rosbags`, bounds what it decompresses, and reads on behind a damaged part. Bags that were cut off,
which the library does not read, are walked.

`rosbags` decompresses without a bound, and its messages end at the first damaged byte. Its tables of decompressors take
ours; what it compresses by the message is decompressed here; and behind damage the messages go on at the end of the
chunk that holds it.
"""

from __future__ import annotations

import re
import shlex
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import zstandard

from mvsgs_core.bad_file import BadFileError, brief, reading
from mvsgs_core.datasets.compression import decompress
from mvsgs_core.datasets.cut_off_bag import CutOffBag, Topic, cut_off_files, of_one_bag
from mvsgs_core.datasets.sequence import Notices

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

    OpenBag: TypeAlias = AnyReader | CutOffBag
    BagTopic: TypeAlias = Connection | Topic

MAX_BYTES = 2**28 + 2**21  # of a chunk or message, decompressed: an image of 89 million pixels, and what is beside it
_MAX_FILE_BYTES = 2**36  # of a file that is compressed as a whole, decompressed into the folder for temporary files
_MAX_COUNT = 2**40  # messages
_MAX_METADATA_BYTES = 2**24
_MAX_NESTING = 50
_BLOCK = 2**20


@contextmanager
def opened_bag(path: Path, known: Sequence[Topic] = ()) -> Iterator[OpenBag]:
    """The bag at `path`. Raises ImportError without rosbags, BadFileError for a bag that cannot be read.

    known: topics of a bag that was opened before and had to be walked.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError("bags are read by rosbags, which is optional: pip install rosbags") from error
    _bound_decompression()
    bag: OpenBag
    try:
        with reading(path, f"is no bag that can be read{_repair(path)}"):
            _check_metadata(path / "metadata.yaml")
            _check_compressed_files(path)
            # ROS 2 bags before Iron hold no message definitions; image and camera_info have not changed since
            bag = AnyReader(_files(path), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            bag.open()
    except BadFileError as error:
        if not (walkable := cut_off_files(path)):
            raise
        bag = CutOffBag(walkable, MAX_BYTES, brief(error.__cause__ or error), known)
    try:
        if any(not isinstance(c.msgcount, int) or not 0 <= c.msgcount < _MAX_COUNT for c in bag.connections):
            raise BadFileError(f"{path} is no bag that can be read: it counts messages by what is no number of them")
        yield bag
    finally:
        if isinstance(bag, AnyReader):
            bag.close()


def is_bag_folder(path: Path) -> bool:
    """Whether a folder is one of ROS 2, also one without metadata.yaml, which a recorder that was killed has not
    written."""
    return path.is_dir() and ((path / "metadata.yaml").is_file() or bool(_storage_files(path)))


def messages(bag: OpenBag, topics: Sequence[BagTopic], notices: Notices) -> Iterator[tuple[BagTopic, int, bytes]]:
    """(topic, nanoseconds, data) in the order of time, of a bag that was cut off in that of its records. What is
    damaged is left out, and counted in `notices`."""
    if isinstance(bag, CutOffBag):
        yield from bag.messages([topic for topic in topics if isinstance(topic, Topic)])
        return
    connections = [topic for topic in topics if not isinstance(topic, Topic)]
    by_message = _decompresses_messages(bag)
    ends = _chunk_ends(bag)
    since: int | None = None
    done = 0  # all before this time has been read, or left out
    while True:
        source = bag.messages(connections, start=since)
        while True:
            try:
                connection, nanoseconds, data = next(source)
            except StopIteration:
                return
            except Exception as error:  # the library raises what damaged bytes make of its code
                following = bisect_right(ends, done)
                notices.tally("parts of the bag left out because they are damaged", brief(error))
                if following == len(ends):
                    return
                since = done = ends[following]
                break
            done = max(done, nanoseconds + 1)
            if by_message:
                try:
                    data = decompress(data, "zstd", MAX_BYTES)
                except BadFileError as error:
                    notices.tally("messages left out because they are damaged", str(error))
                    continue
            yield connection, nanoseconds, data


def _files(path: Path) -> list[Path]:
    """What is to be opened: the bag, or the files of one without metadata.yaml."""
    return _storage_files(path) if path.is_dir() and not (path / "metadata.yaml").is_file() else [path]


def _storage_files(folder: Path) -> list[Path]:
    return of_one_bag(folder, ".db3") or cut_off_files(folder)


def _repair(path: Path) -> str:
    """The command that makes a whole bag of a database that is damaged."""
    if path.suffix.lower() == ".db3":
        mended = shlex.quote(str(path.with_stem(f"{path.stem}_whole")))
        return f' (if it was cut off, `sqlite3 {shlex.quote(str(path))} ".recover" | sqlite3 {mended}` mends it)'
    return f" (if it was cut off, `ros2 bag reindex {shlex.quote(str(path))}` mends it)" if path.is_dir() else ""


def _bound_decompression() -> None:
    """Puts our decompressors into the tables of rosbags, for each reader of this process."""
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap

    for method in ("bz2", "lz4"):
        reader.decompressors[method] = partial(_decompress, method)
    for method in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[method] = partial(_decompress, method)


def _decompress(method: str, data: bytes, _: int = 0) -> bytes:
    """As both tables call it; MCAP's with the size that the file promises, which is not to be trusted."""
    return decompress(data, method, MAX_BYTES)


def _decompresses_messages(bag: AnyReader) -> bool:
    """Whether the messages are compressed one by one; from now on the reader gives them as they are in the file."""
    found = False
    for reader in bag.readers:
        storage = getattr(reader, "storage", None)  # ROS 2
        if storage is not None and storage.metadata.compression_mode == "message":
            storage.metadata = storage.metadata._replace(compression_mode="ours")
        found = found or (storage is not None and storage.metadata.compression_mode == "ours")
    return found


def _chunk_ends(bag: AnyReader) -> list[int]:
    """Times, in nanoseconds, at which all of a chunk has been read; none for formats without chunks."""
    ends = set[int]()
    for reader in bag.readers:
        ends |= {chunk.end_time for chunk in getattr(reader, "chunk_infos", ())}  # ROS 1, one nanosecond later already
        storage = getattr(reader, "storage", None)
        for file in getattr(storage, "storages", (storage,)):
            ends |= {chunk.message_end_time + 1 for chunk in getattr(file, "chunks", ())}  # MCAP
    return sorted(ends)


def _check_metadata(path: Path) -> None:
    """Raises ValueError for YAML that takes its parser minutes: it is long, or nested as no bag's is."""
    if not path.is_file():
        return
    if path.stat().st_size > _MAX_METADATA_BYTES:
        raise ValueError(f"metadata.yaml is longer than {_MAX_METADATA_BYTES} bytes")
    depth = 0
    for bracket in re.finditer(rb"[\[\]{}]", path.read_bytes()):
        depth += 1 if bracket[0] in b"[{" else -1
        if depth > _MAX_NESTING:
            raise ValueError(f"metadata.yaml is nested deeper than {_MAX_NESTING}")


def _check_compressed_files(path: Path) -> None:
    """Raises BadFileError where files that are compressed as a whole would fill the disk."""
    for file in path.glob("*.zstd") if path.is_dir() else ():
        total = 0
        with file.open("rb") as data, zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as all:
            while block := all.read(_BLOCK):
                total += len(block)
                if total > _MAX_FILE_BYTES:
                    raise BadFileError(f"{file} would become more than {_MAX_FILE_BYTES} bytes: decompress it yourself")
