"""Keyframe, MapView -> Depth: multi-view stereo that passes over keyframes which the map explains already."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from msgs import Depth, MapView, Poses
from mvsgs_core.mvs.cascade import Cascade, CascadeDepth
from mvsgs_core.mvs.explained import ExplainChoice, Explained, MapSight
from nodes.mvs import Mvs


class SkippingMvs(Mvs):
    """What the mapper shows comes back, newest only, so what is passed over depends on the timing of the processes.

    A keyframe passed over has no depth: it adds nothing to the map, which is trained on its image all the same.
    """

    @dataclass
    class Config(Mvs.Config):
        skip_explained: float = 0.8  # share of a keyframe's pixels that the map must explain
        tolerance: float = 12.0  # gray levels that a pixel and the map's may differ

    config: Config

    def _make_cascade(self) -> Cascade:
        cascade = super()._make_cascade()
        cascade.explained = self._explained = Explained(
            ExplainChoice(share=self.config.skip_explained, tolerance=self.config.tolerance)
        )
        return cascade

    def on_map_view(self, shown: MapView) -> Iterator[Depth]:
        self.stats.count("map views")
        gray = cv2.cvtColor(np.array(shown.render), cv2.COLOR_RGB2GRAY).astype(np.float32)
        sight = MapSight(
            shown.index, gray, np.array(shown.depth), shown.intrinsics, shown.world_from_cam, shown.scale, shown.segment
        )
        if shown.index in self._poses:
            sight = sight.moved(*self._poses[shown.index])
        self._explained.see(sight)
        yield from ()

    def on_poses(self, poses: Poses) -> Iterator[Poses]:
        yield from super().on_poses(poses)
        self._explained.move(self._poses)

    def on_end(self) -> Iterator[Depth]:
        yield from super().on_end()
        if not self.stats.counts.get("map views"):
            self.stats.warn("no keyframe could be passed over: the mapper sent no MapView (mapper.map_views=true)")

    def _message(self, found: CascadeDepth) -> Depth:
        self.stats.skip("keyframes that the map explains", found.result.counts.get("explained", 0.0))
        return super()._message(found)
