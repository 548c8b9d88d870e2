"""KITTI raw, rectified and synced (Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.files import Layout, numbered_images, read_numbers
from mvsgs_core.datasets.kitti import named_numbers, read_projection
from mvsgs_core.datasets.model import rigid
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from mvsgs_core.geometry import so3_exp

LAYOUT = Layout(
    "KITTI raw",
    "a folder such as 2011_09_26/2011_09_26_drive_0001_sync with image_02/data/0000000000.png, ... (or image_00), "
    "image_02/timestamps.txt and, if known, oxts/data/0000000000.txt; in it or the folder above calib_cam_to_cam.txt, "
    "calib_velo_to_cam.txt and calib_imu_to_velo.txt",
    "https://www.cvlibs.net/datasets/kitti/raw_data.php: [synced+rectified data] and [calibration] of a drive",
)
_EARTH = 6378137.0  # m, the radius that the set's authors take
_OXTS = 30  # numbers of a line: latitude, longitude, altitude, roll, pitch, yaw, ...


@dataset
@dataclass(kw_only=True, eq=False)
class KittiRaw(ImageSequence):
    """One camera of a drive; true poses are those of its GPS and inertial unit, moved to the camera.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    camera: int | None = None  # 0, 1: gray, left and right; 2, 3: color; null: 2, or 0 where there is no image_02

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any((path / f"image_0{i}" / "data").is_dir() for i in range(4))

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        camera = (2 if (folder / "image_02").is_dir() else 0) if self.camera is None else self.camera
        source = LAYOUT.folder(folder / f"image_0{camera}")
        images = numbered_images(source / "data")
        if not images:
            raise LAYOUT.missing(f"{source / 'data'} has no 0000000000.png, 0000000001.png, ...")
        calibration = LAYOUT.file(_calibration(folder, "calib_cam_to_cam.txt"))
        published, cam0_from_cam = read_projection(calibration, f"P_rect_0{camera}", images)
        _check_rectified(calibration, camera, source, published.size)
        lens = self._lens(images, published)
        times = _times(LAYOUT.file(source / "timestamps.txt"), last=int(images[-1].stem))
        poses = self._poses(folder, images, cam0_from_cam)
        return Found([Record(times[int(p.stem)], p, lens, pose) for p, pose in zip(images, poses)])

    def _poses(self, folder: Path, images: list[Path], cam0_from_cam: np.ndarray) -> list[np.ndarray | None]:
        """world_from_cam (4, 4) of each image, from the origin of the first one's, None where it is not known."""
        needed = [_calibration(folder, f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")]
        measured = [folder / "oxts" / "data" / f"{image.stem}.txt" for image in images]
        lacking = [path for path in needed if not path.is_file()] or [p for p in measured[:1] if not p.parent.is_dir()]
        if lacking:
            self.warnings.append(f"{lacking[0]} is missing: the trajectory is not scored")
            return [None] * len(images)
        rectified = np.eye(4)
        with reading(needed[2], "must hold a line `R_rect_00: ` and 9 numbers, a rotation"):
            rectified[:3, :3] = named_numbers(needed[2], "R_rect_00", 9).reshape(3, 3)
            rectified = rigid(rectified, "R_rect_00")
        cam0_from_imu = rectified @ _transform(needed[1]) @ _transform(needed[0])
        imu_from_cam = np.linalg.inv(cam0_from_imu) @ cam0_from_cam
        known = [_oxts(path) if path.is_file() else None for path in measured]
        missing = sum(place is None for place in known)
        if missing:
            self.warnings.append(f"{missing} of {len(images)} images have no true pose")
        first = next((place for place in known if place is not None), None)
        return [None if place is None or first is None else _pose(place, first) @ imu_from_cam for place in known]


def _calibration(folder: Path, name: str) -> Path:
    """Of a drive: it lies with the day's, or was copied into the drive's own folder."""
    own = folder / name
    return own if own.is_file() else folder.resolve().parent / name


def _check_rectified(calibration: Path, camera: int, source: Path, size: tuple[int, int]) -> None:
    """Raises ValueError for images of another (height, width) than those that the calibration was rectified to, where
    it says that one."""
    name = f"S_rect_0{camera}"
    with reading(calibration, f"must hold a line `{name}: ` and 2 numbers, width and height"):
        try:
            width, height = (int(v) for v in named_numbers(calibration, name, 2))
        except KeyError:
            return
    if size != (height, width):
        raise ValueError(
            f"{source} has images of {size[1]}x{size[0]}, and {calibration.name} is for rectified ones of "
            f"{width}x{height}: take the drive's [synced+rectified data], not [unsynced+unrectified data], nor scale it"
        )


def _times(path: Path, last: int) -> list[float]:
    """Seconds of the clock at which the frames from 0 on were taken, at least to the `last`. Raises BadFileError."""
    with reading(path, "must hold a time such as `2011-09-26 13:02:25.594360375` a line"):
        lines = path.read_text(encoding="utf-8-sig").split("\n")
        times = [datetime.fromisoformat(line[:26]).replace(tzinfo=UTC).timestamp() for line in lines if line.strip()]
    if np.any(np.diff(times) < 0):
        raise BadFileError(f"{path} must hold times that grow")
    if len(times) <= last:
        raise BadFileError(f"{path} has {len(times)} times, none of image {last}")
    return times


def _transform(path: Path) -> np.ndarray:
    """The (4, 4) that a file of R and T describes. Raises BadFileError."""
    with reading(path, "must hold `R: ` and 9 numbers, `T: ` and 3"):
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = named_numbers(path, "R", 9).reshape(3, 3), named_numbers(path, "T", 3)
        return rigid(transform, "R, T")


def _oxts(path: Path) -> np.ndarray:
    """Latitude, longitude (degrees), altitude (m), roll, pitch and yaw (radians) of one frame. Raises BadFileError."""
    values = read_numbers(path)
    if len(values) != _OXTS or not np.all(np.isfinite(values[:6])) or abs(values[0]) >= 90:
        raise BadFileError(f"{path} must hold {_OXTS} numbers: latitude, longitude, altitude, roll, pitch, yaw, ...")
    return values[:6]


def _pose(oxts: np.ndarray, first: np.ndarray) -> np.ndarray:
    """world_from_imu (4, 4): east, north, up by Mercator's projection at the latitude of the first, from its place."""
    roll, pitch, yaw = (so3_exp(angle * axis) for angle, axis in zip(oxts[3:], np.eye(3)))
    pose = np.eye(4)
    pose[:3, :3] = yaw @ pitch @ roll
    pose[:3, 3] = _mercator(oxts, first) - _mercator(first, first)
    return pose


def _mercator(oxts: np.ndarray, first: np.ndarray) -> np.ndarray:
    scale = np.cos(np.radians(first[0])) * _EARTH
    north = np.log(np.tan(np.radians(90.0 + oxts[0]) / 2.0))
    return np.array([scale * np.radians(oxts[1]), scale * north, oxts[2]])
