"""Messages -> an MCAP file: what the player replays, and what a debugger wants to look at.

A channel is named by its message type; its messages are the codec's frames (msgs/WIRE.md), its
schema lists the fields with their dtypes and shapes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from typing import Any, Literal

from mcap.writer import CompressionType, Writer

from msgs import Message
from msgs.codec import ArraySpec, array_specs, encode
from nodes import Node

ENCODING = "mvsgs"  # of schemas and messages
COMPRESSION = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


class Recorder(Node):
    """Records what `reads` names. A recording that was cut off can still be played."""

    @dataclass
    class Config:
        path: str = "recording.mcap"  # file; must not exist
        compression: Literal["lz4", "zstd", "none"] = "lz4"  # zstd: smaller, slower

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        if Path(config.path).exists():
            raise FileExistsError(f"path={config.path}: that recording exists already; give another file")

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._file: BufferedWriter | None = None
        self._channels: dict[str, int] = {}  # by message type
        self._counts: Counter[str] = Counter()
        self._time = 0  # ns, of the last message that had one

    def on_message(self, message: Message) -> None:
        if self._file is None:
            self._open()
        name = type(message).__name__
        if name not in self._channels:
            schema = self._writer.register_schema(name, ENCODING, _describe(type(message)))
            self._channels[name] = self._writer.register_channel(name, ENCODING, schema)
        timestamp = getattr(message, "timestamp", None)
        if isinstance(timestamp, float):
            self._time = max(0, round(timestamp * 1e9))
        with self.stats.time("record"):
            frame = bytes(encode(message, self._counts[name]))
            self._writer.add_message(self._channels[name], self._time, frame, self._time, self._counts[name])
        self._counts[name] += 1
        self.stats.count("recorded")

    def on_end(self) -> Iterator[Any]:
        if self._file is not None:
            self._writer.finish()
            self._file.close()
        yield from ()

    def _open(self) -> None:
        path = Path(self.config.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("xb")
        self._writer = Writer(self._file, compression=COMPRESSION[self.config.compression])
        self._writer.start(profile=ENCODING, library="mvsgs")


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
