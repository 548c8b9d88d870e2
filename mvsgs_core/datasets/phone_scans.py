"""What scanning apps export beside their photographs: Polycam's raw data and Record3D's, both with ARKit's poses.

ARKit has OpenGL's camera axes, and counts pixels from the corner of the first one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets.files import images_in, visible
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import Model, Shot, rigid
from mvsgs_core.geometry import OPENGL_FROM_OPENCV, rotation_from_quaternion

# images and cameras below the folder; the app's own correction of the poses first
_POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
_RECORD3D = "metadata.json"


def polycam_folders(folder: Path) -> tuple[Path, Path] | None:
    """Images and cameras of Polycam's raw data, in `folder` or its `keyframes`."""
    for base in (folder / "keyframes", folder):
        for images, cameras in _POLYCAM:
            if (base / images).is_dir() and visible(base / cameras, "*.json"):
                return base / images, base / cameras
    return None


def read_polycam(cameras: Path) -> Model:
    """The model of a folder of cameras, a JSON file an image. Raises BadFileError for a malformed one."""
    shots = {}
    for path in visible(cameras, "*.json"):
        with reading(path, "is no camera of Polycam's that can be used"):
            c = json.loads(path.read_bytes())
            pose = np.eye(4)
            pose[:3] = [[float(c[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            size = int(c["height"]), int(c["width"])
            shots[path.stem] = Shot(_lens(c["fx"], c["fy"], c["cx"], c["cy"], size), _opencv(pose))
    return Model("Polycam cameras", shots)


def find_record3d(folder: Path) -> Path | None:
    """The file that describes an export of Record3D, with images in rgb/: other programs have one of its name, too."""
    path = folder / _RECORD3D
    if not (path.is_file() and (folder / "rgb").is_dir()):
        return None
    content = path.read_bytes()
    return path if b'"K"' in content and b'"poses"' in content else None


def read_record3d(path: Path) -> Model:
    """The model of an export of Record3D. Raises BadFileError for a malformed one."""
    images = images_in(path.parent / "rgb")
    shots = {}
    with reading(path, "is no description of Record3D's that can be used"):
        content = json.loads(path.read_bytes())
        size = int(content["h"]), int(content["w"])
        k = np.array(content["K"], dtype=np.float64).reshape(3, 3).T  # by columns
        common = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
        times = _times(content, len(content["poses"]))
        each = content.get("perFrameIntrinsicCoeffs") or [common] * len(content["poses"])
        if not len(images) <= len(content["poses"]) == len(each):
            raise ValueError(f"{len(images)} images, {len(content['poses'])} poses and {len(each)} cameras")
        for image in images:
            i = int(image.stem)
            qx, qy, qz, qw, *position = (float(v) for v in content["poses"][i])
            pose = np.eye(4)
            pose[:3, :3] = rotation_from_quaternion(np.array([qw, qx, qy, qz]))
            pose[:3, 3] = position
            fx, fy, cx, cy = each[i]
            shots[f"rgb/{image.name}"] = Shot(_lens(fx, fy, cx, cy, size), _opencv(pose), time=times[i])
    return Model("Record3D export", shots)


def _times(content: Mapping[str, Any], frames: int) -> Sequence[float | None]:
    """Seconds from Record3D's first frame on; None where it says neither times nor a rate. Raises ValueError."""
    stamps, rate = content.get("frameTimestamps"), content.get("fps")
    if stamps:
        seconds = np.array(stamps, dtype=np.float64)
        if seconds.shape != (frames,) or not np.all(np.isfinite(seconds)):
            raise ValueError(f"frameTimestamps must be {frames} finite numbers, of each pose one")
        return [float(v) for v in seconds - seconds[0]]
    if rate is None:
        return [None] * frames
    if not 0.0 < float(rate) < np.inf:
        raise ValueError(f"fps = {rate} is no number of images per second")
    return [i / float(rate) for i in range(frames)]


def _lens(fx: Any, fy: Any, cx: Any, cy: Any, size: tuple[int, int]) -> Lens:
    return Lens((float(fx), float(fy), float(cx) - 0.5, float(cy) - 0.5), size)


def _opencv(pose: np.ndarray) -> np.ndarray:
    return rigid(pose, "its pose") @ OPENGL_FROM_OPENCV
