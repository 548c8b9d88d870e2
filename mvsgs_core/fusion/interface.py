"""What a back end of fusion computes: arrays in, arrays out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Fused:
    """Fusion of one reference with its neighbors, each (H, W) float32."""

    depth: np.ndarray  # 0 = unknown
    support: np.ndarray  # sum of the neighbors' confidences, weighted by agreement
    violation: np.ndarray  # sum of the confidences of those that see through the point, or of the reference itself
    own: np.ndarray  # the reference's confidence, weighted by agreement


@dataclass(frozen=True)
class FuseOptions:
    """How depths support and contradict each other."""

    violation: float  # weight of free-space violations against support
    min_neighbor_confidence: float  # a neighbor's pixel below takes no part


@dataclass(frozen=True)
class DepthMaps:
    """A reference's map and its neighbors', all float32; 0 in a depth is unknown."""

    depth: np.ndarray  # (H, W)
    confidence: np.ndarray  # (H, W)
    neighbor_depths: np.ndarray  # (N, h, w)
    neighbor_confidences: np.ndarray  # (N, h, w)
    there: np.ndarray  # (N, 12) warps from the reference into each neighbor: see mvsgs_core.warp
    back: np.ndarray  # (N, 12) and back

    def of(self, chosen: np.ndarray) -> DepthMaps:
        """With those neighbors alone for which `chosen` (N,) bool is true."""
        names = ("neighbor_depths", "neighbor_confidences", "there", "back")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


class FusionBackend(Protocol):
    """The steps of fusion over depth maps."""

    def parallax(self, maps: DepthMaps) -> np.ndarray:
        """(H, W) float32: pixels that the neighbors together move a point for a relative change of its inverse depth.

        The root of the sum of squares over the neighbors in whose image the point falls; 0 where depth is unknown.
        """

    def consistent_views(self, maps: DepthMaps, relative: np.ndarray) -> np.ndarray:
        """(H, W) uint8: neighbors that agree with the reference's depth.

        MVS-GS, geometric consistency: the reference's point, projected into the neighbor, against the depth there,
        within `relative` (H, W) float32 of the larger of both.
        """

    def splat(self, maps: DepthMaps, options: FuseOptions) -> np.ndarray:
        """(N, H, W): the neighbors' pixels as depths in the reference, the nearest where several fall."""

    def fuse(self, maps: DepthMaps, splatted: np.ndarray, sigma: np.ndarray, options: FuseOptions) -> Fused:
        """The best of the reference's depth and the splatted ones by support - violation, refined by its supporters.

        sigma: (H, W) float32, the width of the support, relative to depth.
        """
