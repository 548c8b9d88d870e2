"""localization.csv: each frame that was found in a map that stays as it is, as soon as it is."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TextIO

from msgs import Frame
from mvsgs_core.geometry import quaternion_from_rotation
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.tracker import NewestPose

FILE = "localization.csv"
HEADER = "index,timestamp,x,y,z,qw,qx,qy,qz,confidence,part"


class LocalizationFile:
    """Each pose is a line: world_from_cam, as CameraPose has it."""

    def __init__(self, output: Path | str | None, stats: Stats) -> None:
        """output: the run's directory; None: nothing is written."""
        self._path = None if output is None else Path(output) / FILE
        self._stats = stats
        self._file: TextIO | None = None
        self._mode: Literal["w", "a"] = "w"

    def go_on(self) -> None:
        """In a file that an earlier process of the run may have begun."""
        self._mode = "a"

    def add(self, frame: Frame, found: NewestPose | None) -> None:
        """A frame, and where it was found. A disk that is full costs lines, which is said, and no pose."""
        self._stats.count("frames not found in the map" if found is None else "frames found in the map")
        if found is None or self._path is None:
            return
        pose = found.world_from_cam
        numbers = [*pose[:3, 3].tolist(), *quaternion_from_rotation(pose[:3, :3]).tolist()]
        shown = ",".join(f"{number:.9g}" for number in numbers)
        try:
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open(self._mode, buffering=1)
                if self._file.tell() == 0:
                    self._file.write(f"{HEADER}\n")
            self._file.write(f"{frame.index},{frame.timestamp:.6f},{shown},{found.confidence:.3f},{found.segment}\n")
        except OSError as error:
            self._warn(error)

    def close(self) -> None:
        """What a full disk did not take is tried once more, and given up."""
        try:
            if self._file is not None:
                self._file.close()
        except OSError as error:
            self._warn(error)

    def _warn(self, error: OSError) -> None:
        self._stats.warn(f"{self._path} cannot be written: {error.strerror or error}")


__all__ = ["FILE", "HEADER", "LocalizationFile"]
