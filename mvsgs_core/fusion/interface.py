"""What a back end of fusion computes: arrays in, arrays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Fused:
    """Fusion of one reference with its neighbors, each (H, W) float32."""

    depth: np.ndarray  # 0 = unknown
    support: np.ndarray  # sum of the neighbors' confidences, weighted by agreement
    violation: np.ndarray  # sum of the confidences of those that see through the point, or of the reference itself
    own: np.ndarray  # the reference's confidence, weighted by agreement


class FusionBackend(Protocol):
    """Depths (H, W) and (N, h, w), warps (N, 12), all float32; 0 in a depth is unknown."""

    def consistent_views(
        self,
        depth: np.ndarray,
        neighbor_depths: np.ndarray,
        warps: np.ndarray,
        back: np.ndarray,
        relative: float,
        pixels: float,
        round_trip: bool,
    ) -> np.ndarray:
        """(H, W) uint8: neighbors that agree with the reference's depth.

        MVS-GS, geometric consistency: the reference's point, projected into the neighbor, against the depth there,
        `relative` to the larger of both. With `round_trip` (MVSFormer): that depth, projected back, must come within
        `pixels` of where it started, and its depth within `relative`.
        """

    def splat(
        self, depths: np.ndarray, confidences: np.ndarray, back: np.ndarray, min_neighbor_confidence: float,
        size: tuple[int, int],
    ) -> np.ndarray:  # fmt: skip
        """(N, H, W): the neighbors' pixels as depths in the reference, the nearest where several fall."""

    def fuse(
        self,
        depth: np.ndarray,
        confidence: np.ndarray,
        neighbor_depths: np.ndarray,
        neighbor_confidences: np.ndarray,
        splatted: np.ndarray,
        warps: np.ndarray,
        sigma: float,
        violation: float,
        min_neighbor_confidence: float,
    ) -> Fused:
        """The best of the reference's depth and the splatted ones by support - violation, refined by its supporters."""
