"""Frame, GroundTruth -> Keyframe, Trajectory: true poses, so that the later stages can be measured alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Frame, GroundTruth, Keyframe, TrackingState, Trajectory
from mvsgs_core.tracking.coarse_depth import coarse_map
from mvsgs_core.tracking.estimation.rolling_shutter import check_readout_time, rectified
from mvsgs_core.tracking.keyframe_choice import KeyframeChoiceConfig
from mvsgs_core.tracking.local_map import LocalMapConfig
from mvsgs_core.tracking.posed import PosedConfig
from mvsgs_core.tracking.posed import PosedTracker as Core
from nodes import Node


class PosedTracker(Node):
    """The two inputs are joined by index, in whatever order they come; scale is always 1."""

    @dataclass
    class Config:
        area: int = 320 * 240  # pixels of the tracker's own image, aspect kept; at most twice enlarged
        flow: str = "lucas_kanade"  # lucas_kanade, dis, features, raft_small, or module:Class
        keyframe_flow: float = 0.05  # of the width: median flow that makes a keyframe
        keyframe_fraction: float = 0.5  # of the textured points: fewer found make a keyframe
        recent: int = 3  # keyframes before a new one that it is matched with
        proximity: int = 3  # older keyframes that it is matched with
        steps: int = 5  # of the triangulation
        readout_time: float = (
            0.0  # seconds of the camera's rolling shutter, 0 for a global one: true poses do not tell it
        )
        threads: int | None = None  # of the C++ kernels; null: 1

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c = self.config
        check_readout_time(c.readout_time)
        self._tracker = Core(
            PosedConfig(
                area=c.area,
                flow=c.flow,
                readout_time=c.readout_time,
                threads=c.threads or 1,
                keyframe_choice=KeyframeChoiceConfig(c.keyframe_flow, c.keyframe_fraction),
                local_map=LocalMapConfig(recent=c.recent, proximity=c.proximity, steps=c.steps),
            )
        )
        self._frames: dict[int, Frame] = {}  # without their truth yet, or keyframes that are not complete
        self._truths: dict[int, GroundTruth] = {}  # without their frames yet
        self._path: dict[int, tuple[float, np.ndarray | None]] = {}
        self._keyframes: set[int] = set()

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        self._frames[frame.index] = frame
        if frame.intrinsics_guessed:
            self.stats.warn(
                "the focal length is a guess, which this tracker takes for true: tracker=dense estimates it"
            )
        if frame.index in self._truths:
            yield from self._join(frame.index)

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[Keyframe]:
        self._truths[truth.index] = truth
        if truth.index in self._frames:
            yield from self._join(truth.index)

    def on_end(self) -> Iterator[Keyframe | Trajectory]:
        for index in self._tracker.finish():
            yield self._keyframe(index)
        if self._truths or any(index not in self._path for index in self._frames):
            self.stats.warn("some frames came without ground truth, or ground truth without a frame")
        if len(self._keyframes) < 2 <= len(self._path):
            self.stats.warn(
                f"the {len(self._path)} frames gave {len(self._keyframes)} keyframe, and depth needs two: the camera "
                f"moves too little for tracker.keyframe_flow={self.config.keyframe_flow:g}; lower it"
            )
        self._report()
        if not any(pose is not None for _, pose in self._path.values()):
            self.stats.nothing(f"no frame came with a true pose, of {len(self._path)} frames: tracker=dense needs none")
        order = sorted(self._path)
        n = len(order)
        poses = np.full((n, 4, 4), np.nan)
        for k, index in enumerate(order):
            pose = self._path[index][1]
            if pose is not None:
                poses[k] = pose
        known = np.isfinite(poses).all(axis=(1, 2))
        yield Trajectory(
            index=np.array(order, np.int64).reshape(n),
            timestamp=np.array([self._path[index][0] for index in order], np.float64).reshape(n),
            world_from_cam=poses,
            keyframe=np.array([index in self._keyframes for index in order], bool).reshape(n),
            state=np.where(known, TrackingState.TRACKED, TrackingState.LOST).astype(np.uint8),
            segment=np.where(known, 0, -1).astype(np.int32),
            readout_time=self.config.readout_time,
        )

    def _join(self, index: int) -> Iterator[Keyframe]:
        frame, truth = self._frames[index], self._truths.pop(index)
        pose = truth.world_from_cam
        self._path[index] = (frame.timestamp, pose)
        if pose is None:
            self.stats.skip("frames without a true pose")
            self.stats.warn("frames without a true pose were left out")
            del self._frames[index]
            return
        complete = self._tracker.add(index, frame.timestamp, frame.image, frame.intrinsics, pose)
        for done in complete:
            yield self._keyframe(done)
        for old in [i for i in self._frames if i in self._path and i not in self._tracker.pending]:
            del self._frames[old]
        self._report()

    def _keyframe(self, index: int) -> Keyframe:
        frame, pose = self._frames[index], self._path[index][1]
        assert pose is not None
        self._keyframes.add(index)
        keyframe = self._tracker.keyframe(index)
        inverse_depth, weight = coarse_map(keyframe)
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=rectified(frame.image, keyframe.image, self.config.readout_time),
            intrinsics=frame.intrinsics,
            world_from_cam=np.asarray(pose, dtype=np.float64),
            scale=1.0,
            inverse_depth=inverse_depth,
            inverse_depth_weight=weight,
            segment=0,
        )

    def _report(self) -> None:
        self.stats.include(self._tracker.stats)
