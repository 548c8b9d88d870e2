"""transforms.json, as NeRF, instant-ngp and nerfstudio write it: OpenGL camera axes, COLMAP's pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets.files import IMAGE_SUFFIXES, inside
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import Model, Shot, rigid
from mvsgs_core.geometry import OPENGL_FROM_OPENCV

_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_PINHOLES = (None, "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # with no distortion or OpenCV's
NAMES = ("transforms.json", "transforms_train.json")


def find_transforms(folder: Path, part: str = "") -> Path | None:
    """part: the folder of the images in it, such as the test/ of NeRF's own sets, which have a file of each part."""
    names = (f"transforms_{part}.json", *NAMES)
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_transforms(path: Path, image_size: tuple[int, int], masks: Path | None = None) -> Model:
    """The model of a transforms.json, with the images that it keeps for tests.

    image_size (height, width) on disk, not turned by EXIF, where the file does not say it; masks: folder that names of
    masks start at, where it is not the file's; one that is not there has none.
    Raises BadFileError for a malformed file, a camera or pose in it that cannot be, or a camera model that has no
    counterpart.
    """
    shots = {}
    with reading(path, "is no transforms.json that can be used"):
        content = json.loads(path.read_bytes())
        for frame in [*content["frames"], *content.get("test_frames", [])]:
            name = frame["file_path"]
            with reading(f"frame {name!r}", "cannot be"):
                pose = rigid(np.array(frame["transform_matrix"], dtype=np.float64), "transform_matrix")
                lens, mask = _lens({**content, **frame}, image_size), frame.get("mask_path", content.get("mask_path"))
                there = mask is not None and (masks is None or masks.is_dir())
                masked = inside(masks or path.parent, mask, path) if there else None
                shots[_relative(name)] = Shot(lens, pose @ OPENGL_FROM_OPENCV, masked)
    return Model("transforms.json", shots)


def _relative(name: str) -> str:
    name = name.replace("\\", "/").removeprefix("./")
    return name if name.lower().endswith(IMAGE_SUFFIXES) else name + ".png"  # NeRF's own sets leave the suffix out


def _lens(c: Mapping[str, Any], image_size: tuple[int, int]) -> Lens:
    height, width = int(c.get("h", image_size[0])), int(c.get("w", image_size[1]))
    if "fl_x" in c:
        fx = float(c["fl_x"])
        fy = float(c.get("fl_y", fx))
    else:
        fx = 0.5 * width / math.tan(0.5 * float(c["camera_angle_x"]))
        fy = 0.5 * height / math.tan(0.5 * float(c["camera_angle_y"])) if "camera_angle_y" in c else fx
    cx, cy = float(c.get("cx", 0.5 * width)) - 0.5, float(c.get("cy", 0.5 * height)) - 0.5
    camera = c.get("camera_model")
    if camera not in _FISHEYES + _PINHOLES:
        raise ValueError(f"camera_model {camera} is not supported: undistort the images, and write PINHOLE")
    fisheye = camera in _FISHEYES or bool(c.get("is_fisheye", False))
    if not fisheye and float(c.get("k4", 0.0)) != 0.0:  # of r^8, which OpenCV's pinhole has no place for
        raise ValueError(f"k4={c['k4']} of a camera that is no fisheye is not supported: undistort the images")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return Lens((fx, fy, cx, cy), (height, width), tuple(float(c.get(name, 0.0)) for name in names), fisheye)
