"""Keyframe -> Depth: multi-view stereo by a published network, in the frame of the weight-free cascade."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvsgs_core.mvs.hypotheses import RangeConfig
from mvsgs_core.mvs.learned import LearnedStereo, LearnedStereoConfig
from mvsgs_core.mvs.neighbors import NeighborConfig
from mvsgs_core.networks.checkpoints import RANDOM
from nodes.mvs import StereoNode


class LearnedMvs(StereoNode):
    """MVSFormer (Cao et al. 2022) or IterMVS (Wang et al. 2022); see mvsgs_core.mvs.learned."""

    @dataclass
    class Config:
        network: Literal["itermvs", "mvsformer", "mvsformer_p"] = "itermvs"
        weights: str | None = None  # checkpoint; null: where mvsgs_core.weights finds it; random: untrained, for tests
        network_area: int = 512 * 384  # pixels of the images that the network sees, aspect kept
        area: int = 320 * 240  # pixels of a depth map, aspect kept
        lag: int = 2  # keyframes after the reference that are waited for
        window: int = 8  # keyframes before the reference that may be neighbors
        neighbors: int = 4  # views that a reference is matched with
        range_margin: float = 1.6  # factor beyond the 2nd and 98th percentile of the tracker's inverse depths
        min_cells: int = 24  # valid cells of the tracker's grid; with fewer, its neighbors' give the range
        device: str = "auto"  # auto (CUDA if there is one), cpu, cuda
        threads: int | None = None  # of PyTorch; null: as the launcher sets it
        resume_after: int | None = None  # keyframes up to this frame are in a resumed map: neighbors of others only

    config: Config

    def _make_stereo(self) -> LearnedStereo:
        c = self.config
        if c.weights == RANDOM:
            self.stats.warn(f"{c.network} runs untrained, with random weights: its depth is noise")
        return LearnedStereo(
            LearnedStereoConfig(
                network=c.network,
                weights=c.weights,
                network_area=c.network_area,
                area=c.area,
                lag=c.lag,
                window=c.window,
                neighbors=NeighborConfig(count=c.neighbors),
                ranges=RangeConfig(margin=c.range_margin, min_cells=c.min_cells),
                device=c.device,
                threads=c.threads,
            )
        )
