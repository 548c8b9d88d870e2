"""Depth -> FusedKeyframe: depth maps refined by V-FUSE, then the paper's filters."""

from __future__ import annotations

from dataclasses import dataclass

from msgs import FusedKeyframe
from mvsgs_core.fusion.fusion import FusedDepth
from mvsgs_core.fusion.learned import LearnedOnlineFusion, VFuseConfig, check_weights
from mvsgs_core.networks.checkpoints import RANDOM
from nodes.depth_fusion import FusionNode


class LearnedFusion(FusionNode):
    """V-FUSE (Burgdorfer and Mordohai 2023); see mvsgs_core.fusion.learned."""

    @dataclass(frozen=True)
    class Config(VFuseConfig):
        pass

    config: Config
    _core: LearnedOnlineFusion

    @classmethod
    def check(cls, config: Config) -> None:
        super().check(config)
        check_weights(config.weights)

    def _make_core(self) -> LearnedOnlineFusion:
        if self.config.weights == RANDOM:
            self.stats.warn("V-FUSE runs untrained, with random weights: its refinement is noise")
        return LearnedOnlineFusion(self.config)

    def _message(self, found: FusedDepth) -> FusedKeyframe:
        if wrong := self._core.not_finite:
            self._core.not_finite = 0
            self.stats.refuse(
                "pixels", wrong, "pixels that V-FUSE gave no finite depth or confidence have none in the map"
            )
        return super()._message(found)
