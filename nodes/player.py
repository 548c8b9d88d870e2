"""Source: a recording of `nodes.recorder`, played again."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.reader import McapReader, NonSeekingReader, SeekingReader

from msgs import Frame, GroundTruth, Message
from msgs.codec import decode
from nodes import Node
from nodes.recorder import ENCODING

PLAYED = (Frame, GroundTruth)


class Player(Node):
    """An MCAP recording -> its Frame and GroundTruth messages, in the order of their recording."""

    @dataclass
    class Config:
        path: str | None = None  # .mcap file
        start: int = 0  # first frame, counted from the recording's first
        stop: int | None = None  # frame to stop before; null: the end
        stride: int = 1  # every which frame

    config: Config

    def run(self) -> Iterator[Frame | GroundTruth]:
        c = self.config
        if c.path is None or not Path(c.path).is_file():
            raise FileNotFoundError(f"dataset.path={c.path}: must be an .mcap file, as recorder=mcap writes it")
        if c.start < 0 or c.stride < 1 or (c.stop is not None and c.stop <= c.start):
            raise ValueError(f"start={c.start}, stop={c.stop}, stride={c.stride}: 0 <= start < stop and stride >= 1")
        position: dict[int, int] = {}  # frame index -> place in the recording: GroundTruth may come before its Frame
        for message in self._messages(Path(c.path)):
            place = position.setdefault(message.index, len(position))
            if c.stop is not None and place >= c.stop:
                return
            if place >= c.start and (place - c.start) % c.stride == 0:
                self.stats.count("frames", isinstance(message, Frame))
                yield message

    def _messages(self, path: Path) -> Iterator[Frame | GroundTruth]:
        with path.open("rb") as file:
            names = [t.__name__ for t in PLAYED]
            try:
                for _, channel, record in self._reader(file).iter_messages(topics=names, log_time_order=False):
                    if channel.message_encoding != ENCODING:
                        raise ValueError(
                            f"{path}: {channel.message_encoding} messages; only recorder=mcap's can be played"
                        )
                    message: Message = decode(record.data, expect=PLAYED).message
                    assert isinstance(message, PLAYED)
                    yield message
            except McapError as error:
                self.stats.warn(f"{path} ends early ({error}): it was cut off; what is there is played")
                logging.warning("%s: %s", path, error)

    def _reader(self, file: BinaryIO) -> McapReader:
        """With the file's index where it has one: a recording that was cut off has none."""
        try:
            indexed = SeekingReader(file)
            if indexed.get_summary() is not None:
                return indexed
        except McapError:
            self.stats.warn("the recording has no index: it was cut off; what is there is played")
        file.seek(0)
        return NonSeekingReader(file)
