"""The mapper's own frame: positions relative to the first keyframe's, in units of its median depth.

So float32 holds wherever the world's origin and scale are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.mapping.deformation import Similarity


@dataclass
class FrameOfReference:
    """Begun by the first keyframe, its unit by the first that has depth."""

    origin: np.ndarray | None = None  # (3,) float64 world position of the first keyframe
    unit: float | None = None  # median depth of the first keyframe that has depth, world units

    @property
    def length(self) -> float:
        """World units in one of the mapper's."""
        return self.unit or 1.0

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
