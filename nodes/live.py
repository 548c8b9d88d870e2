"""What a live camera and a robot's stream have in common: their frames are numbered as they are taken."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from msgs import Frame, GroundTruth
from mvsgs_core.datasets.masks import CameraMask
from mvsgs_core.datasets.options import SizedSelection
from nodes import Node
from nodes.fixed_mask import FixedMask


def camera_mask(file: str | Path | None) -> CameraMask | None:
    """The mask of all frames; raises FileNotFoundError and ValueError for a file that is none."""
    return None if file is None else CameraMask(file)


class LiveSource(Node, ABC):
    """Frame, and GroundTruth with the same image to score renders against."""

    live: ClassVar[bool] = True

    @dataclass
    class Config(SizedSelection):
        hide_fixed: bool = True  # mask what is fixed to the camera: a logo, a robot's arm; not beside `mask`

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._camera_mask = camera_mask(self.config.mask)
        for note in [] if self._camera_mask is None else self._camera_mask.notices:
            self.stats.warn(note)

    def run(self) -> Iterator[Frame | GroundTruth]:
        """Ends where the stream does, and when nothing comes any more, so that a session still finishes its map."""
        taken = index = 0
        fixed = FixedMask(self.stats, self.config.hide_fixed and self.config.mask is None)
        self._open()
        try:
            while self.config.stop is None or taken < self.config.stop:
                frame = self._take(first=taken == 0)
                if frame is None:
                    return
                came = time.time()
                if self.config.has(taken):
                    shown = replace(fixed.masked(self._framed(frame)), index=index, captured=came)
                    self.stats.count("frames")
                    yield shown
                    yield GroundTruth(
                        index, shown.timestamp, shown.image, shown.intrinsics, None, None, mask=shown.mask
                    )
                    index += 1
                taken += 1
        finally:
            self._close()

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _take(self, first: bool) -> Frame | None:
        """The next frame of the stream, as it comes; None at its end. Raises where none ever comes."""

    @abstractmethod
    def _framed(self, frame: Frame) -> Frame:
        """As it is delivered."""

    @abstractmethod
    def _close(self) -> None: ...
