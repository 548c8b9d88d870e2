"""Keyframe -> Depth: multi-view stereo by a published network, in the frame of the weight-free cascade."""

from __future__ import annotations

from dataclasses import dataclass

from mvsgs_core import weights
from mvsgs_core.mvs.learned import NETWORKS, LearnedStereo, LearnedStereoConfig
from mvsgs_core.networks.checkpoints import RANDOM
from nodes.mvs import StereoNode


class LearnedMvs(StereoNode):
    """MVSFormer (Cao et al. 2022) or IterMVS (Wang et al. 2022); see mvsgs_core.mvs.learned."""

    @dataclass(frozen=True)
    class Config(LearnedStereoConfig):
        resume_after: int | None = None  # keyframes up to this frame are in a resumed map: neighbors of others only

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        if config.weights != RANDOM:
            weights.find(NETWORKS[config.network].weights, config.weights)

    def _make_core(self) -> LearnedStereo:
        c = self.config
        if c.weights == RANDOM:
            self.stats.warn(f"{c.network} runs untrained, with random weights: its depth is noise")
        return LearnedStereo(c)
