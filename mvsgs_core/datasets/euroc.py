"""EuRoC MAV (Burri et al., IJRR 2016), TUM VI (Schubert et al., IROS 2018) and other sets in ASL's layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.by_time import poses_at
from mvsgs_core.datasets.files import Layout, inside
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import rigid
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from mvsgs_core.geometry import inverse, rotation_from_quaternion
from mvsgs_core.trajectory_file import LATEST

LAYOUT = Layout(
    "EuRoC MAV (ASL's layout)",
    "a folder with mav0/cam0/data.csv (lines `nanoseconds,file`), mav0/cam0/data/, mav0/cam0/sensor.yaml (or TUM VI's "
    "dso/camchain.yaml) and, if known, mav0/state_groundtruth_estimate0/data.csv or mav0/mocap0/data.csv (lines "
    "`nanoseconds,x,y,z,qw,qx,qy,qz`, body to world)",
    "https://projects.asl.ethz.ch/datasets/euroc-mav, for example V1_01_easy.zip, or "
    "https://cvg.cit.tum.de/data/datasets/visual-inertial-dataset, for example dataset-room1_512_16.tar, unpacked",
)
_TRUTH = ("state_groundtruth_estimate0", "mocap0")  # EuRoC's, TUM VI's
_NANOSECOND = 1e-9
_MODELS = {"radial-tangential": False, "radtan": False, "equidistant": True}  # whether it is OpenCV's fisheye model


@dataclass(frozen=True)
class Mounted:
    """A camera and where it is on the body that the true poses are of."""

    lens: Lens
    body_from_cam: np.ndarray  # (4, 4) float64


@dataset
@dataclass(kw_only=True, eq=False)
class Euroc(ImageSequence):
    """One camera of a sequence; its true poses are the body's, moved to the camera.

    Between two poses that are near enough it is interpolated, else the nearest one counts.
    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    camera: int = 0  # which: 0 is cam0, the left one
    max_difference: float = 0.02  # seconds between an image and its pose

    @staticmethod
    def recognizes(path: Path) -> bool:
        return any((path / name / "cam0" / "data.csv").is_file() for name in ("mav0", "."))

    def _find(self) -> Found:
        folder = LAYOUT.folder(self.path)
        body = folder / "mav0" if (folder / "mav0").is_dir() else folder
        images = _read_list(LAYOUT.file(body / f"cam{self.camera}" / "data.csv"))
        if not images:
            raise LAYOUT.missing(f"{body / f'cam{self.camera}' / 'data.csv'} lists no image")
        given = None
        if self.intrinsics is not None:
            given = self._given_lens([image for _, image in images], self.intrinsics)
        mounted = _mounted(body, self.camera, given)
        lens = given if mounted is None else mounted.lens
        if lens is None:
            raise LAYOUT.missing(
                f"{body / f'cam{self.camera}' / 'sensor.yaml'} is missing: copy it, or set dataset.intrinsics and "
                "dataset.distortion"
            )
        poses = self._poses(body, np.array([time for time, _ in images]), mounted)
        return Found([Record(time, image, lens, poses.get(i)) for i, (time, image) in enumerate(images)])

    def _poses(self, body: Path, times: np.ndarray, mounted: Mounted | None) -> dict[int, np.ndarray]:
        file = next((body / name / "data.csv" for name in _TRUTH if (body / name / "data.csv").is_file()), None)
        if file is None:
            self.warnings.append(f"{body} has no {' or '.join(_TRUTH)}: the trajectory is not scored")
            return {}
        if mounted is None:
            self.warnings.append("where the camera is on the body is not known: the trajectory is not scored")
            return {}
        known, world_from_body = _read_poses(file)
        if len(known) == 0:
            self.warnings.append(f"{file} is empty: the trajectory is not scored")
            return {}
        poses, notes = poses_at(times, known, world_from_body, self.max_difference)
        self.warnings += notes
        return {i: pose @ mounted.body_from_cam for i, pose in poses.items()}


