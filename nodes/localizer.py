"""Frame -> CameraPose, TrackerPhase, Trajectory: finds each frame in a map that another run left, and adds nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from msgs import CameraPose, Frame, Keyframe, Poses, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core.geometry import quaternion_from_rotation
from mvsgs_core.tracking.tracker import NewestPose
from nodes.tracker import Tracker

FILE = "localization.csv"
HEADER = "index,timestamp,x,y,z,qw,qx,qy,qz,confidence,part"


class Localizer(Tracker):
    """The tracker of a frozen map, see mvsgs_core.tracking.frozen_session. `map` must be given.

    Each pose is a line of localization.csv in the output, as soon as it is known: world_from_cam, as CameraPose has it.
    """

    @dataclass(frozen=True)
    class Config(Tracker.Config):
        pass

    config: Config
    frozen = True

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._file: TextIO | None = None

    @classmethod
    def check(cls, config: Tracker.Config) -> None:
        if config.map is None:
            raise ValueError("which map? give map=DIR, the output directory of a run with keep_map=true")
        super().check(config)

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        yield from super().on_frame(frame)
        found = self.core.newest_pose()
        self.stats.count("frames found in the map" if found is not None else "frames not found in the map")
        if found is not None and self.config.output is not None:
            self._write(Path(self.config.output) / FILE, frame, found)

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | Trajectory]:
        yield from super().on_end()
        if self._file is not None:
            self._file.close()

    def _write(self, path: Path, frame: Frame, found: NewestPose) -> None:
        """A disk that is full costs lines, which is said, and no pose."""
        pose = found.world_from_cam
        numbers = [*pose[:3, 3].tolist(), *quaternion_from_rotation(pose[:3, :3]).tolist()]
        shown = ",".join(f"{number:.9g}" for number in numbers)
        try:
            if self._file is None:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("w", buffering=1)
                self._file.write(f"{HEADER}\n")
            self._file.write(f"{frame.index},{frame.timestamp:.6f},{shown},{found.confidence:.3f},{found.segment}\n")
        except OSError as error:
            self.stats.warn(f"{path} cannot be written: {error.strerror or error}")
