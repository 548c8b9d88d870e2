"""Keyframe -> Depth: the tracker's own coarse depth, enlarged. The paper's ablation A."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Depth, Keyframe, Poses, Request, TrackedFrame
from mvsgs_core import camera
from mvsgs_core.inverse_depth import enlarge_inverse_depth
from mvsgs_core.setting_ranges import at_least
from nodes import Node
from nodes.mvs import depth_message


class CoarseDepth(Node):
    """Passes on what the tracker knows, at the size that stereo would have."""

    @dataclass
    class Config:
        area: int = 320 * 240  # pixels of a depth map, aspect kept

        def __post_init__(self) -> None:
            at_least(self, area=1)

    config: Config

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Depth]:
        size = camera.fit_size(keyframe.image.shape[0], keyframe.image.shape[1], self.config.area)
        with self.stats.time("enlarge"):
            depth, confidence = enlarge_inverse_depth(keyframe.inverse_depth, keyframe.inverse_depth_weight, size)
        seen = camera.mask_at(keyframe.mask, size)
        if seen is not None:
            depth, confidence = (np.where(seen, values, np.float32(0)) for values in (depth, confidence))
        self.stats.count("keyframes")
        yield depth_message(keyframe, depth, confidence)

    def on_tracked_frame(self, frame: TrackedFrame) -> Iterator[TrackedFrame]:
        """Passed on, in its place: it needs no depth."""
        yield frame

    def on_poses(self, poses: Poses) -> Iterator[Poses]:
        """Passed on, so that they reach the next stage between the same keyframes."""
        yield poses

    def on_request(self, request: Request) -> Iterator[Request]:
        """Passed on, in its place: nothing waits here."""
        yield request
