"""7-Scenes (Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images", 2013), and
sets in its layout that say which cameras took them: 12-Scenes, 3RScan, BundleFusion's and 3DMatch's scenes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import image_size, lens_of_matrix
from mvsgs_core.datasets.files import Layout, natural_order, read_numbers
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import read_pose
from mvsgs_core.datasets.registration import register, size_of_depth
from mvsgs_core.datasets.sensor_info import Sensor, read_sensor_info
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record

LAYOUT = Layout(
    "7-Scenes",
    "a folder with seq-01, seq-02, ... (or one of those), in it frame-000000.color.png (or jpg), frame-000000.pose.txt "
    "(4x4 camera to world) and frame-000000.depth.png (or pgm; millimeters, 65535 = none); of another camera than "
    "Kinect's with its _info.txt, info.txt or camera-intrinsics.txt, such as 12-Scenes and 3RScan",
    "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/, for example redkitchen.zip, with the "
    "seq-01.zip in it unpacked too",
)
_FOLDERS = ("data", "sequence")  # of the frames of 12-Scenes, of 3RScan
_FRAME = re.compile(r"frame-([0-9]+)\.color\.\w+")  # what was rendered lies beside it: frame-000000.rendered.color.jpg
_KINECT = (480, 640)
_DEPTH_CAMERA = Lens((585.0, 585.0, 320.0, 240.0), _KINECT)  # published, and what the poses are poses of
# The set publishes no color camera and its depth is not registered to color. 525 is what the camera's maker gives;
# on RedKitchen it is within 1% of the focal length of least epipolar error (585 has a 1.6 times larger median), and
# depth edges lie on image edges for a color camera this far to the right of the depth camera (maker: 0.025).
# Depth points put into other images by the true poses, fitted together with principal point, camera to camera pose,
# distortion, shutter, and focal length or scale of depth, end at 524 to 532 from 525; from 540 and 585 at 536 and 573,
# still on the way down, at a larger cost. A tracker's path lies closer to the true one with 585: that is not explained.
_COLOR_CAMERA = Lens((525.0, 525.0, 320.0, 240.0), _KINECT)
_BASELINE = 0.021  # meters
_FRAME_RATE = 30.0  # the set has no timestamps
_INVALID = (0, 65535)  # counts of depth


@dataset
@dataclass(kw_only=True, eq=False)
class SevenScenes(ImageSequence):
    """A sequence of 7-Scenes, or of a set in its layout; `intrinsics` replaces the color camera's.

    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    sequence: str | None = None  # seq-01, seq-02, ... in `path`; null: `path` itself or the first one in it
    # of 7-Scenes: color has a camera of its own, depth and poses are moved to it; false: the published camera of the
    # depth sensor (585 pixels) for both, as many published results have it
    registered: bool = True

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any(any(path.glob(f"{name}frame-*.color.*")) for name in ("", "seq-*/", "data/", "sequence/"))

    def _find(self) -> Found:
        folder = _sequence_folder(LAYOUT.folder(self.path), self.sequence)
        there = folder.glob("frame-*.color.*")
        numbers = {p: int(match[1]) for p in there if (match := _FRAME.fullmatch(p.name))}
        images = sorted(numbers, key=lambda p: natural_order(p.name))
        if not images:
            raise LAYOUT.missing(f"{folder} has no frame-*.color.png")
        self._sensor = self._find_sensor(folder, images)
        self._color_camera = color = self._lens(images, self._sensor.color)
        suffix = "pgm" if any(folder.glob("frame-*.depth.pgm")) else "png"
        records = []
        without_pose = []
        for image in images:
            stem = image.name.split(".")[0]
            pose = read_pose(folder / f"{stem}.pose.txt")
            if pose is None:
                without_pose.append(stem)
            else:
                pose[:3, 3] += pose[:3, 0] * self._sensor.baseline
            records.append(Record(numbers[image] / _FRAME_RATE, image, color, pose, folder / f"{stem}.depth.{suffix}"))
        if without_pose:
            text = f"{len(without_pose)} of {len(images)} frames have no true pose (first: {without_pose[0]})"
            self.warnings.append(text)
        return Found(records, DepthFormat(self._sensor.per_meter, _INVALID))

    def _find_sensor(self, folder: Path, images: list[Path]) -> Sensor:
        """As the files beside the frames say, else Kinect. Raises ValueError for images that are not Kinect's."""
        described = read_sensor_info(folder)
        if described is not None:
            return described
        height, width = size = image_size(images)
        depth = _find_camera(folder, size) or _DEPTH_CAMERA
        if not _is_kinects(depth):  # sets that give one camera alone have depth registered to color
            return Sensor(depth)
        if width <= _KINECT[1] and same_shape(size, _KINECT):
            return Sensor(_COLOR_CAMERA, depth, baseline=_BASELINE) if self.registered else Sensor(depth)
        if self.intrinsics is not None:
            return Sensor(_COLOR_CAMERA)
        raise ValueError(
            f"{folder} has images of {width}x{height}, and those of 7-Scenes are 640x480: of another set the file that "
            "says its camera is needed beside them, _info.txt (3RScan), info.txt (12-Scenes) or camera-intrinsics.txt "
            "(3DMatch), or dataset.intrinsics=[fx,fy,cx,cy]"
        )

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        if self._sensor.depth is None:
            return depth
        size = depth.shape[0], depth.shape[1]
        target = self._color_camera.at(size_of_depth(self._color_camera.size, size))
        return register(depth, self._sensor.depth.at(size), target, self._sensor.baseline)


def _sequence_folder(folder: Path, sequence: str | None) -> Path:
    if sequence is not None:
        return LAYOUT.folder(folder / sequence)
    for place in (folder, *(folder / name for name in _FOLDERS)):
        if any(place.glob("frame-*.color.*")):
            return place
    parts = sorted((p for p in folder.glob("seq-*") if p.is_dir()), key=lambda p: natural_order(p.name))
    if not parts:
        raise LAYOUT.missing(f"{folder} has neither frame-*.color.png nor a folder seq-01")
    return parts[0]


def _find_camera(folder: Path, size: tuple[int, int]) -> Lens | None:
    """Of camera-intrinsics.txt, for images (height, width) or, where it has their middle, Kinect's size; None where
    there is none. Raises BadFileError."""
    for path in (base / "camera-intrinsics.txt" for base in (folder, folder.resolve().parent)):
        if path.is_file():
            k = read_numbers(path)
            if k.shape != (9,):
                raise BadFileError(f"{path} must hold a 3x3 camera matrix, it has {k.size} numbers")
            with reading(path, "holds a camera that cannot be"):
                return lens_of_matrix(k, min((size, _KINECT), key=lambda s: float(abs(2 * k[2] - s[1]))))
    return None


def _is_kinects(camera: Lens) -> bool:
    return all(abs(f - published) < 1.0 for f, published in zip(camera.intrinsics[:2], _DEPTH_CAMERA.intrinsics[:2]))
