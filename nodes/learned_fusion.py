"""Depth -> FusedKeyframe: depth maps refined by V-FUSE, then the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass

from mvsgs_core.fusion.learned import LearnedOnlineFusion, VFuseConfig, check_weights
from mvsgs_core.networks.checkpoints import RANDOM
from nodes.depth_fusion import FusionNode


class LearnedFusion(FusionNode):
    """V-FUSE (Burgdorfer and Mordohai 2023); see mvsgs_core.fusion.learned."""

    @dataclass(frozen=True)
    class Config(VFuseConfig):
        pass

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        super().check(config)
        check_weights(config.weights)

    def _make_core(self) -> LearnedOnlineFusion:
        if self.config.weights == RANDOM:
            self.stats.warn("V-FUSE runs untrained, with random weights: its refinement is noise")
        return LearnedOnlineFusion(self.config)
