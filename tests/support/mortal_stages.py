"""Stages whose process is killed once, after some keyframes, as by a power cut; started again, they live."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from msgs import CameraPose, Depth, Frame, FusedKeyframe, Keyframe, Poses, TrackedFrame, TrackerPhase
from nodes.depth_fusion import DepthFusion
from nodes.mvs import Mvs
from nodes.tracker import Tracker


FLUSHED = 0.2  # s after which what was sent has left the process: what ZeroMQ still has dies with it


def die_once(came: int, after: int, grave: str) -> None:
    """grave: the file that says that it has happened."""
    if came == after and not Path(grave).exists():
        Path(grave).touch()
        time.sleep(FLUSHED)
        os.kill(os.getpid(), signal.SIGKILL)


class MortalStereo(Mvs):
    @dataclass(frozen=True)
    class Config(Mvs.Config):
        after: int = 4  # keyframes
        grave: str = ""

    config: Config

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Depth]:
        yield from super().on_keyframe(keyframe)
        die_once(len(self._once.keyframes), self.config.after, self.config.grave)


class MortalTracker(Tracker):
    @dataclass(frozen=True)
    class Config(Tracker.Config):
        after: int = 40  # frames
        grave: str = ""

    config: Config

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        yield from super().on_frame(frame)
        if self._returning is not None:
            self._returning._due = 0.0  # saved with every keyframe, however slow the machine is
        die_once(frame.index, self.config.after, self.config.grave)


class MortalFusion(DepthFusion):
    @dataclass(frozen=True)
    class Config(DepthFusion.Config):
        after: int = 6  # keyframes
        grave: str = ""

    config: Config

    def on_depth(self, depth: Depth) -> Iterator[FusedKeyframe]:
        yield from super().on_depth(depth)
        die_once(len(self._once.keyframes), self.config.after, self.config.grave)
