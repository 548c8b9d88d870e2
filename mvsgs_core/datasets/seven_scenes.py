"""7-Scenes (Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images", 2013)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvsgs_core.datasets.calibration import lens_for_images
from mvsgs_core.datasets.files import Layout, natural_order
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import DepthFormat, ImageSequence, Record, Size

LAYOUT = Layout(
    "7-Scenes",
    "a folder with seq-01, seq-02, ... (or one of those), in it frame-000000.color.png (or jpg), frame-000000.pose.txt "
    "(4x4 camera to world) and frame-000000.depth.png (millimeters, 65535 = none)",
    "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/, for example redkitchen.zip, with the "
    "seq-01.zip in it unpacked too",
)
_PUBLISHED = Lens((585.0, 585.0, 320.0, 240.0), (480, 640))
_FRAME_RATE = 30.0  # the set has no timestamps
_DEPTH = DepthFormat(per_unit=1000.0, invalid=(0, 65535))


class SevenScenes(ImageSequence):
    """A sequence of 7-Scenes. Color and depth are not exactly registered in this set, so depth scores have a floor.

    sequence: name of the seq-XX folder in `path`; null takes `path` itself or the first one in it.
    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Size = None,
        intrinsics: Sequence[float] | str | None = None,
        distortion: Sequence[float] = (),
        sequence: str | None = None,
    ) -> None:
        folder = _sequence_folder(LAYOUT.folder(path), sequence)
        images = sorted(folder.glob("frame-*.color.*"), key=lambda p: natural_order(p.name))
        if not images:
            raise LAYOUT.missing(f"{folder} has no frame-*.color.png")
        lens, notes = _find_lens(folder, images, intrinsics, distortion)
        records = []
        bad_poses = []
        for image in images:
            stem = image.name.split(".")[0]
            pose = _read_pose(folder / f"{stem}.pose.txt")
            if pose is None:
                bad_poses.append(stem)
            number = int(re.sub(r"\D", "", stem))
            records.append(Record(number / _FRAME_RATE, image, lens, pose, folder / f"{stem}.depth.png"))
        super().__init__(records, start=start, stop=stop, stride=stride, size=size, depth_format=_DEPTH)
        self.warnings += notes
        if bad_poses:
            self.warnings.append(f"{len(bad_poses)} of {len(images)} frames have no true pose (first: {bad_poses[0]})")


def _sequence_folder(folder: Path, sequence: str | None) -> Path:
    if sequence is not None:
        return LAYOUT.folder(folder / sequence)
    if any(folder.glob("frame-*.color.*")):
        return folder
    parts = sorted((p for p in folder.glob("seq-*") if p.is_dir()), key=lambda p: natural_order(p.name))
    if not parts:
        raise LAYOUT.missing(f"{folder} has neither frame-*.color.png nor a folder seq-01")
    return parts[0]


def _find_lens(
    folder: Path, images: list[Path], intrinsics: Sequence[float] | str | None, distortion: Sequence[float]
) -> tuple[Lens, list[str]]:
    if intrinsics is not None:
        return lens_for_images(intrinsics, distortion, images)
    for path in (folder / "camera-intrinsics.txt", folder.parent / "camera-intrinsics.txt"):
        if path.is_file():
            k = np.array([float(v) for v in path.read_text().split()])
            if k.shape != (9,):
                raise ValueError(f"{path} must hold a 3x3 camera matrix, it has {k.size} numbers")
            fx, _, cx, _, fy, cy = (float(v) for v in k[:6])
            return Lens((fx, fy, cx, cy), _PUBLISHED.size), []
    return _PUBLISHED, []


def _read_pose(path: Path) -> np.ndarray | None:
    """(4, 4) float64, None where the file is missing, empty or marks a lost frame (the set writes NaN or infinity)."""
    try:
        pose = np.array([float(v) for v in path.read_text().split()])
    except (OSError, ValueError):
        return None
    if pose.shape != (16,) or not np.all(np.isfinite(pose)):
        return None
    return pose.reshape(4, 4)
