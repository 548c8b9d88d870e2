"""Stages whose process is killed once, as by a power cut; started again, they live.

They die one after the other, from stereo on, and the tracker last, for whom the stream waits: what a stage still holds
for another that is away dies with it, and what an earlier tracker sent no later one has. What the others sent comes
again.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from msgs import CameraPose, Depth, Frame, FusedKeyframe, GroundTruth, Keyframe, Poses, TrackedFrame, TrackerPhase
from mvsgs_core.tracking.publish import Update
from nodes.depth_fusion import DepthFusion
from nodes.mvs import Mvs
from nodes.reader import Reader
from nodes.tracker import Tracker


@dataclass(frozen=True)
class Death:
    grave: str = ""  # the file that says that it has happened
    after: str = ""  # the grave of a stage that must have come back before
    arrived: str = ""  # the file in which stereo says which keyframe it worked off last

    def come(self, now: bool, sent: int | None = None) -> None:
        """To be called when a message was worked off. now: it is time, as far as this stage knows. sent: the keyframe
        that must have arrived before, as what ZeroMQ still has dies with this process."""
        if not self.grave:
            return
        if Path(self.grave).exists():
            back(self.grave).touch()
        elif now and (not self.after or back(self.after).exists()):
            while sent is not None and self._newest() != sent:
                time.sleep(0.01)
            Path(self.grave).touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def note(self, keyframe: Keyframe) -> None:
        """That it has arrived."""
        if self.arrived:
            Path(self.arrived).write_text(f"{keyframe.index};")

    def _newest(self) -> int | None:
        said = Path(self.arrived).read_text() if Path(self.arrived).exists() else ""
        return int(said[:-1]) if said.endswith(";") else None


def back(grave: str) -> Path:
    """The file that says that who was killed works again."""
    return Path(f"{grave}.back")


class PatientReader(Reader):
    """Waits before a frame, as a camera does that is paused."""

    @dataclass
    class Config(Reader.Config):
        before: int = 40  # frame
        returned: str = ""  # the grave of a stage that must have come back

    config: Config

    def run(self) -> Iterator[Frame | GroundTruth]:
        for message in super().run():
            while message.index == self.config.before and not back(self.config.returned).exists():
                time.sleep(0.01)
            yield message


class MortalTracker(Tracker):
    @dataclass(frozen=True)
    class Config(Tracker.Config):
        frames: int = 40  # that come before it may be killed
        death: Death = Death()

    config: Config
    _sent: int | None = None  # the newest keyframe

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        yield from super().on_frame(frame)
        if self._returning is not None:
            self._returning._due = 0.0  # saved with every keyframe, however slow the machine is
        self.config.death.come(frame.index >= self.config.frames, self._sent)

    def _send(self, update: Update) -> Iterator[Keyframe | Poses | TrackedFrame]:
        for message in super()._send(update):
            yield message
            if isinstance(message, Keyframe):
                self._sent = message.index


class MortalStereo(Mvs):
    @dataclass(frozen=True)
    class Config(Mvs.Config):
        keyframes: int = 4  # that come before it may be killed
        death: Death = Death()

    config: Config

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Depth]:
        yield from super().on_keyframe(keyframe)
        self.config.death.note(keyframe)
        self.config.death.come(len(self._once.keyframes) >= self.config.keyframes)


class MortalFusion(DepthFusion):
    @dataclass(frozen=True)
    class Config(DepthFusion.Config):
        keyframes: int = 6  # that come before it may be killed
        death: Death = Death()

    config: Config

    def on_depth(self, depth: Depth) -> Iterator[FusedKeyframe]:
        yield from super().on_depth(depth)
        self.config.death.come(len(self._once.keyframes) >= self.config.keyframes)
