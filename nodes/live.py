"""What a live camera and a robot's stream have in common: their frames are numbered as they are taken."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from msgs import End, Frame, GroundTruth
from mvsgs_core.datasets.masks import CameraMask
from mvsgs_core.datasets.options import SizedSelection
from mvsgs_core.geometry import is_rigid
from nodes import Node
from nodes.fixed_mask import FixedMask
from nodes.stream_frames import StreamFrames
from nodes.stream_presence import Presence

POLL = 0.5  # s at most between two looks at whether the stream goes on


def camera_mask(file: str | Path | None) -> CameraMask | None:
    """The mask of all frames; raises FileNotFoundError and ValueError for a file that is none."""
    return None if file is None else CameraMask(file)


class LiveSource(Node, ABC):
    """Frame, and GroundTruth with the same image to score renders against. A subclass says what comes."""

    live: ClassVar[bool] = True
    stamped: ClassVar[bool] = True  # frames come with the time at which they were taken

    @dataclass
    class Config(SizedSelection):
        hide_fixed: bool = True  # mask what is fixed to the camera: a logo, a robot's arm; not beside `mask`
        timeout: float = 30.0  # s without a usable frame, while it is waited for, before the stream ends

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._frames = StreamFrames(self.stats, self._sender, self.stamped)
        self._presence = Presence(self.stats, self._sender, self.config.timeout)
        self._camera_mask = camera_mask(self.config.mask)
        for note in [] if self._camera_mask is None else self._camera_mask.notices:
            self.stats.warn(note)
        self._told_before = len(self.stats.warnings)  # of the mask, not of the stream

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
                    shown = replace(
                        fixed.masked(self._framed(frame)), index=index, captured=came,
                        original_intrinsics=frame.intrinsics, world_from_cam=None,
                    )  # fmt: skip
                    self.stats.count("frames")
                    yield shown
                    yield GroundTruth(
                        index, shown.timestamp, shown.image, shown.intrinsics, self._given_pose(frame), None,
                        mask=shown.mask,
                    )  # fmt: skip
                    index += 1
                taken += 1
        finally:
            self._close()

    def _take(self, first: bool) -> Frame | None:
        """The next usable frame, as it comes; None at the stream's end. Raises TimeoutError where none ever comes."""
        began = time.monotonic()
        while (left := max(began, self._frames.heard) + self.config.timeout - time.monotonic()) > 0:
            came = self._next(min(POLL, left))
            if isinstance(came, End):
                return None
            if came is None:
                self._presence.wait(began)
            elif (usable := self._frames.accept(came)) is not None:
                return usable
        silence = f"{self._silence} for {self.config.timeout:g} s"
        if first:
            told = self.stats.warnings[self._told_before :]
            raise TimeoutError(f"{silence}: {self._frames.refused or next(iter(told), self._hint())}")
        self.stats.warn(f"{silence}: the stream ends here")
        return None

    def _given_pose(self, frame: Frame) -> np.ndarray | None:
        """(4, 4) world_from_cam, where the sender knows it."""
        pose = frame.world_from_cam
        if pose is None or is_rigid(pose):
            return pose
        text = f"poses of {self._sender} that are no rotation and position (4x4, last row 0 0 0 1) were left out"
        self.stats.refuse("poses", 1, text)
        return None

    @property
    def _sender(self) -> str:
        """As warnings name it."""
        return "the camera"

    @property
    @abstractmethod
    def _silence(self) -> str:
        """That nothing usable comes, as a user reads it."""

    @abstractmethod
    def _hint(self) -> str:
        """What to look at where nothing came at all."""

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _next(self, seconds: float) -> Frame | End | None:
        """What comes within that time, None where nothing does; `_presence` is told of it."""

    @abstractmethod
    def _framed(self, frame: Frame) -> Frame:
        """As it is delivered."""

    @abstractmethod
    def _close(self) -> None: ...
