"""Frame, GroundTruth -> Keyframe, Trajectory: true poses, so that the later stages can be measured alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Frame, GroundTruth, Keyframe, TrackingState, Trajectory
from mvsgs_core.tracking.coarse_depth import coarse_map
from mvsgs_core.tracking.config import PosedConfig
from mvsgs_core.tracking.estimation.rolling_shutter import rectified
from mvsgs_core.tracking.posed import PosedTracker as CoreTracker
from nodes import Node
from nodes.tracking import warn_of_guessed_focal


class PosedTracker(Node):
    """The two inputs are joined by index, in whatever order they come; scale is always 1."""

    @dataclass(frozen=True)
    class Config(PosedConfig):
        pass

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._core: CoreTracker | None = None  # from the first frame with a pose on
        self._frames: dict[int, Frame] = {}  # without their truth yet, or keyframes that are not complete
        self._truths: dict[int, GroundTruth] = {}  # without their frames yet
        self._joined: dict[int, tuple[float, np.ndarray]] = {}  # timestamp and pose (4, 4), NaN where there is none
        self._keyframes: set[int] = set()

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        self._frames[frame.index] = frame
        warn_of_guessed_focal(self.stats, frame)
        if frame.index in self._truths:
            yield from self._join(frame.index)

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[Keyframe]:
        self._truths[truth.index] = truth
        if truth.index in self._frames:
            yield from self._join(truth.index)

    def on_end(self) -> Iterator[Keyframe | Trajectory]:
        if self._core is not None:
            for index in self._core.finish():
                yield self._keyframe(self._core, index)
            self.stats.include(self._core.stats)
        else:
            self.stats.nothing(
                f"no frame came with a true pose, of {len(self._joined)} frames: tracker=dense needs none"
            )
        if self._truths or self._frames.keys() - self._joined.keys():
            self.stats.warn("some frames came without ground truth, or ground truth without a frame")
        n = len(self._joined)
        if len(self._keyframes) < 2 <= n:
            self.stats.warn(
                f"the {n} frames gave {len(self._keyframes)} keyframe, and depth needs two: the camera moves too "
                f"little for tracker.keyframe_choice.max_flow={self.config.keyframe_choice.max_flow:g}; lower it"
            )
        order = sorted(self._joined)
        poses = np.array([self._joined[index][1] for index in order], np.float64).reshape(n, 4, 4)
        known = np.isfinite(poses).all(axis=(1, 2))
        yield Trajectory(
            index=np.array(order, np.int64),
            timestamp=np.array([self._joined[index][0] for index in order], np.float64),
            world_from_cam=poses,
            keyframe=np.isin(order, list(self._keyframes)),
            state=np.where(known, TrackingState.TRACKED, TrackingState.LOST).astype(np.uint8),
            segment=np.where(known, 0, -1).astype(np.int32),
            readout_time=self.config.readout_time,
        )

    def _join(self, index: int) -> Iterator[Keyframe]:
        frame, pose = self._frames[index], self._truths.pop(index).world_from_cam
        self._joined[index] = (frame.timestamp, np.full((4, 4), np.nan) if pose is None else pose)
        if pose is None:
            self.stats.skip("frames without a true pose")
            self.stats.warn("frames without a true pose were left out")
            del self._frames[index]
            return
        if self._core is None:
            self._core = CoreTracker(self.config, frame.image.shape[:2], frame.intrinsics)
        for done in self._core.add(index, frame.timestamp, frame.image, pose):
            yield self._keyframe(self._core, done)
        for old in (self._frames.keys() & self._joined.keys()) - self._core.pending:
            del self._frames[old]
        self.stats.include(self._core.stats)

    def _keyframe(self, core: CoreTracker, index: int) -> Keyframe:
        frame, keyframe = self._frames[index], core.keyframe(index)
        self._keyframes.add(index)
        inverse_depth, weight = coarse_map(keyframe)
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=rectified(frame.image, keyframe.image, self.config.readout_time),
            intrinsics=frame.intrinsics,
            world_from_cam=self._joined[index][1],
            scale=1.0,
            inverse_depth=inverse_depth,
            inverse_depth_weight=weight,
            segment=0,
        )
