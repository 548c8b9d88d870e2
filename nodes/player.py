"""Source: a recording of `nodes.recorder`, played again."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

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
MOST_EARLY = 256  # ground truths that wait for their frames, at most: the edges to a recorder hold fewer


class Player(Node):
    """An MCAP recording -> its Frame messages in the order of their recording, and their GroundTruth.

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
        recording, pairs = self._recording(), _Pairs()
        playback, due = Playback(self.stats.warn), 0.0
        try:
            for message in self._wanted(recording, pairs):
                if c.realtime and isinstance(message, Frame):
                    due = playback.wait(message.timestamp)
                self.stats.count("frames", isinstance(message, Frame))
                yield replace(message, captured=due)  # not when it was recorded
        finally:  # also when the run is interrupted
            for warning in recording.warnings:
                self.stats.warn(warning)
            if pairs.alone:
                self.stats.warn(
                    f"{c.path} lacks the frames of {pairs.alone} ground truths, which are left out: the recorder of a "
                    "live camera takes the newest frame and passes over others"
                )
        if pairs.frames <= c.start:
            raise ValueError(f"{c.path} has {pairs.frames} frames: start={c.start} is beyond its end")
        if not self.stats.counts.get("frames"):
            raise _nothing_played(recording, c)

    def _wanted(self, recording: McapFile, pairs: _Pairs) -> Iterator[Frame | GroundTruth]:
        """The frames of the selection, which counts those that were recorded, and their ground truths."""
        c, truths = self.config, GroundTruth.__name__
        for record in self._records(recording):
            if record.topic != truths:
                pairs.frames = max(pairs.frames, record.sequence + 1)
            message = self._decoded(record, recording)
            if isinstance(message, Frame):
                yield from pairs.of_frame(message, c.has(record.sequence))
            elif message is not None:
                yield from pairs.of_truth(message)
            past = c.stop is not None and pairs.frames >= c.stop
            if past and recording.indexed and (truths not in recording.indexed or pairs.complete):
                return
        pairs.end()

    def _recording(self) -> McapFile:
        assert self.config.path is not None
        return McapFile(Path(self.config.path), MAX_MESSAGE_BYTES)

    def _records(self, recording: McapFile) -> Iterator[Recorded]:
        """Those of the topics that are played."""
        names = {t.__name__ for t in PLAYED}
        for record in recording.messages():
            if record.topic not in names:
                continue
            if record.encoding != ENCODING:
                held = brief(ValueError(record.encoding))
                raise BadFileError(f"{self.config.path} holds {held} messages: play recorder=mcap's")
            yield record

    def _decoded(self, record: Recorded, recording: McapFile) -> Frame | GroundTruth | None:
        try:
            message = decode(record.data, expect=PLAYED).message
            assert isinstance(message, PLAYED)
            check_intrinsics(message.intrinsics, (message.image.shape[0], message.image.shape[1]))
            _check_original(message)
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


def _check_original(message: Frame | GroundTruth) -> None:
    """Raises ValueError for intrinsics of an original image, of a size that is not known, that no camera has."""
    original = message.original_intrinsics if isinstance(message, Frame) else None
    if original is not None and not (np.isfinite(original).all() and (original[:2] > 0.0).all()):
        raise ValueError(f"original intrinsics {original.tolist()}")


class _Pairs:
    """Ground truths of the frames that are played: those of the same index. A live recording lacks frames, not truths,
    and the two topics reach the recorder in any order."""

    def __init__(self) -> None:
        self.frames = 0  # that were recorded, so far
        self.alone = 0  # truths whose frame was not recorded
        self._indices: set[int] = set()  # of the frames so far
        self._open: set[int] = set()  # of those that are played, whose truth did not come yet
        self._early: dict[int, GroundTruth] = {}  # truths whose frame may still come
        self._newest_frame = self._newest_truth = self._newest_played = -1  # indices

    @property
    def complete(self) -> bool:
        """Whether the truths of all frames that were played have come."""
        return self._newest_truth >= self._newest_played

    def end(self) -> None:
        """No frame comes any more."""
        self.alone += len(self._early)

    def of_frame(self, frame: Frame, wanted: bool) -> Iterator[Frame | GroundTruth]:
        """What is played once it has come; `wanted`: of the selection."""
        self._indices.add(frame.index)
        self._newest_frame = max(self._newest_frame, frame.index)
        truth = self._early.pop(frame.index, None)
        for index in [index for index in self._early if index < self._newest_frame]:
            del self._early[index]
            self.alone += 1
        if not wanted:
            return
        self._newest_played = max(self._newest_played, frame.index)
        yield frame
        if truth is not None:
            yield truth
        else:
            self._open.add(frame.index)

    def of_truth(self, truth: GroundTruth) -> Iterator[GroundTruth]:
        self._newest_truth = max(self._newest_truth, truth.index)
        if truth.index in self._open:
            self._open.remove(truth.index)
            yield truth
        elif truth.index > self._newest_frame:
            self._early[truth.index] = truth
            if len(self._early) > MOST_EARLY:
                del self._early[next(iter(self._early))]
                self.alone += 1
        elif truth.index not in self._indices:
            self.alone += 1


def _nothing_played(recording: McapFile, config: Player.Config) -> BadFileError:
    said = "; ".join(recording.warnings) or "it holds no frames"
    return BadFileError(f"{config.path}: nothing of it can be played: {said}")