def _rows(path: Path) -> list[tuple[float, list[str]]]:
    """Time in seconds and the other columns of each line. Raises BadFileError."""
    rows = []
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        time, *others = (part.strip() for part in line.split(","))
        if not time or time.startswith("#"):
            continue
        with reading(path, f"has a line that is not `nanoseconds,...`, {line[:200]!r}"):
            seconds = int(time) * _NANOSECOND
            if not abs(seconds) < LATEST:
                raise ValueError(f"{seconds} s is no time")
        rows.append((seconds, others))
    return sorted(rows, key=lambda row: row[0])


def _read_list(path: Path) -> list[tuple[float, Path]]:
    """Times and files, sorted by time. Raises BadFileError."""
    found = []
    for time, others in _rows(path):
        with reading(path, "has a line that is not `nanoseconds,file`"):
            found.append((time, inside(path.parent, f"data/{others[0]}", path)))
    return found


def _read_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,), sorted, and world_from_body (N, 4, 4). Rows that are no pose are left out. Raises BadFileError."""
    times, values = [], []
    for time, others in _rows(path):
        with reading(path, "has a line that is not `nanoseconds,x,y,z,qw,qx,qy,qz`"):
            row = [float(v) for v in others[:7]]
            if len(row) != 7:
                raise ValueError(f"{1 + len(others)} columns")
        if np.all(np.abs(row) < LATEST) and np.linalg.norm(row[3:]) > 0.5:
            times.append(time)
            values.append(row)
    rows = np.array(values, dtype=np.float64).reshape(-1, 7)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = rotation_from_quaternion(rows[:, 3:])
        poses[:, :3, 3] = rows[:, :3]
    return np.array(times, dtype=np.float64), poses


def _mounted(body: Path, camera: int, given: Lens | None) -> Mounted | None:
    """As sensor.yaml or camchain.yaml has it, with the lens that was given instead of theirs, which then is not read;
    None where there is neither file. Raises BadFileError."""
    name = f"cam{camera}"
    kalibr = body.resolve().parent / "dso" / "camchain.yaml"
    for path, read in ((body / name / "sensor.yaml", _sensor), (kalibr, _chained)):
        if path.is_file():
            with reading(path, "is no calibration that can be used"):
                lines = path.read_text(encoding="utf-8-sig").splitlines()
                text = "\n".join(line for line in lines if not line.startswith("%"))  # OpenCV's header is no YAML
                content = OmegaConf.to_container(OmegaConf.create(text))
                return read(content, name, given)
    return None


def _sensor(content: Any, name: str, given: Lens | None) -> Mounted:
    lens = given or _lens(content, content.get("distortion_coefficients", ()))
    pose = np.array([float(v) for v in content["T_BS"]["data"]]).reshape(4, 4)
    return Mounted(lens, rigid(pose, "T_BS"))


def _chained(content: Any, name: str, given: Lens | None) -> Mounted:
    """Kalibr's."""
    camera = content[name]
    lens = given or _lens(camera, camera["distortion_coeffs"])
    return Mounted(lens, inverse(rigid(np.array(camera["T_cam_imu"], dtype=np.float64), "T_cam_imu")))


def _lens(camera: Mapping[str, Any], coefficients: Any) -> Lens:
    model, distortion = camera["camera_model"], camera["distortion_model"]
    if model != "pinhole" or distortion not in (*_MODELS, "none"):
        raise ValueError(
            f"a {model} camera with {distortion} distortion is not read: set dataset.intrinsics and dataset.distortion"
        )
    fx, fy, cx, cy = (float(v) for v in camera["intrinsics"])
    size = int(camera["resolution"][1]), int(camera["resolution"][0])
    bends = () if distortion == "none" else tuple(float(v) for v in coefficients)
    return Lens((fx, fy, cx, cy), size, bends, fisheye=_MODELS.get(distortion, False))
