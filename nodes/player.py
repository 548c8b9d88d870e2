"""Source: a recording of `nodes.recorder`, played again."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import InvalidMagic, McapError
from mcap.reader import McapReader, NonSeekingReader, SeekingReader

from msgs import Frame, GroundTruth
from msgs.codec import decode
from nodes import Node
from nodes.recorder import ENCODING

PLAYED = (Frame, GroundTruth)


class Player(Node):
    """An MCAP recording -> its Frame and GroundTruth messages, in the order of their recording."""

    replayable = True

    @dataclass
    class Config:
        path: str | None = None  # .mcap file
        start: int = 0  # first frame, counted from the recording's first
        stop: int | None = None  # frame to stop before; null: the end
        stride: int = 1  # every which frame

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        if config.path is None or not Path(config.path).is_file():
            raise FileNotFoundError(f"dataset.path={config.path}: must be an .mcap file, as recorder=mcap writes it")

    def run(self) -> Iterator[Frame | GroundTruth]:
        c = self.config
        self.check(c)
        assert c.path is not None
        if c.start < 0 or c.stride < 1 or (c.stop is not None and c.stop <= c.start):
            raise ValueError(f"start={c.start}, stop={c.stop}, stride={c.stride}: 0 <= start < stop and stride >= 1")
        last = -1
        for place, record in self._records(Path(c.path)):
            last = max(last, place)
            if place >= c.start and (place - c.start) % c.stride == 0 and (c.stop is None or place < c.stop):
                message = decode(record, expect=PLAYED).message
                assert isinstance(message, PLAYED)
                self.stats.count("frames", isinstance(message, Frame))
                yield message
        if last < c.start:
            raise ValueError(f"{c.path} has {last + 1} frames: start={c.start} is beyond its end")

    def _records(self, path: Path) -> Iterator[tuple[int, bytes]]:
        """Messages with their place in their topic: the nth ground truth belongs to the nth frame, wherever it is."""
        names = [t.__name__ for t in PLAYED]
        with path.open("rb") as file:
            reader, topics = self._open(file)
            passed: set[str] = set()  # topics of which the rest is not wanted
            try:
                for _, channel, record in reader.iter_messages(topics=names, log_time_order=False):
                    if channel.message_encoding != ENCODING:
                        raise ValueError(f"{path} holds {channel.message_encoding} messages: play recorder=mcap's")
                    yield record.sequence, record.data
                    if self.config.stop is not None and record.sequence >= self.config.stop - 1:
                        passed.add(channel.topic)
                        if passed == topics:
                            return
            except InvalidMagic as error:
                raise ValueError(f"{path} is no recording: {error}") from error
            except McapError as error:
                self.stats.warn(f"{path} was cut off: what is there is played ({type(error).__name__} {error})")

    def _open(self, file: BinaryIO) -> tuple[McapReader, set[str]]:
        """A reader and, where the file has its index, the topics to play: a recording that was cut off has none."""
        try:
            reader = SeekingReader(file)
            summary = reader.get_summary()
            if summary is not None:
                names = {t.__name__ for t in PLAYED}
                return reader, names & {channel.topic for channel in summary.channels.values()}
        except McapError:
            logging.info("no index: read from its beginning")
        file.seek(0)
        return NonSeekingReader(file), set()
