"""_info.txt beside a sensor's frames, as BundleFusion's tools write it: 12-Scenes, 3RScan, ScanNet's SensReader."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets.calibration import lens_of_matrix
from mvsgs_core.datasets.lens import Lens

_NAMES = ("_info.txt", "info.txt")
_COLOR = "m_calibrationColorIntrinsic"


@dataclass(frozen=True)
class Sensor:
    """A color and a depth camera."""

    color: Lens
    depth: Lens | None = None  # of the depth maps; None: they are the color camera's
    per_meter: float = 1000.0  # counts of depth
    baseline: float = 0.0  # meters that the color camera stands to the right of what depth maps and poses are of


def read_sensor_info(folder: Path) -> Sensor | None:
    """As the file says that is in a folder of frames or the one above; None where there is none. Raises BadFileError.

    Extrinsics are not read: the sets have the identity there.
    """
    for path in (base / name for base in (folder, folder.resolve().parent) for name in _NAMES):
        if path.is_file():
            with reading(path, f"must hold lines such as `m_colorWidth = 640` and `{_COLOR} = ` with 16 numbers"):
                lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
                entries = {key.strip(): value.split() for key, _, value in (line.partition("=") for line in lines)}
                if _COLOR in entries:  # else a note of another kind
                    return _sensor(entries)
    return None


def _sensor(entries: Mapping[str, list[str]]) -> Sensor:
    per_meter = float(entries["m_depthShift"][0])
    if not 0.0 < per_meter < np.inf:
        raise ValueError(f"m_depthShift = {per_meter} counts of depth are no meter")
    return Sensor(_lens(entries, "color"), _lens(entries, "depth"), per_meter)


def _lens(entries: Mapping[str, list[str]], camera: str) -> Lens:
    height, width = (int(entries[f"m_{camera}{side}"][0]) for side in ("Height", "Width"))
    matrix = np.array([float(v) for v in entries[f"m_calibration{camera.title()}Intrinsic"]])
    return lens_of_matrix(matrix, (height, width))
