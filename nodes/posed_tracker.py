"""Frame, GroundTruth -> Keyframe, TrackedFrame, Poses, Trajectory: poses that are given, a data set's or a robot's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Frame, GroundTruth, Keyframe, Poses, Request, TrackedFrame, TrackingState, Trajectory
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.config import PosedConfig
from mvsgs_core.tracking.estimation.rolling_shutter import camera_velocity
from mvsgs_core.tracking.matching.flow import check_flow
from mvsgs_core.tracking.posed import PosedTracker as CoreTracker
from mvsgs_core.tracking.publish import affine_of, changed_vignetting, differ
from mvsgs_core.trajectory import velocities
from nodes import Node
from nodes.catching_up import PASSED_OVER
from nodes.tracked_messages import keyframe_message, tracked_frame_message
from nodes.tracking import keep_place, places_of, refused, warn_of_guessed_focal


class PosedTracker(Node):
    """The two inputs are joined by index, in whatever order they come; scale is always 1. A live stream's frames may
    be overtaken: what came with them is forgotten.

    Poses say what exposures and vignetting are now: the poses in them stay.
    """

    @dataclass(frozen=True)
    class Config(PosedConfig):
        realtime: bool = False  # of the frames that wait, the newest alone

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._core: CoreTracker | None = None  # from the first frame with a pose on
        self._frames: dict[int, Frame] = {}  # without their truth yet, or keyframes that are not complete
        self._given: dict[int, np.ndarray | None] = {}  # poses (4, 4) without their frames yet
        self._joined: dict[int, tuple[float, np.ndarray]] = {}  # timestamp and pose (4, 4), NaN where there is none
        self._keyframes: dict[int, np.ndarray | None] = {}  # with the exposure (3, 4) that was sent
        self._known: dict[int, object] = {}  # of the same, what their exposures were made of when they were looked at
        self._vignetting: np.ndarray | None = None  # (3,) that was sent
        self._places: dict[int, np.ndarray] = {}  # by GPS
        self._revision = 0

    @classmethod
    def check(cls, config: Config) -> None:
        check_flow(config.flow)

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame]:
        self._frames[frame.index] = frame
        for overtaken in [index for index in self._given if index < frame.index]:  # of a live stream
            del self._given[overtaken]
        keep_place(self._places, frame)
        warn_of_guessed_focal(self.stats, frame)
        if frame.index in self._given:
            yield from self._join(frame.index)

    def on_ground_truth(self, truth: GroundTruth) -> Iterator[Keyframe | Poses | TrackedFrame]:
        self._given[truth.index] = truth.world_from_cam
        if truth.index in self._frames:
            yield from self._join(truth.index)

    def on_request(self, request: Request) -> Iterator[Request]:
        yield refused(request, type(self))

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | Trajectory]:
        if self._core is not None:
            yield from self._complete(self._core, self._core.finish())
            self.stats.include(self._core.stats)
        else:
            self.stats.nothing(
                f"no frame came with a true pose, of {len(self._joined)} frames: tracker=dense needs none"
            )
        newest = max(self._joined, default=-1)
        if any(index > newest for index in self._given) or self._frames.keys() - self._joined.keys():
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
        exposures = {} if self._core is None else self._core.exposures()
        unknown = np.full((3, 4), np.nan, np.float32)
        yield Trajectory(
            index=np.array(order, np.int64),
            timestamp=np.array([self._joined[index][0] for index in order], np.float64),
            world_from_cam=poses,
            keyframe=np.isin(order, list(self._keyframes)),
            state=np.where(known, TrackingState.TRACKED, TrackingState.LOST).astype(np.uint8),
            segment=np.where(known, 0, -1).astype(np.int32),
            readout_time=self.config.readout_time,
            reads_columns=self.config.reads_columns,
            exposure=np.stack([exposures.get(i, unknown) for i in order]) if exposures else None,
            vignetting=None if self._core is None else self._core.photometer.vignetting,
            places=places_of(np.array(order, np.int64), self._places),
        )

    def _join(self, index: int) -> Iterator[Keyframe | Poses | TrackedFrame]:
        frame, pose = self._frames[index], self._given.pop(index)
        if self.config.realtime and max(self._frames) > index:
            self.stats.skip(PASSED_OVER)
            del self._frames[index]
            return
        self._joined[index] = (frame.timestamp, np.full((4, 4), np.nan) if pose is None else pose)
        if pose is None:
            self.stats.skip("frames without a true pose")
            self.stats.warn("frames without a true pose were left out")
            del self._frames[index]
            return
        if self._core is None:
            self._core = CoreTracker(self.config, frame.image.shape[:2], frame.intrinsics)
        done = self._core.add(index, frame.timestamp, frame.image, pose, frame.exposure, frame.mask)
        yield from self._complete(self._core, done)
        for old in (self._frames.keys() & self._joined.keys()) - self._core.pending:
            del self._frames[old]
        self.stats.include(self._core.stats)

    def _complete(self, core: CoreTracker, keyframes: list[int]) -> Iterator[Keyframe | Poses | TrackedFrame]:
        for index in keyframes:
            yield self._keyframe(core, index)
            yield from self._exposed(core)
            for found in core.between(index):
                self.stats.count("frames between keyframes")
                yield self._between(found)

    def _between(self, found: Between) -> TrackedFrame:
        frame = self._frames[found.index]
        readout_time, reads_columns = self.config.readout_time, self.config.reads_columns
        velocity = self._velocity(frame.index) if readout_time else None
        return tracked_frame_message(frame, found, frame.intrinsics, 1.0, velocity, readout_time, reads_columns)

    def _velocity(self, index: int) -> np.ndarray | None:
        """(6,) between the poses before and after a frame; None where no neighbor tells it."""
        order = sorted(self._joined)
        place = order.index(index)
        near = [self._joined[n] for n in order[max(place - 1, 0) : place + 2]]
        poses = np.stack([pose for _, pose in near])
        known = np.isfinite(poses).all(axis=(1, 2))
        velocity = velocities(np.array([at for at, _ in near]), poses, known)[place - max(place - 1, 0)]
        return velocity if velocity.any() else None

    def _keyframe(self, core: CoreTracker, index: int) -> Keyframe:
        frame, keyframe, light = self._frames[index], core.keyframe(index), core.photometer
        self._keyframes[index] = light.exposure(index)
        readout_time, reads_columns = self.config.readout_time, self.config.reads_columns
        velocity = camera_velocity(keyframe, core.graph.intrinsics) if readout_time else None
        return keyframe_message(
            frame, keyframe, frame.intrinsics, self._joined[index][1], self._keyframes[index], light.vignetting,
            velocity, readout_time, reads_columns,
        )  # fmt: skip

    def _exposed(self, core: CoreTracker) -> Iterator[Poses]:
        """What the light of the keyframes sent is now, where it changed."""
        light = core.photometer
        vignetting = changed_vignetting(light.vignetting, self._vignetting)
        known = {index: light.known(index) for index in self._keyframes}
        asked = [i for i in known if vignetting is not None or known[i] is not self._known.get(i)]  # of thousands few
        self._known, now = known, {index: light.exposure(index) for index in asked}
        changed = [i for i, exposure in now.items() if vignetting is not None or differ(exposure, self._keyframes[i])]
        if not changed:
            return
        self._revision += 1
        self._keyframes.update({index: now[index] for index in changed})
        self._vignetting = self._vignetting if vignetting is None else vignetting
        yield Poses(
            self._revision,
            np.array(changed, np.int64),
            np.stack([self._joined[index][1] for index in changed]),
            np.ones(len(changed)),
            exposure=np.stack([affine_of(now[index]) for index in changed]),
            vignetting=vignetting,
        )
