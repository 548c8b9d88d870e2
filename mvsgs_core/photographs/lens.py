"""The camera of all photographs: intrinsics of each, one factor on their focal lengths, and radial distortion.

Distorted = x (1 + k1 r² + k2 r⁴), x the point on the plane at distance 1 and r its distance from the axis (Brown 1971).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.camera import straightened


@dataclass(frozen=True)
class SharedLens:
    intrinsics: np.ndarray  # (P, 4) of each photograph, as they were given
    factor: float = 1.0  # on the focal lengths
    k1: float = 0.0
    k2: float = 0.0

    def project(self, photograph: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) in the cameras of photographs (N,); the caller checks that z > 0."""
        fx, fy, cx, cy = self.intrinsics[photograph].T
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        r2 = x * x + y * y
        bent = self.factor * (1.0 + r2 * (self.k1 + r2 * self.k2))
        return np.stack([fx * bent * x + cx, fy * bent * y + cy], axis=-1)

    def unproject(self, photograph: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Undistorted points (N, 2) on the plane at distance 1, of pixels (N, 2)."""
        fx, fy, cx, cy = self.intrinsics[photograph].T
        x, y = (pixels[:, 0] - cx) / (self.factor * fx), (pixels[:, 1] - cy) / (self.factor * fy)
        return np.stack(straightened(x, y, self.k1, self.k2), axis=-1)

    def focal(self, photograph: int) -> float:
        """Pixels, the mean of both axes."""
        return float(self.factor * self.intrinsics[photograph, :2].mean())


__all__ = ["SharedLens"]
