"""A source whose camera moves to and fro through the room, for as long as one likes.

`dataset._target_=bench.faults.to_and_fro.ToAndFro dataset.frames=10000`.

What grows with the length of such a stream, and not with what the camera sees, should not.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from msgs import Frame, GroundTruth
from mvsgs_core.datasets import open_dataset
from nodes import Node

RATE = 20.0  # frames a second, by their timestamps
EVERY = 50  # frames between two lines of progress


class ToAndFro(Node):
    """The first `span` frames of the synthetic room, forward and backward again, with new noise each time."""

    replayable = True

    @dataclass
    class Config:
        frames: int = 10_000  # length of the stream
        span: int = 48  # frames one way
        size: list[int] = field(default_factory=lambda: [72, 96])  # height, width
        noise: int = 2  # largest change of a pixel, 8-bit levels
        progress: str | None = None  # file of lines "time.monotonic() frames"; null: none

    config: Config

    def run(self) -> Iterator[Frame | GroundTruth]:
        views = list(open_dataset("synthetic", size=self.config.size, frames=120, threads=1, stop=self.config.span))
        there_and_back = [*views, *views[-2:0:-1]]
        self.stats.values["frames_expected"] = self.config.frames
        noise = self.config.noise
        for n in range(self.config.frames):
            view = there_and_back[n % len(there_and_back)]
            change = np.random.default_rng(n).integers(-noise, noise + 1, view.image.shape, np.int16)
            image = np.clip(view.image + change, 0, 255).astype(np.uint8)
            self.stats.count("frames")
            yield Frame(n, n / RATE, image, view.intrinsics)
            yield GroundTruth(n, n / RATE, image, view.intrinsics, view.world_from_cam, view.depth)
            if (n + 1) % EVERY == 0:
                self._tell(n + 1)

    def _tell(self, frames: int) -> None:
        if self.config.progress is not None:
            with Path(self.config.progress).open("a") as file:
                file.write(f"{time.monotonic()} {frames}\n")
