"""Source: frames that another program, such as a robot's, publishes over ZeroMQ; msgs/WIRE.md has their form."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msgs import End, Frame, GroundTruth
from msgs.codec import CodecError
from mvsgs_core.camera import resize_image, scale_intrinsics
from mvsgs_core.datasets.framing import target_size
from mvsgs_core.datasets.sequence import selection
from nodes import Node
from nodes.addresses import load_keys
from nodes.transport import NewestReader

POLL = 0.5  # s at most between two looks at the clock


class Robot(Node):
    """Frames published elsewhere -> Frame, numbered anew, and GroundTruth with the same image to score renders against.

    Best effort: only the newest frame is taken, the robot is never held back.
    """

    @dataclass
    class Config:
        path: str = "tcp://127.0.0.1:5555"  # address at which the other program publishes Frame messages
        start: int = 0  # frames to leave out at first
        stop: int | None = None  # end after so many frames from the first one on; null: until End or Ctrl-C
        stride: int = 1  # every which frame of those that are taken
        size: list[int] | int | None = None  # [height, width], or a number of pixels at the same aspect; null: as sent
        timeout: float = 30.0  # s without a frame before the robot counts as gone
        keys: str | None = None  # folder with the CURVE keys that the publisher has too; null: none

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        c = self.config
        selection(c.start, c.stop, c.stride)  # refuses what is none
        target_size(c.size, (480, 640))
        self._native: tuple[int, int] | None = None

    def run(self) -> Iterator[Frame | GroundTruth]:
        """Ends with the publisher's End, or when it falls silent after it sent frames.

        Raises TransportError for an address that is none and TimeoutError if no frame ever comes.
        """
        keys = None if self.config.keys is None else load_keys(Path(self.config.keys))
        reader = NewestReader(self.config.path, Frame, topic=f"robot at {self.config.path}", keys=keys)
        taken = index = 0
        try:
            while self.config.stop is None or taken < self.config.stop:
                frame = self._receive(reader, first=taken == 0)
                self.stats.counts["dropped"] = reader.skipped
                if frame is None:
                    return
                number, taken = taken, taken + 1
                if number < self.config.start or (number - self.config.start) % self.config.stride:
                    continue
                framed = self._framed(frame, index)
                if framed is not None:
                    self.stats.count("frames")
                    yield framed
                    yield GroundTruth(index, framed.timestamp, framed.image, framed.intrinsics, None, None)
                    index += 1
        finally:
            reader.close()

    def _receive(self, reader: NewestReader, first: bool) -> Frame | None:
        """The next frame, None at the end of the stream."""
        deadline = time.monotonic() + self.config.timeout
        while time.monotonic() < deadline:
            reader.watch()
            try:
                message = reader.receive(POLL)
            except CodecError as error:
                self.stats.count("refused")
                self.stats.warn(f"the robot sent what is no Frame, it was left out: {error}")
                continue
            if isinstance(message, Frame):
                return message
            if isinstance(message, End):
                return None
        silence = f"no frame from {self.config.path} for {self.config.timeout:g} s"
        if first:
            raise TimeoutError(f"{silence}: is the program that publishes there running (see examples/robot.py)?")
        self.stats.warn(f"{silence}: the stream ends here")
        return None

    def _framed(self, frame: Frame, index: int) -> Frame | None:
        """The frame at the wanted size; None, with a warning, if it cannot belong to the same stream."""
        native = frame.image.shape[0], frame.image.shape[1]
        self._native = self._native or native
        if native != self._native:
            self.stats.warn(f"frames of another size than the first, {self._native}, were left out, such as {native}")
            return None
        if not np.all(np.isfinite(frame.intrinsics)) or np.any(frame.intrinsics[:2] <= 0):
            self.stats.warn(f"frames without valid intrinsics were left out, such as {frame.intrinsics}")
            return None
        size = target_size(self.config.size, native)
        intrinsics = scale_intrinsics(frame.intrinsics, native, size)
        return Frame(index, frame.timestamp, resize_image(frame.image, size), intrinsics, frame.intrinsics_guessed)
