"""Source -> Relay -> Sink, with ways to misbehave."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from msgs import Frame, GroundTruth, Keyframe, Poses
from nodes import Node


class Source(Node):
    """Frames 0, 1, 2, ... and their GroundTruth."""

    @dataclass
    class Config:
        count: int = 5  # frames; 0: until it is told to end
        period: float = 0.0  # seconds between two
        size: tuple[int, int] = (4, 6)  # pixels, height and width
        mode: Literal["gray", "color"] = "gray"
        path: str | None = None
        device: str = "auto"

    config: Config

    def run(self) -> Iterator[Frame | GroundTruth]:
        index = 0
        while self.config.count == 0 or index < self.config.count:
            image = np.full((*self.config.size, 3), index % 256, np.uint8)
            intrinsics = np.ones(4)
            self.stats.count("frames")
            yield Frame(index, index / 30, image, intrinsics)
            yield GroundTruth(index, index / 30, image, intrinsics, None, None)
            time.sleep(self.config.period)
            index += 1


class Relay(Node):
    """Every `stride`-th Frame -> Keyframe, and three slices of idle work after each."""

    @dataclass
    class Config:
        stride: int = 1  # frames
        gain: float = 1.0
        fail_at: int | None = None  # frame at which it raises
        kill_at: int | None = None  # frame at which it is killed, as by the system
        hang_at: int | None = None  # frame at which it stops answering, SIGTERM included
        tell_at: int | None = None  # frame at which its log says so
        seconds: float = 0.0  # work per frame
        long_at: int | None = None  # frame that takes long
        long: float = 0.0  # seconds of it
        how: Literal["asleep", "busy", "locked"] = "asleep"  # meanwhile; locked: none of its threads can run
        says: str | None = None  # a warning
        nothing: str | None = None  # why its result is empty

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._idle = 0

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses]:
        self._misbehave(frame.index)
        time.sleep(self.config.seconds)
        if frame.index % self.config.stride == 0:
            self._idle = 3
            self.stats.count("keyframes")
            unknown = np.zeros((1, 1), np.float32)
            yield Keyframe(
                frame.index, frame.timestamp, frame.image, frame.intrinsics, np.eye(4), 1.0, unknown, unknown, 0
            )

    def on_idle(self) -> list[Keyframe | Poses] | None:
        if self._idle == 0:
            return None
        self._idle -= 1
        self.stats.count("idle")
        return []

    def on_end(self) -> Iterator[Poses]:
        if self.config.says is not None:
            self.stats.values["says"] = self.config.says
            self.stats.warnings.append(self.config.says)  # past what makes it printable: a node may do anything
        if self.config.nothing is not None:
            self.stats.nothing(self.config.nothing)
        yield Poses(1, np.zeros(1, np.int64), np.eye(4)[None], np.ones(1))

    def _misbehave(self, index: int) -> None:
        if index == self.config.tell_at:
            logging.info("is at frame %d", index)
        if index == self.config.fail_at:
            raise ArithmeticError(f"frame {index} cannot be relayed")
        if index == self.config.kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        if index == self.config.hang_at:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            logging.info("hangs")
            while True:
                time.sleep(1)
        if index == self.config.long_at:
            take(self.config.long, self.config.how)


def take(seconds: float, how: str) -> None:
    """That time: asleep, busy in Python, or in a call that keeps the interpreter's lock."""
    if how == "locked":
        ctypes.PyDLL(None).read(os.pipe()[0], ctypes.create_string_buffer(1), 1)  # nobody writes
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if how == "asleep":
            time.sleep(seconds)


@dataclass
class Labels:
    tint: int = 1  # of nothing
    shade: float = 0.5


class Sink(Node):
    """Writes what arrived to `output`/sink.json."""

    @dataclass
    class Config:
        output: str
        labels: Labels = field(default_factory=Labels)
        refuse: bool = False  # fails before the run starts
        long: float = 0.0  # seconds for each keyframe

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        if self.config.refuse:
            raise OSError(28, "No space left on device")
        self.keyframes: list[int] = []
        self.truths: list[int] = []
        self.poses = 0
        self.seen_upstream: dict[str, Any] = {}

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[None]:
        take(self.config.long, "asleep")
        self.keyframes.append(keyframe.index)
        self.stats.count("keyframes")
        yield from ()

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[None]:
        self.truths.append(truth.index)
        yield from ()

    def on_poses(self, poses: Poses) -> Iterator[None]:
        self.poses += 1
        yield from ()

    def on_end(self) -> Iterator[None]:
        threads = os.environ.get("OMP_NUM_THREADS")
        self.seen_upstream = dict(self.upstream)
        upstream = {name: stats.get("counts", {}) for name, stats in self.upstream.items()}
        Path(self.config.output, "sink.json").write_text(
            json.dumps(
                {
                    "keyframes": self.keyframes,
                    "truths": self.truths,
                    "poses": self.poses,
                    "upstream": upstream,
                    "threads": threads,
                }
            )
        )
        yield from ()


class Bare(Node):
    """Neither source nor handler."""


class Untyped(Node):
    """Does not say what it takes."""

    def on_frame(self, frame):
        yield frame


class Returning(Node):
    """Returns what it should yield."""

    def on_frame(self, frame: Frame) -> Keyframe | None:
        return None


class Loop(Node):
    """Keyframe -> Frame: closes a cycle with Relay."""

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Frame]:
        yield Frame(keyframe.index, keyframe.timestamp, keyframe.image, keyframe.intrinsics)


class Uncorrected(Node):
    """A Relay that never sends Poses."""

    @dataclass
    class Config:
        device: str = "auto"
        every: int = 2

    config: Config

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        if frame.index % self.config.every == 0:
            unknown = np.zeros((1, 1), np.float32)
            yield Keyframe(
                frame.index, frame.timestamp, frame.image, frame.intrinsics, np.eye(4), 1.0, unknown, unknown, 0
            )


class LateSink(Node):
    """Takes long to start, as what loads torch on a busy machine does; writes `output`/late.json."""

    @dataclass
    class Config:
        output: str
        seconds: float = 2.0

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        time.sleep(self.config.seconds)
        self.keyframes: list[int] = []

    def on_keyframe(self, keyframe: Keyframe) -> None:
        self.keyframes.append(keyframe.index)

    def on_end(self) -> None:
        told = {"keyframes": self.keyframes, "relay_cpu": self.upstream["relay"]["cpu_seconds"]}
        Path(self.config.output, "late.json").write_text(json.dumps(told))


class Undecorated(Bare):
    """Its Config is no dataclass."""

    class Config:
        stride: int = 1


@dataclass(frozen=True)
class Kept:
    stride: int = 1


class Added(Bare):
    """Its Config inherits from one, and has a parameter that that does not know."""

    class Config(Kept):
        gain: float = 1.0


class Sighted(Node):
    """A source that knows no truth."""

    def run(self) -> Iterator[Frame]:
        yield Frame(0, 0.0, np.zeros((4, 6, 3), np.uint8), np.ones(4))
