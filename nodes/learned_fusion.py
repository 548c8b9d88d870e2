"""Depth -> View: depth maps refined by V-FUSE, then the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from msgs import Depth
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.fusion.learned import RANDOM
from mvsgs_core.fusion.learned import LearnedFusion as Fusion
from nodes import Node
from nodes.depth_fusion import DepthFusion


class LearnedFusion(DepthFusion):
    """V-FUSE (Burgdorfer and Mordohai 2023); see mvsgs_core.fusion.learned."""

    @dataclass
    class Config:
        weights: str | None = None  # checkpoint; null: where mvsgs_core.weights finds it; random: untrained, for tests
        center: str = "conf"  # of a pixel's search window: conf, the most confident depth, or mean, the weighted mean
        lag: int = 2  # keyframes after the reference that are waited for
        window: int = 4  # keyframes before the reference that may be neighbors
        neighbors: int = 4  # depth maps that a reference is refined and checked with
        check: bool = True  # geometric consistency
        relative: float = 0.01  # relative depth difference that still agrees
        round_trip: bool = False  # check by projecting back, instead of the paper's one way
        least_views: int = 3  # views that must agree, the reference counted
        confidence: float = 0.7  # least confidence of a kept pixel, relative to the image: see networks.vfuse

    config: Config  # type: ignore[assignment]

    def __init__(self, config: Any = None) -> None:
        Node.__init__(self, config)
        c = self.config
        self._fusion = Fusion(
            FusionConfig(
                lag=c.lag,
                window=c.window,
                neighbors=c.neighbors,
                check=c.check,
                relative=c.relative,
                round_trip=c.round_trip,
                least_views=c.least_views,
                confidence=c.confidence,
            ),
            c.weights,
            c.center,
        )
        self._depths: dict[int, Depth] = {}
        self._poses: dict[int, tuple[np.ndarray, float]] = {}
        if c.weights == RANDOM:
            self.stats.warn("V-FUSE runs untrained, with random weights: its refinement is noise")
