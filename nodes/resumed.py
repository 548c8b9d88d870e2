"""Source: the keyframes of a run's checkpoint, so that its map is refined and scored where the stream is gone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import FusedKeyframe, GroundTruth, Poses, TrackedFrame, TrackingState, Trajectory
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.mapping.checkpoints.keyframes import kept_keyframes
from nodes import Node


class Resumed(Node):
    """Keyframes of a checkpoint -> GroundTruth of each whose image is kept, and their Trajectory.

    Stands for dataset, tracker, mvs and depth_fusion in a graph whose mapper resumes: there is no FusedKeyframe, no
    TrackedFrame and no correction to come, so that it yields none. The images are those that the map is trained on,
    none of them is held-out.
    """

    @dataclass
    class Config:
        path: str | None = None  # output directory of the run

    config: Config
    replayable = True

    @classmethod
    def check(cls, config: Config) -> None:
        if config.path is None:
            raise ValueError("dataset.path is missing: give the output directory of the run")
        checkpoint_info(config.path)

    def run(self) -> Iterator[GroundTruth | Trajectory | FusedKeyframe | TrackedFrame | Poses]:
        keyframes = kept_keyframes(self.config.path or "")
        self.stats.values["frames_expected"] = len(keyframes)
        for keyframe in keyframes:
            with self.stats.time("read"):
                image, mask = keyframe.image(), keyframe.mask()
            if image is None:
                self.stats.skip("keyframes whose image was let go (mapper.max_keyframes)")
                continue
            self.stats.count("frames")
            yield GroundTruth(keyframe.index, keyframe.timestamp, image, keyframe.intrinsics, None, None, mask=mask)
        slowest = max(keyframes, key=lambda keyframe: abs(keyframe.readout_time), default=None)
        yield Trajectory(
            index=np.array([keyframe.index for keyframe in keyframes], dtype=np.int64),
            timestamp=np.array([keyframe.timestamp for keyframe in keyframes], dtype=np.float64),
            world_from_cam=np.array([k.world_from_cam for k in keyframes], dtype=np.float64).reshape(-1, 4, 4),
            keyframe=np.ones(len(keyframes), dtype=np.bool_),
            state=np.full(len(keyframes), TrackingState.TRACKED, dtype=np.uint8),
            segment=np.array([keyframe.segment for keyframe in keyframes], dtype=np.int32),
            exposure=np.array([keyframe.exposure for keyframe in keyframes], dtype=np.float32).reshape(-1, 3, 4),
            velocity=np.array([keyframe.velocity for keyframe in keyframes], dtype=np.float64).reshape(-1, 6),
            readout_time=0.0 if slowest is None else slowest.readout_time,
            reads_columns=slowest is not None and slowest.reads_columns,
        )
