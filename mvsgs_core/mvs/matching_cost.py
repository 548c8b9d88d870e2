"""Matching costs: how unlike a pixel's window and what a neighbor shows there are.

A cost is a class here, in PyTorch, and one of the same name in csrc/mvs/NAME.cpp, which the CPU uses; tests hold both
together. The class goes into COSTS, its name into CostConfig; sweeping, occlusion and smoothing know no cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from mvsgs_core.setting_ranges import above, at_least, within

if TYPE_CHECKING:
    from torch import Tensor

    from mvsgs_core.mvs.windows import Windows


@dataclass(frozen=True)
class CostConfig:
    """The cost of a hypothesis: that of each neighbor in adaptive windows, the mean over the best neighbors.

    Raises ValueError for a noise out of its range: without any, flat windows have no correlation.
    """

    name: Literal["zncc"] = "zncc"  # zncc: 1 - ZNCC, and a part for the difference of gray level
    top_k: int = 3  # of the neighbors, per pixel and hypothesis: the others may be occluded
    noise: float = 1.5  # gray levels², from 1e-6 to 1e6: added to both windows' variances
    contrast: float = 8.0  # gray levels: what differs so from a window's center counts 1 / e in it
    intensity_weight: float = 0.0  # of the difference of both windows' means, which ZNCC doesn't see, in the cost
    intensity_range: float = 20.0  # gray levels: that difference costs 1 from here on

    def __post_init__(self) -> None:
        if not 1e-6 <= self.noise <= 1e6:
            raise ValueError(f"cost.noise={self.noise}: gray levels², from 1e-6 to 1e6")
        at_least(self, top_k=1)
        above(self, contrast=0, intensity_range=0)
        within(self, intensity_weight=(0, 1))


class MatchingCost(ABC):
    """Made for a reference's windows; raises ValueError for a configuration that makes no sense."""

    def __init__(self, windows: Windows, config: CostConfig) -> None:
        self.windows, self.config = windows, config

    @abstractmethod
    def __call__(self, samples: Tensor) -> Tensor:
        """(H, W) in [0, 1] of what a neighbor shows in each pixel's window, (taps, H, W)."""


class Zncc(MatchingCost):
    """1 - ZNCC, clamped, mixed with the difference of the windows' mean gray levels."""

    def __init__(self, windows: Windows, config: CostConfig) -> None:
        super().__init__(windows, config)
        if not (0.0 <= config.intensity_weight <= 1.0 and config.intensity_range > 0.0):
            raise ValueError("intensity_weight must lie in [0, 1], intensity_range above 0")

    def __call__(self, samples: Tensor) -> Tensor:
        correlation, mean = self.windows.correlate(samples)
        shape = (1.0 - correlation).clamp(0.0, 1.0)
        apart = ((self.windows.mean - mean).abs() / self.config.intensity_range).clamp(max=1.0)
        return shape + self.config.intensity_weight * (apart - shape)


COSTS: dict[str, type[MatchingCost]] = {"zncc": Zncc}


def make_cost(windows: Windows, config: CostConfig) -> MatchingCost:
    """The cost of that name. Raises ValueError, saying which there are, for another."""
    if config.name not in COSTS:
        raise ValueError(f"no matching cost '{config.name}'; there are: {', '.join(COSTS)}")
    return COSTS[config.name](windows, config)
