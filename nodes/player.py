"""Source: a recording of `nodes.recorder`, played again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from msgs import Frame, GroundTruth
from msgs.codec import MAX_MESSAGE_BYTES, VersionError, decode
from mvsgs_core.bad_file import BadFileError, brief
from mvsgs_core.camera import check_intrinsics
from mvsgs_core.datasets.mcap_file import McapFile, Recorded
from mvsgs_core.datasets.options import Selection
from nodes import Node
from nodes.playback import Playback
from nodes.recorder import ENCODING

PLAYED = (Frame, GroundTruth)


class Player(Node):
    """An MCAP recording -> its Frame and GroundTruth messages, in the order of their recording.

    Damaged parts are left out, counted and warned of. Raises BadFileError where nothing is left to play.
    """

    replayable = True

    @dataclass
    class Config(Selection):
        path: str | None = None  # .mcap file
        realtime: bool = False  # play at the recorded rate, not as fast as it is read

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        if config.path is None or not Path(config.path).is_file():
            raise FileNotFoundError(f"dataset.path={config.path}: must be an .mcap file, as recorder=mcap writes it")
        player = cls(config)
        recording = player._recording()
        for record in player._records(recording):
            if player._decoded(record, recording) is not None:
                return
        raise _nothing_played(recording, config)

    def run(self) -> Iterator[Frame | GroundTruth]:
        c = self.config
        self.check(c)
        recording = self._recording()
        playback, due = Playback(), 0.0
        last = -1
        try:
            for record in self._records(recording):
                place = record.sequence  # in its topic: the nth ground truth belongs to the nth frame, wherever it is
                last = max(last, place)
                if c.has(place):
                    message = self._decoded(record, recording)
                    if message is not None:
                        if c.realtime and isinstance(message, Frame):
                            due = playback.wait(message.timestamp)
                        self.stats.count("frames", isinstance(message, Frame))
                        yield replace(message, captured=due)  # not when it was recorded
        finally:  # also when the run is interrupted
            for warning in recording.warnings:
                self.stats.warn(warning)
        if last < c.start:
            raise ValueError(f"{c.path} has {last + 1} frames: start={c.start} is beyond its end")
        if not self.stats.counts.get("frames"):
            raise _nothing_played(recording, c)

    def _recording(self) -> McapFile:
        assert self.config.path is not None
        return McapFile(Path(self.config.path), MAX_MESSAGE_BYTES)

    def _records(self, recording: McapFile) -> Iterator[Recorded]:
        """Those of the topics that are played, until each has passed `stop`."""
        names = {t.__name__ for t in PLAYED}
        passed: set[str] = set()
        for record in recording.messages():
            if record.topic not in names:
                continue
            if record.encoding != ENCODING:
                held = brief(ValueError(record.encoding))
                raise BadFileError(f"{self.config.path} holds {held} messages: play recorder=mcap's")
            yield record
            if self.config.stop is not None and record.sequence >= self.config.stop - 1:
                passed.add(record.topic)
                if passed == names & recording.indexed:
                    return

    def _decoded(self, record: Recorded, recording: McapFile) -> Frame | GroundTruth | None:
        try:
            message = decode(record.data, expect=PLAYED).message
            assert isinstance(message, PLAYED)
            check_intrinsics(message.intrinsics, (message.image.shape[0], message.image.shape[1]))
            if not math.isfinite(message.timestamp):
                raise ValueError(f"at {message.timestamp} s")
        except VersionError as error:
            raise BadFileError(
                f"{self.config.path} was recorded by another release: {error}; record it anew"
            ) from error
        except ValueError as error:  # CodecError is one
            recording.leave_out(f"{record.topic} {record.sequence}: {brief(error)}")
            return None
        return message


def _nothing_played(recording: McapFile, config: Player.Config) -> BadFileError:
    said = "; ".join(recording.warnings) or "it holds no frames"
    return BadFileError(f"{config.path}: nothing of it can be played: {said}")
