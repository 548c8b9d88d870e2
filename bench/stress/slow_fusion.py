"""Slow depth fusion, `depth_fusion._target_=bench.stress.slow_fusion.SlowFusion`: what a slow node does to a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from msgs import Depth, FusedKeyframe
from nodes.depth_fusion import DepthFusion


class SlowFusion(DepthFusion):
    """Waits after each depth map for `factor` - 1 times as long as it has taken."""

    @dataclass(frozen=True)
    class Config(DepthFusion.Config):
        factor: float = 10.0  # times as slow

    config: Config

    def on_depth(self, depth: Depth) -> Iterator[FusedKeyframe]:
        before = sum(self.stats.seconds.values())
        yield from super().on_depth(depth)
        taken = sum(self.stats.seconds.values()) - before
        with self.stats.time("waiting"):
            time.sleep(taken * (self.config.factor - 1.0))
