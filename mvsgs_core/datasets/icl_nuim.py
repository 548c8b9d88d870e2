"""ICL-NUIM (Handa et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.files import Layout, numbered_images, visible
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record
from mvsgs_core.trajectory_file import read_trajectory

LAYOUT = Layout(
    "ICL-NUIM (TUM RGB-D compatible PNGs)",
    "a folder with rgb/0.png, 1.png, ..., depth/0.png, ... (16-bit, 5000 = 1 m) and groundtruth.txt (or the "
    "livingRoom0.gt.freiburg it comes as; lines `index tx ty tz qx qy qz qw`)",
    "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html, for example traj0_frei_png.tar.gz with its .gt.freiburg",
)
# Published as fy = -480: the renderer's y axis points up. Turning it down mirrors camera AND world, see `_mirror`.
_PUBLISHED = Lens((481.2, 480.0, 319.5, 239.5), (480, 640))
# below 0.1 m: the noise that the noisy variant's depth maps also have where nothing is known
_DEPTH = DepthFormat(per_unit=5000.0, invalid=tuple(range(500)))
_FRAME_RATE = 30.0
_Y_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])


@dataset
@dataclass(kw_only=True, eq=False)
class IclNuim(ImageSequence):
    """A trajectory of ICL-NUIM, with the y axes of camera and world turned down, so that the system is right-handed.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    @staticmethod
    def recognizes(path: Path) -> bool:
        known = _truth_files(path) and (path / "depth").is_dir() and not (path / "rgb.txt").exists()
        return bool(known and numbered_images(path / "rgb"))

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        rgb = folder / "rgb"
        images = numbered_images(rgb)
        if not images:
            raise LAYOUT.missing(f"{rgb} has no 0.png, 1.png, ...")
        lens = self._lens(images, _PUBLISHED)
        poses, notes = _poses(folder)
        self.warnings += notes
        records = [
            Record(int(p.stem) / _FRAME_RATE, p, lens, poses.get(int(p.stem)), folder / "depth" / f"{p.stem}.png")
            for p in images
        ]
        missing = sum(record.world_from_cam is None for record in records)
        if missing and poses:
            self.warnings.append(f"{missing} of {len(records)} images have no true pose")
        return Found(records, _DEPTH)


def _mirror(pose: np.ndarray) -> np.ndarray:
    """A pose between left-handed frames (y up) as one between right-handed frames (y down)."""
    return np.asarray(_Y_DOWN @ pose @ _Y_DOWN)


def _truth_files(folder: Path) -> list[Path]:
    return [p for p in (folder / "groundtruth.txt", *visible(folder, "*.gt.freiburg")) if p.is_file()]


def _poses(folder: Path) -> tuple[dict[int, np.ndarray], list[str]]:
    files = _truth_files(folder)
    if not files:
        return {}, ["groundtruth.txt is missing: the trajectory is not scored"]
    numbers, poses = read_trajectory(files[0])
    if len(numbers) == 0:
        return {}, [f"{files[0].name} is empty: the trajectory is not scored"]
    return {int(number): _mirror(pose) for number, pose in zip(numbers, poses)}, []
