"""A camera's pose from points whose places are known, whatever some of them say (perspective-n-point, RANSAC)."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core import geometry


def pose_of_points(points: np.ndarray, pixels: np.ndarray, camera: np.ndarray, agrees: float) -> np.ndarray | None:
    """(4, 4) camera from the frame of points (N, 3), seen at pixels (N, 2) by a camera (3, 3); None: there is none.

    agrees: pixels from where the pose puts it within which a point agrees. The same points give the same pose.
    """
    cv2.setRNGSeed(0)
    try:
        found, rotation, translation, _ = cv2.solvePnPRansac(
            points, pixels, camera, np.zeros(4), iterationsCount=200, reprojectionError=agrees,
            flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # OpenCV throws where the points are no configuration for it
        return None
    return geometry.rigid(cv2.Rodrigues(rotation)[0], translation.ravel()) if found else None


__all__ = ["pose_of_points"]
