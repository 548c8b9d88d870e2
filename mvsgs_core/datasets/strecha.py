"""Strecha's outdoor sets (Strecha et al., "On Benchmarking Camera Calibration and Multi-View Stereo", CVPR 2008)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets.files import read_numbers, visible
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import Model, Shot, rigid

FOLDERS = ("gt_dense_cameras", ".")
_NUMBERS = 9 + 3 + 9 + 3 + 2  # K, distortion, rotation camera to world, center, width and height


def find_strecha(folder: Path) -> Path | None:
    """The folder with 0000.jpg.camera, ... files."""
    return next((folder / name for name in FOLDERS if visible(folder / name, "*.camera")), None)


def read_strecha(folder: Path) -> Model:
    """The model of a folder of .camera files. Raises BadFileError for a malformed one."""
    shots = {}
    for path in visible(folder, "*.camera"):
        values = read_numbers(path)
        with reading(path, "is no camera of Strecha's that can be used"):
            shots[path.name.removesuffix(".camera")] = _shot(values)
    return Model("Strecha cameras", shots)


def _shot(values: np.ndarray) -> Shot:
    if values.size != _NUMBERS:
        raise ValueError(f"it must hold {_NUMBERS} numbers: K, distortion, R, center, size; got {values.size}")
    k = values[:9].reshape(3, 3)
    distortion = tuple(float(v) for v in values[9:12])
    if any(distortion):
        raise ValueError(f"only undistorted images are supported, this one has distortion {distortion}")
    pose = np.eye(4)
    pose[:3, :3] = values[12:21].reshape(3, 3)
    pose[:3, 3] = values[21:24]
    size = int(values[25]), int(values[24])
    lens = Lens((float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])), size)
    return Shot(lens, rigid(pose, "its pose"))
