"""TartanAir (Wang et al., "TartanAir: A Dataset to Push the Limits of Visual SLAM", IROS 2020), and its version 2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import image_size
from mvsgs_core.datasets.files import (
    Layout,
    UnreadableImageError,
    images_in,
    opened_image,
    read_array,
    read_rows,
)
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record
from mvsgs_core.geometry import rotation_from_quaternion

LAYOUT = Layout(
    "TartanAir",
    "a trajectory's folder such as P001 with image_left/000000_left.png, ..., pose_left.txt (x y z qx qy qz qw a line) "
    "and, if known, depth_left/000000_left_depth.npy; of the second version image_lcam_front, pose_lcam_front.txt and "
    "depth_lcam_front",
    "https://theairlab.org/tartanair-dataset, https://tartanair.org",
)
_USUAL = ("left", "lcam_front")
_FRAME_RATE = 10.0  # the second version's; there are no timestamps
_SKY = 1000.0  # m, from which depth is that of the sphere around the scene
# north, east, down is forward, right, down of the camera, whose own axes are right, down, forward
_NED_FROM_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataset
@dataclass(kw_only=True, eq=False)
class TartanAir(ImageSequence):
    """One camera of a trajectory. Raises FileNotFoundError and ValueError, which say what was expected."""

    camera: str | None = None  # left, right, lcam_front, ...; null: left, or lcam_front where there is no image_left

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any((path / f"image_{name}").is_dir() and (path / f"pose_{name}.txt").is_file() for name in _USUAL)

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        there = next((name for name in _USUAL if (folder / f"image_{name}").is_dir()), _USUAL[0])
        camera = there if self.camera is None else self.camera
        source = LAYOUT.folder(folder / f"image_{camera}")
        images = [p for p in images_in(source) if p.stem.split("_")[0].isdecimal()]
        if not images:
            raise LAYOUT.missing(f"{source} has no 000000_{camera}.png")
        lens = self._lens(images, _published(image_size(images)))
        poses = self._poses(folder / f"pose_{camera}.txt")
        depths = {p.stem: p for p in sorted((folder / f"depth_{camera}").glob("*_depth.*"))}
        records = []
        for image in images:
            number = int(image.stem.split("_")[0])
            pose = poses[number] if number < len(poses) else None
            records.append(Record(number / _FRAME_RATE, image, lens, pose, depths.get(f"{image.stem}_depth")))
        missing = sum(record.world_from_cam is None for record in records)
        if missing and len(poses):
            self.warnings.append(f"{missing} of {len(records)} images have no true pose")
        return Found(records, DepthFormat(1.0) if depths else None)

    def _poses(self, path: Path) -> np.ndarray:
        """world_from_cam (N, 4, 4) of the frames from 0 on. Raises BadFileError."""
        if not path.is_file():
            self.warnings.append(f"{path} is missing: the trajectory is not scored")
            return np.zeros((0, 4, 4))
        lines = read_rows(path, (7,), "x y z qx qy qz qw")
        finite = np.isfinite(lines).all(axis=1)
        if not finite.all():
            raise BadFileError(f"{path}: line {int(np.argmin(finite)) + 1} has a number that is not finite")
        length = np.linalg.norm(lines[:, 3:], axis=1)
        if np.any(np.abs(length - 1.0) > 1e-2):
            raise BadFileError(f"{path}: line {int(np.argmax(np.abs(length - 1.0) > 1e-2)) + 1} has no unit quaternion")
        poses = np.tile(np.eye(4), (len(lines), 1, 1))
        for pose, line, norm in zip(poses, lines, length):
            pose[:3, :3] = rotation_from_quaternion(np.roll(line[3:], 1) / norm) @ _NED_FROM_CAM
            pose[:3, 3] = line[:3]
        return poses

    def _read_depth(self, path: Path, form: DepthFormat) -> np.ndarray:
        """Meters: an array of NumPy's, or, in the second version, a float's four bytes as blue, green, red, alpha."""
        if path.suffix == ".npy":
            depth = read_array(path)
        else:
            with opened_image(path, path.name) as opened:
                pixels = np.asarray(opened)
            if pixels.ndim != 3 or pixels.shape[2] != 4:
                raise UnreadableImageError(f"{path.name}: a depth map has four channels, this one is {pixels.shape}")
            depth = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
        return np.where((depth > 0) & (depth < _SKY), depth, 0.0).astype(np.float32)


def _published(size: tuple[int, int]) -> Lens:
    """A field of view of 90 degrees across, about the middle of the image (320 of 640 pixels from its edge)."""
    height, width = size
    return Lens((width / 2, width / 2, (width - 1) / 2, (height - 1) / 2), size)
