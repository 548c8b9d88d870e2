"""Photographs without the distortion that the tracker found in them: renders are of a pinhole camera."""

from __future__ import annotations

import functools

import numpy as np

from mvsgs_core.datasets.lens import Lens, Undistortion
from mvsgs_core.trajectory import Trajectory


def undistortion(trajectory: Trajectory, intrinsics: np.ndarray, size: tuple[int, int]) -> Undistortion | None:
    """That of frames with intrinsics (4,) as they came, and `size` (height, width): as their keyframes have it.

    None where the tracker found no distortion.
    """
    if trajectory.distortion is None:
        return None
    fx, fy, cx, cy = (float(v) for v in intrinsics * [trajectory.focal_factor, trajectory.focal_factor, 1.0, 1.0])
    k1, k2 = (float(v) for v in trajectory.distortion)
    return _made(Lens((fx, fy, cx, cy), size, (k1, k2, 0.0, 0.0)))


@functools.lru_cache(maxsize=4)  # photographs of a stream share few lenses, and its maps are as large as an image
def _made(lens: Lens) -> Undistortion:
    return Undistortion(lens)
