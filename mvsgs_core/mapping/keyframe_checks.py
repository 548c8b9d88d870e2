"""What a keyframe must be to be mapped. What is not is refused and counted before it reaches the map.

Everything here is finite or nearly so: a number that no camera gives is as bad as NaN, as squares and products of it
overflow, and one such pixel or pose would move the whole map's bounds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvsgs_core.camera import FOCAL_RANGE, is_near_middle, is_readout_time
from mvsgs_core.geometry import is_rigid
from mvsgs_core.mapping.frame_of_reference import FAR
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.stats import Stats

MIN_SIDE = 8  # pixels of an image
NO_SHUTTER = "photographs whose size, velocity or readout time no camera has were trained on without their shutter"
NO_POSE = "a corrected pose that is not finite, or none at all, was refused"


def checked_keyframe(view: RGBDKeyframe, log: Stats) -> RGBDKeyframe | None:
    """The view without normals and confidences that are none; None, and counted, where it cannot be mapped."""
    problem = _problem(view)
    if problem:
        log.refuse("views", 1, f"a keyframe with {problem} was refused")
        return None
    normals, confidence = view.normals, view.confidence
    if normals is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            squared = np.einsum("...i,...i", normals, normals)
            bad = ~(squared <= 1.5**2)  # NaN is none either
        if bad.any():
            log.refuse("normals", int(bad.sum()), "normals that are not finite or no unit vectors were left out")
            normals = np.where(bad[..., None], np.float32(0), normals)
    if confidence is not None and not np.isfinite(confidence).all():
        confidence = np.where(np.isfinite(confidence), confidence, np.float32(0))
    view = replace(view, normals=normals, confidence=confidence)
    if view.photograph is None:
        return view
    if view.photograph.shape == view.image.shape and is_read_out(view.velocity, view.readout_time):
        return view
    log.refuse("photographs", 1, NO_SHUTTER)
    return replace(view, photograph=None)


def is_read_out(velocity: np.ndarray | None, readout_time: float) -> bool:
    """Whether that is how a camera's rolling shutter reads an image: velocity (6,), seconds."""
    return velocity is not None and bool(np.isfinite(velocity).all() and is_readout_time(readout_time))


def is_pose(world_from_cam: np.ndarray, scale: float) -> bool:
    """Whether that is a rigid transform (4, 4), and the scale one that a map may have."""
    return 1.0 / FAR < scale < FAR and is_rigid(world_from_cam)


def _problem(view: RGBDKeyframe) -> str:
    """Why it cannot be mapped; empty if it can."""
    height, width = view.image.shape[:2]
    size, focal = max(height, width), np.asarray(view.intrinsics, dtype=np.float64)[:2]
    if min(height, width) < MIN_SIDE:
        return f"an image smaller than {MIN_SIDE} pixels"
    if view.depth.ndim != 2 or view.depth.size == 0:
        return "an empty depth map"
    maps = (view.confidence, view.normals, view.unfiltered)
    if any(given is not None and given.shape[:2] != view.depth.shape for given in maps):
        return "maps of different sizes"
    if view.mask is not None and view.mask.shape != (height, width):
        return "a mask of another size than its image"
    if not np.isfinite(view.intrinsics).all():
        return "a pose or intrinsics that are not finite"
    if not all(FOCAL_RANGE[0] * size <= f <= FOCAL_RANGE[1] * size for f in focal):
        return "a focal length that no camera has"
    if not is_near_middle(view.intrinsics, (height, width)):
        return "a principal point far outside of the image"
    if not (np.isfinite(view.world_from_cam).all() and np.isfinite(view.scale)):
        return "a pose or intrinsics that are not finite"
    if not is_pose(np.asarray(view.world_from_cam, dtype=np.float64), view.scale):
        return "a pose that is no rotation and position, or a scale that no map has"
    return ""
