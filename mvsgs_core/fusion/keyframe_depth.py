"""A keyframe's depth map as fusion stores it, and the warps between such maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core.warp import relative_warp


@dataclass(frozen=True)
class KeyframeDepth:
    """One depth map with its camera."""

    index: int
    depth: np.ndarray  # (H, W) float32, 0 = unknown
    confidence: np.ndarray  # (H, W) float32 0 to 1
    intrinsics: np.ndarray  # (4,) float64 at the depth map's size
    world_from_cam: np.ndarray  # (4, 4) float64
    scale: float  # of the map, that pose and depth are in
    segment: int = 0

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.depth.shape
        return height, width

    def moved(self, world_from_cam: np.ndarray, scale: float) -> KeyframeDepth:
        """The same map after the tracker corrected its pose and the map's scale."""
        factor = np.float32(scale / self.scale)
        return replace(self, world_from_cam=world_from_cam, scale=float(scale), depth=self.depth * factor)


def warps_between(reference: KeyframeDepth, neighbors: list[KeyframeDepth]) -> tuple[np.ndarray, np.ndarray]:
    """(there (N, 12), back (N, 12)) float32: from the reference into each neighbor, and back."""
    there = [
        relative_warp(reference.intrinsics, reference.world_from_cam, n.intrinsics, n.world_from_cam) for n in neighbors
    ]
    back = [
        relative_warp(n.intrinsics, n.world_from_cam, reference.intrinsics, reference.world_from_cam) for n in neighbors
    ]
    return np.array(there, dtype=np.float32), np.array(back, dtype=np.float32)
