"""Small nodes for tests of processes and graphs: a source, two branches and a join."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msgs import Frame, GroundTruth, Keyframe
from nodes import Node


class Source(Node):
    """Frames whose pixels hold their index."""

    @dataclass
    class Config:
        count: int = 10  # frames
        height: int = 480  # pixels
        width: int = 640  # pixels
        delay: float = 0.0  # s before each frame
        hang_at: int | None = None  # frame whose read never returns
        fail_at: int | None = None  # frame whose read raises

    def run(self) -> Iterator[Frame]:
        c = self.config
        for index in range(c.count):
            time.sleep(c.delay)
            if index == c.hang_at:
                time.sleep(1e6)
            if index == c.fail_at:
                raise OSError(f"frame {index} cannot be read")
            self.stats.count("frames")
            yield Frame(index, index / 30, np.full((c.height, c.width, 3), index % 256, np.uint8), np.ones(4))


class Left(Node):
    """Frame -> Keyframe."""

    @dataclass
    class Config:
        delay: float = 0.0  # s for each frame
        fail_at: int | None = None  # frame that raises
        die_at: int | None = None  # frame at which the process is gone

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        time.sleep(self.config.delay)
        if frame.index == self.config.fail_at:
            raise RuntimeError(f"no pose for frame {frame.index}\nand a second line")
        if frame.index == self.config.die_at:
            os.kill(os.getpid(), 9)
        self.stats.count("keyframes")
        ones = np.ones((2, 2), np.float32)
        yield Keyframe(frame.index, frame.timestamp, frame.image, frame.intrinsics, np.eye(4), 1.0, ones, ones, 0)


class Right(Node):
    """Frame -> GroundTruth."""

    @dataclass
    class Config:
        delay: float = 0.0  # s for each frame

    def on_frame(self, frame: Frame) -> Iterator[GroundTruth]:
        time.sleep(self.config.delay)
        yield GroundTruth(frame.index, frame.timestamp, frame.image, frame.intrinsics, None, None)


class Join(Node):
    """Writes what it got to a JSON file; at an early end to another, `.aborted`."""

    @dataclass
    class Config:
        path: Path = Path("joined.json")
        abort_seconds: float = 0.0  # that saving takes
        delay: float = 0.0  # s for each message
        slices: int = 0  # of background work after each message

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self.received: dict[str, list[int]] = {"Keyframe": [], "GroundTruth": []}
        self.left = 0

    def on_keyframe(self, message: Keyframe) -> None:
        self._add(message)

    def on_ground_truth(self, message: GroundTruth) -> None:
        self._add(message)

    def on_idle(self) -> list[Any] | None:
        if self.left == 0:
            return None
        self.left -= 1
        self.stats.count("slices")
        return []

    def on_end(self) -> Iterator[Any]:
        self.config.path.write_text(json.dumps({"received": self.received, "upstream": self.upstream}))
        yield from ()

    def on_abort(self, reason: str) -> None:
        time.sleep(self.config.abort_seconds)
        self.config.path.with_suffix(".aborted").write_text(json.dumps({"received": self.received, "reason": reason}))

    def _add(self, message: Keyframe | GroundTruth) -> None:
        time.sleep(self.config.delay)
        assert (message.image == message.index % 256).all()
        self.received[type(message).__name__].append(message.index)
        self.left = self.config.slices


class Wrong(Node):
    """Yields what its annotation does not say."""

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        yield frame  # type: ignore[misc]
