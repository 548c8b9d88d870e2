"""KITTI odometry (Geiger et al., "Are we ready for Autonomous Driving?", CVPR 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import image_size, size_doubt
from mvsgs_core.datasets.files import Layout, numbered_images, read_numbers, read_rows
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import is_rigid
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from mvsgs_core.trajectory_file import LATEST

LAYOUT = Layout(
    "KITTI odometry",
    "a folder such as sequences/00 with image_2/000000.png, ... (or image_0), calib.txt (lines `P2: ` and a 3x4 "
    "projection), times.txt (seconds) and, if known, poses.txt in it or ../../poses/00.txt (3x4 camera 0 to world)",
    "https://www.cvlibs.net/datasets/kitti/eval_odometry.php, data_odometry_color.zip or data_odometry_gray.zip with "
    "data_odometry_calib.zip and data_odometry_poses.zip",
)
_FRAME_RATE = 10.0  # where times.txt is missing


@dataset
@dataclass(kw_only=True, eq=False)
class Kitti(ImageSequence):
    """One camera of a sequence, which is rectified; true poses are the left gray camera's, moved to it.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    camera: int | None = None  # 0, 1: gray, left and right; 2, 3: color; null: 2, or 0 where there is no image_2

    @staticmethod
    def recognizes(path: Path) -> bool:
        return (path / "calib.txt").is_file() and any((path / f"image_{i}").is_dir() for i in range(4))

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        camera = (2 if (folder / "image_2").is_dir() else 0) if self.camera is None else self.camera
        source = LAYOUT.folder(folder / f"image_{camera}")
        images = numbered_images(source)
        if not images:
            raise LAYOUT.missing(f"{source} has no 000000.png, 000001.png, ...")
        published, cam0_from_cam = read_projection(LAYOUT.file(folder / "calib.txt"), f"P{camera}", images)
        lens = self._lens(images, published)
        self.warnings += [] if self.intrinsics is not None else size_doubt(published)
        times, poses = self._times(folder, last=int(images[-1].stem)), self._poses(folder)
        records = []
        for image in images:
            number = int(image.stem)
            pose = poses[number] @ cam0_from_cam if number < len(poses) and is_rigid(poses[number]) else None
            time = number / _FRAME_RATE if times is None else float(times[number])
            records.append(Record(time, image, lens, pose))
        missing = sum(record.world_from_cam is None for record in records)
        if missing and len(poses):
            self.warnings.append(f"{missing} of {len(records)} images have no true pose")
        return Found(records)

    def _times(self, folder: Path, last: int) -> np.ndarray | None:
        """Seconds (N,) of the frames from 0 on, at least to the `last`; None where the file is missing. Raises
        BadFileError for what can be none."""
        path = folder / "times.txt"
        if not path.is_file():
            self.warnings.append(f"{path} is missing: frames are taken to come at {_FRAME_RATE:g} a second")
            return None
        times = read_numbers(path)
        if not np.all(np.abs(times) < LATEST) or np.any(np.diff(times) < 0):
            raise BadFileError(f"{path} must hold seconds that grow")
        if len(times) <= last:
            raise BadFileError(f"{path} has {len(times)} times, none of image {last}")
        return times

    def _poses(self, folder: Path) -> np.ndarray:
        """world_from_cam0 (N, 4, 4) of the frames from 0 on, not yet known to be poses. Raises BadFileError."""
        number = folder.resolve().name
        places = (folder / "poses.txt", folder.resolve().parent.parent / "poses" / f"{number}.txt")
        path = next((p for p in places if p.is_file()), None)
        if path is None:
            self.warnings.append(f"{places[1]} is missing: the trajectory is not scored")
            return np.zeros((0, 4, 4))
        lines = read_rows(path, (12,), "a 3x4 camera to world")
        poses = np.tile(np.eye(4), (len(lines), 1, 1))
        poses[:, :3] = lines.reshape(-1, 3, 4)
        return poses


def read_projection(calibration: Path, name: str, images: list[Path]) -> tuple[Lens, np.ndarray]:
    """The lens, and where the camera is as the left gray one sees it, (4, 4): K [I | t] in the file, on the line
    `name`. Raises BadFileError."""
    with reading(calibration, f"must hold a line `{name}: ` and 12 numbers, a projection K [I | t]"):
        projection = named_numbers(calibration, name, 12).reshape(3, 4)
        k = projection[:, :3]
        if k[2].tolist() != [0, 0, 1] or k[0, 1] != 0 or k[1, 0] != 0:
            raise ValueError(f"its first three columns are no camera matrix, {k.tolist()}")
        lens = Lens((float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])), image_size(images))
        cam0_from_cam = np.eye(4)
        cam0_from_cam[:3, 3] = -np.linalg.solve(k, projection[:, 3])
    return lens, cam0_from_cam


def named_numbers(calibration: Path, name: str, count: int) -> np.ndarray:
    """(count,) finite float64 of the line `name: ` of a file. Raises KeyError, ValueError."""
    text = calibration.read_text(encoding="utf-8-sig")
    lines = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    values = np.array([float(v) for v in lines[name].split()])
    if values.shape != (count,) or not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: {count} finite numbers are needed")
    return values
