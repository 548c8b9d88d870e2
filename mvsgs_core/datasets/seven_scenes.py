"""7-Scenes (Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images", 2013)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.files import Layout, natural_order, read_numbers
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import read_pose
from mvsgs_core.datasets.registration import register
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record

LAYOUT = Layout(
    "7-Scenes",
    "a folder with seq-01, seq-02, ... (or one of those), in it frame-000000.color.png (or jpg), frame-000000.pose.txt "
    "(4x4 camera to world) and frame-000000.depth.png (millimeters, 65535 = none)",
    "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/, for example redkitchen.zip, with the "
    "seq-01.zip in it unpacked too",
)
_DEPTH_CAMERA = Lens((585.0, 585.0, 320.0, 240.0), (480, 640))  # published, and what the poses are poses of
# The set publishes no color camera and its depth is not registered to color. 525 is what the camera's maker gives;
# on RedKitchen it is within 1% of the focal length of least epipolar error (585 has a 1.6 times larger median), and
# depth edges lie on image edges for a color camera this far to the right of the depth camera (maker: 0.025).
# Depth points put into other images by the true poses, fitted together with principal point, camera to camera pose,
# distortion, shutter, and focal length or scale of depth, end at 524 to 532 from 525; from 540 and 585 at 536 and 573,
# still on the way down, at a larger cost. A tracker's path lies closer to the true one with 585: that is not explained.
_COLOR_CAMERA = Lens((525.0, 525.0, 320.0, 240.0), (480, 640))
_BASELINE = 0.021  # meters
_FRAME_RATE = 30.0  # the set has no timestamps
_DEPTH = DepthFormat(per_unit=1000.0, invalid=(0, 65535))


@dataset
@dataclass(kw_only=True, eq=False)
class SevenScenes(ImageSequence):
    """A sequence of 7-Scenes; `intrinsics` replaces the color camera's.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    sequence: str | None = None  # seq-01, seq-02, ... in `path`; null: `path` itself or the first one in it
    # color has a camera of its own, depth and poses are moved to it; false: the published camera of the depth sensor
    # (585 pixels) for both, as many published results have it
    registered: bool = True

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any(next(path.glob(pattern), None) for pattern in ("frame-*.color.*", "seq-*/frame-*.color.*"))

    def _find(self) -> Found:
        folder = _sequence_folder(LAYOUT.folder(self.path), self.sequence)
        images = [p for p in folder.glob("frame-*.color.*") if re.search(r"[0-9]", p.name.split(".")[0])]
        images.sort(key=lambda p: natural_order(p.name))
        if not images:
            raise LAYOUT.missing(f"{folder} has no frame-*.color.png")
        self._depth_camera = _find_depth_camera(folder)
        color = self._lens(images, _COLOR_CAMERA if self.registered else self._depth_camera)
        self._color_camera = color
        records = []
        without_pose = []
        for image in images:
            stem = image.name.split(".")[0]
            pose = read_pose(folder / f"{stem}.pose.txt")
            if pose is None:
                without_pose.append(stem)
            elif self.registered:
                pose[:3, 3] += pose[:3, 0] * _BASELINE
            number = int(re.sub(r"[^0-9]", "", stem))
            records.append(Record(number / _FRAME_RATE, image, color, pose, folder / f"{stem}.depth.png"))
        if without_pose:
            text = f"{len(without_pose)} of {len(images)} frames have no true pose (first: {without_pose[0]})"
            self.warnings.append(text)
        return Found(records, _DEPTH)

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        if not self.registered:
            return depth
        size = depth.shape[0], depth.shape[1]
        return register(depth, self._depth_camera.at(size), self._color_camera.at(size), _BASELINE)


def _sequence_folder(folder: Path, sequence: str | None) -> Path:
    if sequence is not None:
        return LAYOUT.folder(folder / sequence)
    if any(folder.glob("frame-*.color.*")):
        return folder
    parts = sorted((p for p in folder.glob("seq-*") if p.is_dir()), key=lambda p: natural_order(p.name))
    if not parts:
        raise LAYOUT.missing(f"{folder} has neither frame-*.color.png nor a folder seq-01")
    return parts[0]


def _find_depth_camera(folder: Path) -> Lens:
    for path in (folder / "camera-intrinsics.txt", folder.parent / "camera-intrinsics.txt"):
        if path.is_file():
            k = read_numbers(path)
            if k.shape != (9,):
                raise BadFileError(f"{path} must hold a 3x3 camera matrix, it has {k.size} numbers")
            fx, _, cx, _, fy, cy = (float(v) for v in k[:6])
            with reading(path, "holds a camera that cannot be"):
                return Lens((fx, fy, cx, cy), _DEPTH_CAMERA.size)
    return _DEPTH_CAMERA
