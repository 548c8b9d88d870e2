"""transforms.json of a map's keyframes, as nerfstudio and instant-ngp read it: OpenGL camera axes, COLMAP's pixels."""

from __future__ import annotations

import json
import os
from pathlib import Path

from mvsgs_core.atomic_file import replace_text
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.keyframe_images import image_name, there
from mvsgs_core.geometry import OPENGL_FROM_OPENCV


def write_transforms(path: Path, cameras: Cameras, images: Path) -> int:
    """Replaces `path`; returns how many of the keyframes have their image. Raises OSError.

    images: the folder of the keyframes' images, as mapper.save_images=true leaves it, named relative to the file.
    Keyframes without one are left out, as readers open them all; not where none is there yet. Images are undistorted,
    so there are no distortion parameters.
    """
    folder = Path(os.path.relpath(images.absolute(), path.absolute().parent)).as_posix()
    frames, known = [], there(images, cameras.keyframes)
    if known.any():
        cameras = cameras.chosen(known)
    for k, index in enumerate(cameras.keyframes.tolist()):
        name = image_name(index)
        fx, fy, cx, cy = cameras.intrinsics[k].tolist()
        height, width = cameras.sizes[k].tolist()
        frames.append(
            {
                "file_path": f"{folder}/{name}", "w": width, "h": height, "fl_x": fx, "fl_y": fy,
                "cx": cx + 0.5, "cy": cy + 0.5,
                "transform_matrix": (cameras.world_from_cam[k] @ OPENGL_FROM_OPENCV).tolist(),
            }
        )  # fmt: skip
    text = json.dumps({"camera_model": "OPENCV", "frames": frames}, allow_nan=False)
    replace_text(path, text.replace(' {"file_path"', '\n{"file_path"') + "\n")  # a frame a line
    return int(known.sum())
