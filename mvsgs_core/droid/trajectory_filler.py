"""Poses of the frames between keyframes: interpolated, then refined against both (DROID-SLAM, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.droid.config import CorrelationKind
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.networks import Networks
from mvsgs_core.droid.video import Video, VideoFrame
from mvsgs_core.frame_store import FrameStore
from mvsgs_core.stats import Stats

BATCH = 16  # frames solved together
_UPDATES = 6  # motion only


@dataclass(frozen=True)
class StoredFrame:
    """A frame of the stream, whose image as the networks see it lies in a file: all are needed again at the end."""

    index: int
    timestamp: float  # seconds
    store: FrameStore

    def put(self, image: np.ndarray) -> None:
        """Stores its image (8h, 8w, 3) uint8. Raises OSError where the disk takes no more."""
        self.store.put(self.index, {"image": image})

    @property
    def is_there(self) -> bool:
        """Whether the disk took it."""
        return self.index in self.store

    @property
    def image(self) -> np.ndarray:
        image = self.store.get(self.index, "image")
        assert image is not None, "the disk did not take it"
        return image


def fill(
    video: Video,
    networks: Networks,
    frames: Sequence[StoredFrame],
    correlation: CorrelationKind,
    threads: int,
    stats: Stats,
) -> np.ndarray:
    """cam_from_world (N, 4, 4) of N frames that are no keyframes, none before the first keyframe.

    NaN where no bundle adjustment could be done: a pose that was only interpolated is none.
    """
    poses = [np.zeros((0, 4, 4))]
    for start in range(0, len(frames), BATCH):
        batch = frames[start : start + BATCH]
        count = len(video)
        before, after = video.around([frame.index for frame in batch])
        for frame, features, a, b in zip(batch, networks.features([f.image for f in batch]), before, after):
            pose = between(video.frames[a], video.frames[b], frame.timestamp)
            depth = np.ones_like(video.frames[a].inverse_depth)
            video.append(VideoFrame(frame.index, frame.timestamp, pose, depth, features))
        graph = FactorGraph(video, networks, correlation=correlation, threads=threads)
        new = range(count, len(video))
        graph.add([*zip(before.tolist(), new), *zip(after.tolist(), new)])
        for _ in range(_UPDATES):
            solution = graph.update(count, motion_only=True)
            if solution.failure:
                stats.count("failed bundle adjustments")
                stats.warn(f"frames between keyframes have no pose: {solution.failure}")
                break
        found = np.stack([frame.cam_from_world for frame in video.frames[count:]])
        poses.append(np.full_like(found, np.nan) if solution.failure else found)
        while len(video) > count:
            video.remove(-1)
    return np.concatenate(poses)


def between(a: VideoFrame, b: VideoFrame, timestamp: float) -> np.ndarray:
    """cam_from_world (4, 4) at a time on the screw motion from a to b; a's beyond the last keyframe."""
    if a is b:
        return a.cam_from_world.copy()
    fraction = (timestamp - a.timestamp) / max(b.timestamp - a.timestamp, 1e-9)
    return geometry.interpolate(a.cam_from_world, b.cam_from_world, fraction)


__all__ = ["StoredFrame", "between", "fill"]
