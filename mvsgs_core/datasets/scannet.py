"""ScanNet (Dai et al., "ScanNet: Richly-annotated 3D Reconstructions of Indoor Scenes", CVPR 2017), as exported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import image_size, lens_of_matrix, size_doubt
from mvsgs_core.datasets.files import Layout, numbered_images, read_numbers
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import read_pose
from mvsgs_core.datasets.registration import register
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record

LAYOUT = Layout(
    "ScanNet (exported)",
    "a folder such as scene0000_00 with color/0.jpg, 1.jpg, ..., intrinsic/intrinsic_color.txt (4x4) and, if known, "
    "pose/0.txt (4x4 camera to world), depth/0.png (millimeters) with intrinsic/intrinsic_depth.txt",
    "http://www.scan-net.org; SensReader (https://github.com/ScanNet/ScanNet) exports all that from a .sens file",
)
_FRAME_RATE = 30.0  # the export has no timestamps
_DEPTH = DepthFormat(per_unit=1000.0, invalid=(0, 65535))


@dataset
@dataclass(kw_only=True, eq=False)
class ScanNet(ImageSequence):
    """A scan. Depth maps are the depth camera's, moved to the color camera's intrinsics at their own size.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    @staticmethod
    def recognizes(path: Path) -> bool:
        return (path / "intrinsic" / "intrinsic_color.txt").is_file() and (path / "color").is_dir()

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        images = numbered_images(folder / "color")
        if not images:
            raise LAYOUT.missing(f"{folder / 'color'} has no 0.jpg, 1.jpg, ...")
        if self.intrinsics is None:
            path = LAYOUT.file(folder / "intrinsic" / "intrinsic_color.txt")
            otherwise = "export them as they are, or set dataset.intrinsics=[fx,fy,cx,cy] in pixels of the images"
            camera = _read_camera(path, image_size(images), otherwise)
        else:
            camera = self._given_lens(images, self.intrinsics)
        self._color_camera = camera
        depths = [folder / "depth" / f"{p.stem}.png" for p in images]
        there = [p for p in depths if p.is_file()]
        self._depth_camera = self._find_depth_camera(folder, there)
        poses = [read_pose(folder / "pose" / f"{p.stem}.txt") for p in images]
        missing = sum(pose is None for pose in poses)
        if missing == len(images):
            self.warnings.append(f"{folder / 'pose'} has no pose of an image: the trajectory is not scored")
        elif missing:
            self.warnings.append(f"{missing} of {len(images)} images have no true pose")
        records = [
            Record(int(image.stem) / _FRAME_RATE, image, camera, pose, depth)
            for image, pose, depth in zip(images, poses, depths)
        ]
        return Found(records, _DEPTH if there else None)

    def _find_depth_camera(self, folder: Path, depths: list[Path]) -> Lens | None:
        path = folder / "intrinsic" / "intrinsic_depth.txt"
        if not depths:
            return None
        if path.is_file():
            return _read_camera(path, image_size(depths), "export depth maps as they are, or leave them out")
        self.warnings.append(f"{path} is missing: depth maps are taken to be the color camera's")
        return None

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        if self._depth_camera is None:
            return depth
        size = depth.shape[0], depth.shape[1]
        return register(depth, self._depth_camera.at(size), self._color_camera.at(size), 0.0)


def _read_camera(path: Path, size: tuple[int, int], otherwise: str) -> Lens:
    """Of a 4x4 or 3x3 matrix, for images (height, width). Raises BadFileError, which says `otherwise` where those were
    scaled: the file has no size of its own."""
    k = read_numbers(path)
    if k.size not in (9, 16):
        raise BadFileError(f"{path} must hold a 4x4 camera matrix, it has {k.size} numbers")
    with reading(path, "holds a camera that cannot be"):
        lens = lens_of_matrix(k, size)
    if doubt := size_doubt(lens):
        raise BadFileError(f"{path}: {doubt[0]}; {otherwise}")
    return lens
