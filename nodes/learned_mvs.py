"""Keyframe -> Depth: multi-view stereo by a published network, in the frame of the weight-free cascade."""

from __future__ import annotations

from dataclasses import dataclass

from msgs import Depth
from mvsgs_core.mvs.cascade import CascadeDepth
from mvsgs_core.mvs.learned import NOT_FINITE, LearnedStereo, LearnedStereoConfig, check_network
from mvsgs_core.networks.checkpoints import RANDOM
from mvsgs_core.pace import check_efforts
from nodes.mvs import StereoNode


class LearnedMvs(StereoNode):
    """MVSFormer (Cao et al. 2022) or IterMVS (Wang et al. 2022); see mvsgs_core.mvs.learned."""

    @dataclass(frozen=True)
    class Config(LearnedStereoConfig):
        resume_after: int | None = None  # keyframes up to this frame are in a resumed map: neighbors of others only

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        check_efforts(LearnedStereo.efforts, config.efforts)
        check_network(config.network, config.weights)

    def _make_core(self) -> LearnedStereo:
        c = self.config
        if c.weights == RANDOM:
            self.stats.warn(f"{c.network} runs untrained, with random weights: its depth is noise")
        return LearnedStereo(c)

    def _message(self, found: CascadeDepth) -> Depth:
        if wrong := found.result.counts.get(NOT_FINITE, 0.0):
            self.stats.refuse("pixels", wrong, f"{NOT_FINITE} have none in the map")
        return super()._message(found)
