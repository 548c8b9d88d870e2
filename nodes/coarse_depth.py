"""Keyframe -> Depth: the tracker's own coarse depth, enlarged. The paper's ablation A."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from msgs import Depth, Keyframe, Poses, TrackedFrame
from mvsgs_core import camera
from mvsgs_core.inverse_depth import enlarge_inverse_depth
from nodes import Node
from nodes.mvs import depth_message


class CoarseDepth(Node):
    """Passes on what the tracker knows, at the size that stereo would have."""

    @dataclass
    class Config:
        area: int = 320 * 240  # pixels of a depth map, aspect kept

    config: Config

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Depth]:
        size = camera.fit_size(keyframe.image.shape[0], keyframe.image.shape[1], self.config.area)
        with self.stats.time("enlarge"):
            depth, confidence = enlarge_inverse_depth(keyframe.inverse_depth, keyframe.inverse_depth_weight, size)
        self.stats.count("keyframes")
        yield depth_message(keyframe, depth, confidence)

    def on_tracked_frame(self, frame: TrackedFrame) -> Iterator[TrackedFrame]:
        """Passed on, in its place: it needs no depth."""
        yield frame

    def on_poses(self, poses: Poses) -> Iterator[Poses]:
        """Passed on, so that they reach the next stage between the same keyframes."""
        yield poses
