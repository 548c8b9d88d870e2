"""Depth -> FusedKeyframe: depth maps refined by V-FUSE, then the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvsgs_core.fusion.fusion import DepthFusion as Fusion
from mvsgs_core.fusion.learned import LearnedFusion as LearnedCore
from mvsgs_core.fusion.learned import VFuseConfig
from mvsgs_core.networks.checkpoints import RANDOM
from nodes.depth_fusion import FusionNode


class LearnedFusion(FusionNode):
    """V-FUSE (Burgdorfer and Mordohai 2023); see mvsgs_core.fusion.learned."""

    @dataclass
    class Config:
        weights: str | None = None  # checkpoint; null: where mvsgs_core.weights finds it; random: untrained, for tests
        center: Literal["conf", "mean"] = (
            "conf"  # of a pixel's search window: conf, the most confident depth, or mean, the weighted mean
        )
        # see mvsgs_core.networks.vfuse_confidence
        confidence_mode: Literal["swr", "single", "pns", "pns_swr", "pkrn"] = "swr"
        lag: int = 2  # keyframes after the reference that are waited for
        window: int = 4  # keyframes before the reference that may be neighbors
        neighbors: int = 4  # depth maps that a reference is refined and checked with
        check: bool = True  # geometric consistency
        relative: float = 0.01  # relative depth difference that still agrees
        round_trip: bool = False  # check by projecting back, instead of the paper's one way
        min_views: int = 3  # views that must agree, the reference counted
        confidence: float = 0.7  # least confidence of a kept pixel; that of swr is relative to the image
        device: str = "auto"  # auto (CUDA if there is one), cpu, cuda
        threads: int | None = None  # of the C++ kernels; null: all

    config: Config

    def _make_fusion(self) -> Fusion:
        c = self.config
        if c.weights == RANDOM:
            self.stats.warn("V-FUSE runs untrained, with random weights: its refinement is noise")
        return LearnedCore(
            VFuseConfig(
                weights=c.weights,
                center=c.center,
                confidence_mode=c.confidence_mode,
                lag=c.lag,
                window=c.window,
                neighbors=c.neighbors,
                check=c.check,
                relative=c.relative,
                round_trip=c.round_trip,
                min_views=c.min_views,
                confidence=c.confidence,
                discontinuity_radius=0,  # the paper has neither
                speckle=0,
                device=c.device,
                threads=c.threads,
            )
        )
