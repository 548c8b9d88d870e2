"""What a back end of stereo computes: its options, arrays in, arrays out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

TILE = (8, 16)  # (rows, columns) of the tiles that a sweep can leave out


@dataclass(frozen=True)
class CostOptions:
    """Windowed ZNCC of a sweep, and a share of the difference of gray level."""

    radius: int = 2  # pixels: a window of 2 radius + 1
    best: int = 3  # views whose cost counts, of all
    noise: float = 1.5  # gray levels²: added to both variances
    contrast: float = 8.0  # gray levels: a pixel that differs so from the window's center counts 1 / e
    level: float = 0.0  # share of the cost that is the difference of both windows' means; ZNCC doesn't see it
    level_range: float = 20.0  # gray levels: that difference costs 1 from here on


@dataclass(frozen=True)
class SmoothOptions:
    """Semi-global smoothing, and the softmax that gives the probability."""

    p1: float = 0.3  # cost of a change by one hypothesis
    p2: float = 2.0  # cost of a larger change
    edge: float = 12.0  # gray levels that halve these
    break_steps: float = 4.0  # hypotheses: a larger jump of the surface ends the path
    temperature: float = 0.02  # of the softmax, in cost
    paths: int = 8  # directions, 4 or 8


@dataclass(frozen=True)
class ChooseOptions:
    """Semi-global smoothing over arbitrary surfaces."""

    p1: float  # cost per inverse depth between neighboring pixels
    p2: float  # the most that they pay
    edge: float  # gray levels that halve these
    apart: float  # inverse depth: a surface farther than this from another is not the same


@dataclass(frozen=True)
class Choice:
    """What a stage found, each (H, W)."""

    index: np.ndarray  # float32 the best hypothesis, between whole ones by a parabola
    probability: np.ndarray  # float32 softmax mass within one hypothesis of the best
    margin: np.ndarray  # float32 how much worse the best other hypothesis is, in cost, at most 1
    best: np.ndarray  # int32 the best hypothesis


class Backend(Protocol):
    """Images (H, W) and (N, H, W) float32; warps (N, 12) float32; `first`, `step` (H, W) float32: hypothesis k of a

    pixel is the inverse depth first + k step. Costs are (H, D, W) float32 in [0, 1].
    """

    def cost_volume(
        self,
        reference: np.ndarray,
        neighbors: np.ndarray,
        warps: np.ndarray,
        first: np.ndarray,
        step: np.ndarray,
        hypotheses: int,
        options: CostOptions,
        needed: np.ndarray | None = None,
    ) -> np.ndarray:
        """`needed` (tile rows, D, tile columns) uint8, tiles of TILE pixels: elsewhere the cost is 1, uncomputed."""

    def semi_global(
        self, cost: np.ndarray, reference: np.ndarray, first: np.ndarray, step: np.ndarray, options: SmoothOptions
    ) -> Choice: ...

    def surface_costs(
        self, reference: np.ndarray, neighbors: np.ndarray, warps: np.ndarray, surfaces: np.ndarray,
        options: CostOptions, needed: np.ndarray | None = None,
    ) -> np.ndarray:  # fmt: skip
        """(H, D, W) costs of surfaces (D, H, W): each pixel's window follows the surface around it."""

    def choose_surface(
        self, cost: np.ndarray, surfaces: np.ndarray, reference: np.ndarray, options: ChooseOptions
    ) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) int32: which of the surfaces (D, H, W) with costs (H, D, W) each pixel lies on; and (H, W) float32:

        how much worse the best surface is, in mean path cost, that is not the same, at most 1.
        """

    def view_correlation(
        self, reference: np.ndarray, neighbors: np.ndarray, warps: np.ndarray, inverse_depth: np.ndarray,
        options: CostOptions,
    ) -> np.ndarray: ...  # fmt: skip
