"""transforms.json, as NeRF, instant-ngp and nerfstudio write it: OpenGL camera axes, COLMAP's pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.bad_file import reading
from mvsgs_core.datasets.files import IMAGE_SUFFIXES, UnreadableImageError, inside, opened_image
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.model import Model, Shot, matched, rigid
from mvsgs_core.geometry import OPENGL_FROM_OPENCV

_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_PINHOLES = (None, "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # with no distortion or OpenCV's
_IN_PIXELS = {"fl_x", "fl_y", "cx", "cy"}
NAMES = ("transforms.json", "transforms_train.json")


def find_transforms(folder: Path, part: str = "") -> Path | None:
    """part: the folder of the images in it, such as the test/ of NeRF's own sets, which have a file of each part."""
    names = (f"transforms_{part}.json", *NAMES)
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_transforms(path: Path, images: list[Path], image_size: tuple[int, int], masks: Path | None = None) -> Model:
    """The model of a transforms.json, with the images that it keeps for tests.

    image_size: (height, width) of most of the `images` on disk, not turned by EXIF: where the file says no size,
    intrinsics that a frame has of its own are for its image's, those of all frames for this one. masks: folder that
    names of masks start at, where it is not the file's; one that is not there has none.
    Raises BadFileError for a malformed file, a camera or pose in it that cannot be, or a camera model that has no
    counterpart.
    """
    shots = {}
    with reading(path, "is no transforms.json that can be used"):
        content = json.loads(path.read_bytes())
        frames = {_relative(f["file_path"]): f for f in [*content["frames"], *content.get("test_frames", [])]}
        image_of = dict(zip(matched(frames, images), images))
        for name, frame in frames.items():
            with reading(f"frame {name!r}", "cannot be"):
                pose = rigid(np.array(frame["transform_matrix"], dtype=np.float64), "transform_matrix")
                said, size = {**_common(content, frame), **frame}, image_size
                if not {"h", "w"} <= said.keys() and _IN_PIXELS & frame.keys() and name in image_of:
                    size = _size_on_disk(image_of[name], image_size)
                lens, mask = _lens(said, size), said.get("mask_path")
                masked = None
                if mask is not None and (masks is None or masks.is_dir()):
                    masked = inside(masks or path.parent, mask, path)
                shots[name] = Shot(lens, pose @ OPENGL_FROM_OPENCV, masked)
    return Model("transforms.json", shots)


def _common(content: Mapping[str, Any], frame: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the file says of all frames, less the focal lengths where this one has an angle of view of its own."""
    if "camera_angle_x" not in frame:
        return content
    return {name: value for name, value in content.items() if name not in ("fl_x", "fl_y", "camera_angle_y")}


def _relative(name: str) -> str:
    name = name.replace("\\", "/").removeprefix("./")
    return name if name.lower().endswith(IMAGE_SUFFIXES) else name + ".png"  # NeRF's own sets leave the suffix out


def _size_on_disk(image: Path, otherwise: tuple[int, int]) -> tuple[int, int]:
    """(height, width); `otherwise` of one that cannot be read, which is left out later."""
    with suppress(UnreadableImageError), opened_image(image, image.name) as opened:
        return opened.height, opened.width
    return otherwise


def _lens(c: Mapping[str, Any], image_size: tuple[int, int]) -> Lens:
    height, width = int(c.get("h", image_size[0])), int(c.get("w", image_size[1]))
    if "fl_x" in c:
        fx = float(c["fl_x"])
        fy = float(c.get("fl_y", fx))
    else:
        fx = _focal_length(c, "camera_angle_x", width)
        fy = _focal_length(c, "camera_angle_y", height) if "camera_angle_y" in c else fx
    cx, cy = float(c.get("cx", 0.5 * width)) - 0.5, float(c.get("cy", 0.5 * height)) - 0.5
    camera = c.get("camera_model")
    if camera not in _FISHEYES + _PINHOLES:
        raise ValueError(f"camera_model {camera} is not supported: undistort the images, and write PINHOLE")
    fisheye = camera in _FISHEYES or bool(c.get("is_fisheye", False))
    if not fisheye and float(c.get("k4", 0.0)) != 0.0:  # of r^8, which OpenCV's pinhole has no place for
        raise ValueError(f"k4={c['k4']} of a camera that is no fisheye is not supported: undistort the images")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return Lens((fx, fy, cx, cy), (height, width), tuple(float(c.get(name, 0.0)) for name in names), fisheye)


def _focal_length(c: Mapping[str, Any], name: str, side: int) -> float:
    """In pixels, of the angle of view `name` across so many. Raises ValueError for what is no such angle."""
    angle = float(c[name])
    if not 0.0 < angle < math.pi:
        raise ValueError(f"{name} = {angle:g} is no angle of view between 0 and pi: write it in radians, no degrees")
    return 0.5 * side / math.tan(0.5 * angle)
