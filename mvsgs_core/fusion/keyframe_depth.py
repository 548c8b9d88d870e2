"""A keyframe's depth map as fusion stores it, and what a back end computes with such maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core.fusion.interface import DepthMaps
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
    mask: np.ndarray | None = None  # (H, W) bool, False where no depth is to be; None: it may be anywhere

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.depth.shape
        return height, width

    def doubtful(self, min_confidence: float) -> bool:
        """Whether all of its confidence is below that, as the tracker's depth has it in the place of stereo."""
        return float(self.confidence.max()) < min_confidence

    def moved(self, world_from_cam: np.ndarray, scale: float, segment: int | None = None) -> KeyframeDepth:
        """The same map after the tracker corrected its pose, the map's scale, and its segment, if that is given."""
        factor = np.float32(scale / self.scale)
        return replace(
            self, world_from_cam=world_from_cam, scale=float(scale), depth=self.depth * factor,
            segment=self.segment if segment is None else segment,
        )  # fmt: skip


def depth_maps(reference: KeyframeDepth, neighbors: list[KeyframeDepth]) -> DepthMaps:
    """What a back end computes with; at least one neighbor, all of one size."""
    there = [_warp(reference, n) for n in neighbors]
    back = [_warp(n, reference) for n in neighbors]
    return DepthMaps(
        depth=reference.depth,
        confidence=reference.confidence,
        neighbor_depths=np.ascontiguousarray(np.stack([n.depth for n in neighbors])),
        neighbor_confidences=np.ascontiguousarray(np.stack([n.confidence for n in neighbors])),
        there=np.array(there, dtype=np.float32),
        back=np.array(back, dtype=np.float32),
    )


def _warp(a: KeyframeDepth, b: KeyframeDepth) -> np.ndarray:
    return relative_warp(a.intrinsics, a.world_from_cam, b.intrinsics, b.world_from_cam)
