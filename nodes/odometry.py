"""The camera in the frames of reference of robots, `map` and `odom` (REP 105)."""

from __future__ import annotations

import numpy as np

from mvsgs_core.geometry import inverse, quaternion_from_rotation, rotation_from_quaternion


class Odometry:
    """odom -> camera goes on smoothly and drifts; what bundle adjustment and loops correct is in map -> odom."""

    def __init__(self) -> None:
        self.map_from_odom = np.eye(4)
        self._odom_from_cam: np.ndarray | None = None

    def follow(self, map_from_cam: np.ndarray, map_from_previous: np.ndarray | None) -> np.ndarray:
        """Pose (4, 4) odom_from_cam of the next frame.

        map_from_previous: of the frame before, in the same map, so that the motion between holds no correction; None
        where it is not known, and the camera counts as not moved.
        """
        if self._odom_from_cam is None:
            self._odom_from_cam = map_from_cam.copy()
        elif map_from_previous is not None:
            moved = self._odom_from_cam @ inverse(map_from_previous) @ map_from_cam
            moved[:3, :3] = rotation_from_quaternion(quaternion_from_rotation(moved[:3, :3]))
            self._odom_from_cam = moved
        self.map_from_odom = map_from_cam @ inverse(self._odom_from_cam)
        return self._odom_from_cam

    def place(self, map_from_cam: np.ndarray) -> np.ndarray:
        """Pose (4, 4) odom_from_cam of an earlier frame, in `odom` as it lies in the map now."""
        return inverse(self.map_from_odom) @ map_from_cam
