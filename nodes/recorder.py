"""Messages -> an MCAP file: what the player replays, and what a debugger wants to look at.

A channel is named by its message type; its messages are the codec's frames (msgs/WIRE.md), its
schema lists the fields with their dtypes and shapes. Beside them are channels that Foxglove draws, as it defines them
(nodes/foxglove_view.py): their names begin with a slash.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedWriter
from pathlib import Path
from typing import Any, Literal

from mcap.writer import CompressionType, Writer

from msgs import TYPES, Frame, GroundTruth, Message
from msgs.codec import ArraySpec, array_specs, encode
from nodes import Node
from nodes.foxglove_view import READ, FoxgloveView, Seen, nanoseconds

ENCODING = "mvsgs"  # of schemas and messages
COMPRESSION = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


class Recorder(Node):
    """Records what `reads` names. A recording that was cut off can still be played."""

    @dataclass
    class Config:
        path: str = "recording.mcap"  # file; must not exist
        compression: Literal["lz4", "zstd", "none"] = "lz4"  # zstd: smaller, slower
        foxglove: bool = True  # with images, poses, depth, points and the map as Foxglove shows them
        # message types of `reads` that are there for Foxglove's channels and not recorded themselves
        only_shown: list[str] = field(default_factory=list)

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        try:
            problem = _problem(config.path)
        except OSError as error:
            problem = f"{error.strerror or error}; give a file that can be written"
        if problem:
            raise OSError(f"path={config.path}: {problem}")
        shown = {t.__name__ for t in READ}
        if unknown := sorted(set(config.only_shown) - shown):
            raise ValueError(f"only_shown={unknown}: Foxglove's channels show {', '.join(sorted(shown))}")

    @classmethod
    def unused_inputs(cls, config: Config) -> frozenset[type]:
        return frozenset() if config.foxglove else frozenset(TYPES[name] for name in config.only_shown)

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._file: BufferedWriter | None = None
        self._channels: dict[str, int] = {}  # by topic
        self._counts: Counter[str] = Counter()
        self._indices: dict[type, set[int]] = {Frame: set(), GroundTruth: set()}  # that were recorded
        self._time = 0  # ns, of the last message that had one
        self._view = FoxgloveView() if self.config.foxglove else None

    def on_message(self, message: Message) -> None:
        timestamp = getattr(message, "timestamp", None)
        if isinstance(timestamp, float):
            self._time = nanoseconds(timestamp)
        name = type(message).__name__
        if name not in self.config.only_shown:
            with self.stats.time("record"):
                self._record(name, message)
            if isinstance(message, Frame | GroundTruth):
                self._indices[type(message)].add(message.index)
            self.stats.count("recorded")
        if self._view is not None:
            with self.stats.time("foxglove"):
                for seen in self._view.of(message):
                    self._show(seen)

    def on_end(self) -> Iterator[Any]:
        frames, truths = self._indices[Frame], self._indices[GroundTruth]
        if frames and (missed := len(truths - frames)):  # every frame has a ground truth, which none passes over
            self.stats.warn(
                f"{self.config.path} lacks {missed} of {len(truths | frames)} frames: of a live camera the recorder "
                "takes the newest one, and others came while it was busy"
            )
        self._finish()
        yield from ()

    def on_abort(self, reason: str) -> None:
        """What there is gets its index."""
        self._finish()

    def _record(self, name: str, message: Message) -> None:
        frame = bytes(encode(message, self._counts[name]))
        self._write(name, ENCODING, (name, ENCODING, _describe(type(message))), self._time, frame)

    def _show(self, seen: Seen) -> None:
        schema = seen.message.get_schema()
        described = schema.name, schema.encoding, schema.data
        self._write(seen.topic, schema.encoding, described, seen.ns, seen.message.encode())
        self.stats.count("shown")

    def _write(self, topic: str, encoding: str, schema: tuple[str, str, bytes], ns: int, data: bytes) -> None:
        """The next message of a topic. schema: its name, encoding and content."""
        if self._file is None:
            self._open()
        if topic not in self._channels:
            identity = self._writer.register_schema(*schema)
            self._channels[topic] = self._writer.register_channel(topic, encoding, identity)
        self._writer.add_message(self._channels[topic], ns, data, ns, self._counts[topic])
        self._counts[topic] += 1

    def _open(self) -> None:
        path = Path(self.config.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("xb")
        self._writer = Writer(self._file, compression=COMPRESSION[self.config.compression])
        self._writer.start(profile=ENCODING, library="mvsgs")

    def _finish(self) -> None:
        if self._file is not None:
            self._writer.finish()
            self._file.close()
            self._file = None


def _problem(path: str) -> str | None:
    """Why there can be no new recording of that name. Raises OSError where nothing can be written there."""
    if not path:
        return "is empty; give a file, such as recording.mcap"
    file = Path(path).absolute()
    if file.is_dir():
        return f"is a folder; give a file, such as {file / 'recording.mcap'}"
    if os.path.lexists(file):
        return "that recording exists already; give another file"
    place = next(folder for folder in file.parents if folder.exists())
    if not place.is_dir():
        return f"{place} is a file; give another file"
    tempfile.TemporaryFile(dir=place).close()  # leaves nothing
    return None


def _describe(message_type: type) -> bytes:
    """One line a field, as in `image: uint8 H W 3`."""
    lines = []
    for name, spec in array_specs(message_type).items():
        if isinstance(spec, ArraySpec):
            text = " ".join(map(str, (spec.dtype.name, *spec.dims))) + (" or nil" if spec.optional else "")
        else:
            text = spec.__name__
        lines.append(f"{name}: {text}")
    return "\n".join(lines).encode()
