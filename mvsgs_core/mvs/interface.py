"""What a back end of stereo computes: arrays in, arrays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.setting_ranges import above, at_least

TILE = (8, 16)  # (rows, columns) of the tiles that a sweep can leave out
RADII = (0, 16)  # pixels that the radius of a matching window may have


@dataclass(frozen=True)
class MatchingImages:
    """A reference and the neighbors that it is matched with, at one size of the cascade."""

    reference: np.ndarray  # (H, W) float32 gray levels
    neighbors: np.ndarray  # (N, h, w) float32
    warps: np.ndarray  # (N, 12) float32, from the reference into each neighbor: see mvsgs_core.warp


@dataclass(frozen=True)
class SmoothingConfig:
    """Semi-global smoothing, and the softmax that gives the probability."""

    edge: float = 12.0  # gray levels that halve P1 and P2
    break_steps: float = 4.0  # hypotheses: a larger jump of the surface ends the path
    temperature: float = 0.02  # of the softmax, in cost
    paths: Literal[4, 8] = 8  # directions

    def __post_init__(self) -> None:
        above(self, edge=0, temperature=0)
        at_least(self, break_steps=0)


@dataclass(frozen=True)
class SurfaceEstimate:
    """The hypothesis of each pixel, each (H, W)."""

    index: np.ndarray  # float32 the best hypothesis, between whole ones by a parabola
    probability: np.ndarray  # float32 softmax mass within one hypothesis of the best
    margin: np.ndarray  # float32 how much worse the best other hypothesis is, in cost, at most 1
    best: np.ndarray  # int32 the best hypothesis


@dataclass(frozen=True)
class ChooseOptions:
    """Semi-global smoothing over arbitrary surfaces."""

    p1: float  # cost per inverse depth between neighboring pixels
    p2: float  # the most that they pay
    edge: float  # gray levels that halve these
    apart: float  # inverse depth: a surface farther than this from another is not the same


class Backend(Protocol):
    """Maps are (H, W) float32, costs (H, D, W) float32 in [0, 1]; `radius` is of the matching window, in pixels.

    `needed` (tile rows, D, tile columns) uint8, tiles of TILE pixels: elsewhere the cost is 1, uncomputed.
    """

    def cost_volume(
        self, images: MatchingImages, first: np.ndarray, step: np.ndarray, hypotheses: int, radius: int,
        cost: CostConfig, needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Costs of a sweep: hypothesis k of a pixel is the inverse depth first + k step."""

    def surface_costs(
        self, images: MatchingImages, surfaces: np.ndarray, radius: int, cost: CostConfig,
        needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Costs of surfaces (D, H, W): each pixel's window follows the surface around it."""

    def semi_global(
        self, cost: np.ndarray, reference: np.ndarray, first: np.ndarray, step: np.ndarray, p1: float, p2: float,
        smoothing: SmoothingConfig,
    ) -> SurfaceEstimate:  # fmt: skip
        """The surface of least cost; p1: of a change by one hypothesis between neighboring pixels, p2: of a larger."""

    def choose_surface(
        self, cost: np.ndarray, surfaces: np.ndarray, reference: np.ndarray, options: ChooseOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) int32: which of the surfaces (D, H, W) with costs (H, D, W) each pixel lies on; and (H, W) float32:

        how much worse the best surface is, in mean path cost, that is not the same, at most 1.
        """

    def view_correlation(
        self, images: MatchingImages, inverse_depth: np.ndarray, radius: int, cost: CostConfig
    ) -> np.ndarray:
        """(N, H, W) ZNCC of each neighbor in the cost's windows; -2 where it does not see the pixel."""
