"""COLMAP models (Schönberger and Frahm, "Structure-from-Motion Revisited", 2016): cameras and images, text and binary.

COLMAP's pixel (0, 0) is the corner of the first pixel, ours its center: principal points move by half a pixel.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import Model, Shot, rigid
from mvsgs_core.geometry import inverse, rotation_from_quaternion

FOLDERS = (
    "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "colmap", "dense/sparse", ".",
    "dslr_calibration_undistorted",  # ETH3D's photographs
)  # fmt: skip

# name, number of parameters, in the order of COLMAP's model ids
_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4),
    ("EUCM", 6), ("EQUIRECTANGULAR", 2),
)  # fmt: skip
_PARAMETERS = dict(_MODELS)
_UNLIKE_OPENCV = (
    "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip


def find_colmap(folder: Path) -> Path | None:
    """The folder with the model below `folder`, where COLMAP users keep it."""
    return next((folder / name for name in FOLDERS if _has_model(folder / name)), None)


def models_beside(model: Path) -> list[Path]:
    """Of sparse/0: sparse/1, sparse/2, ... with the images that COLMAP could not join with its own."""
    others = model.parent.iterdir() if model.name == "0" else ()
    return sorted(other for other in others if other.name.isdecimal() and other != model and _has_model(other))


def _has_model(folder: Path) -> bool:
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def read_colmap(folder: Path) -> Model:
    """The model in `folder`, binary if both are there.

    Raises BadFileError for a damaged file, a camera or pose that cannot be, or a camera model that has no counterpart.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    cameras, images = (folder / f"{name}.{'bin' if binary else 'txt'}" for name in ("cameras", "images"))
    with reading(cameras, "of a COLMAP model is damaged or incomplete, or cannot be used"):
        lenses = _binary_cameras(cameras) if binary else _text_cameras(cameras)
    with reading(images, "of a COLMAP model is damaged or incomplete, or cannot be used"):
        shots = _binary_images(images, lenses) if binary else _text_images(images, lenses)
    if not shots:
        raise BadFileError(f"the COLMAP model in {folder} has no registered image")
    return Model("COLMAP model", shots)


def lens_of(model: str, width: int, height: int, p: Sequence[float]) -> Lens:
    """The lens of a COLMAP camera. Raises ValueError for one that is unlike OpenCV's: undistort its images."""
    if model not in _PARAMETERS or len(p) != _PARAMETERS[model]:
        raise ValueError(f"COLMAP camera model {model} with {len(p)} parameters is unknown")
    if model in _UNLIKE_OPENCV:
        raise ValueError(
            f"COLMAP camera model {model} is not supported: run `colmap image_undistorter` and use its output"
        )
    one_focal = model.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if one_focal else p[:4]
    k = tuple(p[3:]) if one_focal else tuple(p[4:])
    fisheye = model.endswith("FISHEYE")
    if k and len(k) < 4:
        k += (0.0,) * (4 - len(k))
    return Lens((fx, fy, cx - 0.5, cy - 0.5), (height, width), k, fisheye)


def _shot(lens: Lens, quaternion: Sequence[float], translation: Sequence[float]) -> Shot:
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quaternion(np.array(quaternion, dtype=np.float64))
    cam_from_world[:3, 3] = translation
    return Shot(lens, inverse(rigid(cam_from_world, "a pose")))


def _text_cameras(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        parts = line.split()
        if parts and not line.startswith("#"):
            lenses[int(parts[0])] = lens_of(parts[1], int(parts[2]), int(parts[3]), [float(v) for v in parts[4:]])
    return lenses


def _text_images(path: Path, lenses: dict[int, Lens]) -> dict[str, Shot]:
    shots = {}
    lines = iter(line for line in path.read_text(encoding="utf-8-sig").splitlines() if not line.startswith("#"))
    for line in lines:
        parts = line.split(maxsplit=9)
        if not parts:
            continue
        numbers = [float(v) for v in parts[1:8]]
        shots[parts[9].strip()] = _shot(lenses[int(parts[8])], numbers[:4], numbers[4:])
        next(lines, None)  # its points, a line that may be empty
    return shots


class _Bytes:
    """Reads a binary file front to back; struct.error where it ends early."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, format: str) -> tuple[float | int, ...]:
        values = struct.unpack_from("<" + format, self._data, self._at)
        self._at += struct.calcsize("<" + format)
        return values

    def count(self) -> int:
        return int(self.take("Q")[0])

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise struct.error("a name without an end")
        name = self._data[self._at : end].decode()
        self._at = end + 1
        return name

    def skip(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise struct.error("the file ends early")
        self._at += size


def _binary_cameras(path: Path) -> dict[int, Lens]:
    data = _Bytes(path.read_bytes())
    lenses = {}
    for _ in range(data.count()):
        camera, model, width, height = (int(v) for v in data.take("iiQQ"))
        if not 0 <= model < len(_MODELS):
            raise ValueError(f"{path}: unknown camera model {model}")
        name, parameters = _MODELS[model]
        lenses[camera] = lens_of(name, width, height, data.take(f"{parameters}d"))
    return lenses


def _binary_images(path: Path, lenses: dict[int, Lens]) -> dict[str, Shot]:
    data = _Bytes(path.read_bytes())
    shots = {}
    for _ in range(data.count()):
        values = data.take("i7di")
        shots[data.text()] = _shot(lenses[int(values[8])], values[1:5], values[5:8])
        data.skip(24 * data.count())  # its points: x, y, id
    return shots
