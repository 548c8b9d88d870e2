"""Poses of the frames between keyframes: interpolated, then refined against both (DROID-SLAM, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core import geometry
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.networks import Networks
from mvsgs_core.droid.video import Video, VideoFrame
from mvsgs_core.stats import Stats

BATCH = 16  # frames solved together
_UPDATES = 6  # motion only


@dataclass(frozen=True)
class StoredFrame:
    """A frame as the networks see it, losslessly packed: the whole stream is needed again at the end."""

    index: int
    timestamp: float  # seconds
    packed: np.ndarray

    @staticmethod
    def of(index: int, timestamp: float, image: np.ndarray) -> StoredFrame:
        """From an image (8h, 8w, 3) uint8."""
        _, packed = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return StoredFrame(index, timestamp, packed)

    @property
    def image(self) -> np.ndarray:
        return np.asarray(cv2.imdecode(self.packed, cv2.IMREAD_UNCHANGED))


def fill(
    video: Video,
    networks: Networks,
    frames: Sequence[StoredFrame],
    correlation: str,
    threads: int,
    stats: Stats,
) -> np.ndarray:
    """cam_from_world (N, 4, 4) of N frames that are no keyframes, none before the first keyframe.

    NaN where no bundle adjustment could be done: a pose that was only interpolated is none.
    """
    poses = [np.zeros((0, 4, 4))]
    for start in range(0, len(frames), BATCH):
        poses.append(_fill(video, networks, frames[start : start + BATCH], correlation, threads, stats))
    return np.concatenate(poses)


def _fill(
    video: Video,
    networks: Networks,
    frames: Sequence[StoredFrame],
    correlation: str,
    threads: int,
    stats: Stats,
) -> np.ndarray:
    count = len(video)
    before, after = video.around([frame.index for frame in frames])
    features = networks.features([frame.image for frame in frames])
    known = video.frames[:count]
    for n, frame in enumerate(frames):
        a, b = known[before[n]], known[after[n]]
        video.frames.append(
            VideoFrame(
                frame.index,
                frame.timestamp,
                between(a, b, frame.timestamp),
                np.ones_like(a.inverse_depth),
                features[n],
            )
        )
    graph = FactorGraph(video, networks, correlation=correlation, threads=threads)
    new = range(count, count + len(frames))
    graph.add([*zip(before.tolist(), new), *zip(after.tolist(), new)])
    for _ in range(_UPDATES):
        solution = graph.update(count, motion_only=True)
        if solution.failure:
            stats.count("failed bundle adjustments")
            stats.warn(f"frames between keyframes have no pose: {solution.failure}")
            break
    found = np.stack([frame.cam_from_world for frame in video.frames[count:]])
    if solution.failure:
        found[:] = np.nan
    del video.frames[count:]
    return found


def between(a: VideoFrame, b: VideoFrame, timestamp: float) -> np.ndarray:
    """cam_from_world (4, 4) at a time on the screw motion from a to b; a's beyond the last keyframe."""
    if a is b:
        return a.cam_from_world.copy()
    share = (timestamp - a.timestamp) / max(b.timestamp - a.timestamp, 1e-9)
    twist = geometry.se3_log(b.cam_from_world @ geometry.inverse(a.cam_from_world))
    return np.asarray(geometry.se3_exp(share * twist) @ a.cam_from_world)


__all__ = ["StoredFrame", "between", "fill"]
