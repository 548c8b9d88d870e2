"""The mapper's own frame: positions relative to the first keyframe's, in units of its median depth.

So float32 holds wherever the world's origin and scale are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.geometry import Similarity

FAR = 1e6  # median depths from the origin, and between scales: float32 has no detail left there
MAX_DEPTH = 1e18  # in the world's unit: squares of it are finite in float32


@dataclass
class FrameOfReference:
    """Begun by the first keyframe, its unit by the first that has depth."""

    origin: np.ndarray | None = None  # (3,) float64 world position of the first keyframe
    unit: float | None = None  # median depth of the first keyframe that has depth, world units

    @property
    def length(self) -> float:
        """World units in one of the mapper's."""
        return self.unit or 1.0

    def begin(self, world_from_cam: np.ndarray, median_depth: float) -> bool:
        """Takes what is missing yet from a keyframe, 0 where its depth is not known; whether the unit is new."""
        return self.adopt(FrameOfReference(world_from_cam[:3, 3].copy(), median_depth or None))

    def adopt(self, other: FrameOfReference) -> bool:
        """Takes what is missing yet from another frame; whether the unit is new."""
        if self.origin is None:
            self.origin = other.origin
        if self.unit is not None or other.unit is None:
            return False
        self.unit = other.unit
        return True

    def holds(self, world_from_cam: np.ndarray, depth: float = 0.0) -> bool:
        """Whether a camera and what it sees at `depth`, world units, are where float32 has detail."""
        if self.unit is None:
            return depth < MAX_DEPTH
        position = self.local(world_from_cam)[:3, 3]
        return bool(depth < MAX_DEPTH and np.abs(position).max() < FAR and depth / self.unit < FAR)

    def local(self, world_from_cam: np.ndarray) -> np.ndarray:
        """The pose (4, 4) in this frame."""
        local = world_from_cam.copy()
        local[:3, 3] = (local[:3, 3] - self.origin) / self.length
        return local

    def from_other(self, other: FrameOfReference) -> Similarity:
        """What takes positions of another frame to this one; both are begun."""
        assert self.origin is not None
        assert other.origin is not None
        return Similarity(other.length / self.length, np.eye(3), (other.origin - self.origin) / self.length)
