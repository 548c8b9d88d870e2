"""TUM RGB-D (Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", 2012) and sets in its layout."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.by_time import nearest, poses_at
from mvsgs_core.datasets.calibration import lens_for_images
from mvsgs_core.datasets.files import Layout, inside
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import DepthFormat, Found, ImageSequence, Record
from mvsgs_core.geometry import nearest_rotation, rigid
from mvsgs_core.trajectory_file import LATEST, read_trajectory

LAYOUT = Layout(
    "TUM RGB-D",
    "a folder with rgb.txt and rgb/ (lines `timestamp file`) and, if known, depth.txt, depth/ (16-bit PNG, 5000 = 1 m) "
    "and groundtruth.txt (lines `timestamp tx ty tz qx qy qz qw`, camera to world)",
    "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/download, for example rgbd_dataset_freiburg1_xyz.tgz, unpacked",
)

# Published calibrations of the color cameras, 640x480 (facts of the data sets' own pages).
CAMERAS = {
    "freiburg1": Lens((517.3, 516.5, 318.6, 255.3), (480, 640), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": Lens((520.9, 521.0, 325.1, 249.7), (480, 640), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": Lens((535.4, 539.2, 320.1, 247.6), (480, 640)),
    "bonn": Lens(
        (542.822841, 542.57687, 315.59352, 237.756098), (480, 640), (0.039903, -0.099343, -0.00073, -0.000144)
    ),
}
# Bonn RGB-D Dynamic (Palazzolo et al., IROS 2019) gives poses of the markers on its camera, in axes of ROS; both as
# published, where the rotation between the two is scaled by 1.06.
_BONN, _BONN_FOLDER = "bonn", "rgbd_bonn"
_AXES = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # its own inverse
_MARKERS_FROM_CAM = rigid(
    nearest_rotation(np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])),
    np.array([0.0113, -0.0098, 0.0111]),
)
# `fx fy cx cy [distortion]` in one line, in pixels of the images: our own addition, and ETH3D's
CALIBRATION_FILE, _ETH3D = "camera.txt", "calibration.txt"
_DEPTH = DepthFormat(per_unit=5000.0)


@dataset
@dataclass(kw_only=True, eq=False)
class Tum(ImageSequence):
    """A folder in TUM RGB-D layout, undistorted.

    intrinsics, distortion: of another camera than these. Between two poses that are near enough it is interpolated,
    else the nearest one counts; a depth map goes to the one image nearest to it. size=[384, 512] with crop=8 is the
    usual protocol.
    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    # freiburg1, freiburg2, freiburg3, bonn; null: from camera.txt, calibration.txt, the folder's name or the head of
    # groundtruth.txt
    camera: str | None = None
    max_difference: float = 0.02  # seconds between an image and its pose or depth map

    @staticmethod
    def recognizes(path: Path) -> bool:
        return (path / "rgb.txt").is_file()

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        images = _read_list(folder, LAYOUT.file(folder / "rgb.txt"))
        if not images:
            raise LAYOUT.missing(f"{folder / 'rgb.txt'} lists no image")
        times = np.array([t for t, _ in images])
        name = self.camera or _named(folder)
        lens = self._camera(folder, [image for _, image in images], name)
        depth_of = _depth_maps(folder, times, self.max_difference)
        poses, notes = _poses(folder, times, self.max_difference, of_markers=name == _BONN)
        self.warnings += notes
        records = [Record(time, image, lens, poses.get(i), depth_of.get(i)) for i, (time, image) in enumerate(images)]
        return Found(records, _DEPTH if depth_of else None)

    def _camera(self, folder: Path, images: list[Path], name: str | None) -> Lens:
        """name: of the published one that was asked for or took the images."""
        if name is not None and name not in CAMERAS:
            raise ValueError(f"camera is one of {', '.join(CAMERAS)}, got {name!r}")
        files = (folder / CALIBRATION_FILE, folder / _ETH3D)
        calibration = next((file for file in files if file.is_file()), None)
        if self.intrinsics is not None:
            return self._given_lens(images, self.intrinsics)
        if self.camera is None and calibration is not None:
            with reading(calibration, "must hold `fx fy cx cy` and perhaps the distortion"):
                lines = calibration.read_text(encoding="utf-8-sig").splitlines()
                values = [float(v) for line in lines for v in line.partition("#")[0].split()]
                lens, notices = lens_for_images(values[:4], values[4:], images)
            self.warnings += notices
            return lens
        if name is not None:
            return CAMERAS[name]
        raise ValueError(
            f"the name of {folder} does not tell which camera took it: set dataset.options.camera to one of "
            f"{', '.join(CAMERAS)}, or dataset.intrinsics=[fx,fy,cx,cy] (and dataset.distortion), "
            f"or write them into {folder / CALIBRATION_FILE}"
        )


def _read_list(folder: Path, path: Path) -> list[tuple[float, Path]]:
    """Times and files of the lines of `path`, by time, where that is equal as they come.

    Raises BadFileError for a line that is none.
    """
    entries = []
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        parts = line.split()
        if len(parts) >= 2 and not line.startswith("#"):
            with reading(path, f"has a line that is not `timestamp file`, {line[:200]!r}"):
                time = float(parts[0])
                if not abs(time) < LATEST:
                    raise ValueError(f"{time} s is no time")
            entries.append((time, inside(folder, parts[1], path)))
    return sorted(entries, key=lambda entry: entry[0])


def _named(folder: Path) -> str | None:
    """The camera that the folder's name or the header of its true poses names."""
    header = folder / "groundtruth.txt"
    head = header.read_text(errors="replace")[:400] if header.is_file() else ""
    for text in (folder.name, folder.resolve().name, head):
        if _BONN_FOLDER in text:
            return _BONN
        match = re.search(r"(?:freiburg|fr)([123])(?!\d)", text)
        if match:
            return f"freiburg{match[1]}"
    return None


def _depth_maps(folder: Path, times: np.ndarray, max_difference: float) -> dict[int, Path]:
    listing = folder / "depth.txt"
    if not listing.is_file():
        return {}
    entries = _read_list(folder, listing)
    depth_times = np.array([t for t, _ in entries])
    image_of = nearest(depth_times, times, np.inf)  # a depth map belongs to the image nearest to it, and to no other
    return {i: entries[j][1] for i, j in nearest(times, depth_times, max_difference).items() if image_of[j] == i}


def _poses(
    folder: Path, times: np.ndarray, max_difference: float, *, of_markers: bool
) -> tuple[dict[int, np.ndarray], list[str]]:
    """Index of an image -> world_from_cam (4, 4), and warnings. of_markers: as Bonn has them."""
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return {}, [f"{path.name} is missing: the trajectory is not scored"]
    known, true = read_trajectory(path)
    if len(known) == 0:
        return {}, [f"{path.name} is empty: the trajectory is not scored"]
    if of_markers:
        true = _AXES @ true @ _AXES @ _MARKERS_FROM_CAM
    return poses_at(times, known, true, max_difference)
