"""Frame -> Keyframe, Poses, CameraPose, TrackerPhase, Trajectory: the weight-free tracker (mvsgs_core.tracking)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from msgs import CameraPose, Frame, Keyframe, Poses, TrackedFrame, Trajectory
from mvsgs_core import geometry
from mvsgs_core.kept_map import STREAM, check_kept_map, tracker_file
from mvsgs_core.tracking import known_map
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.coarse_depth import coarse_map
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.rolling_shutter import camera_velocity, rectified
from mvsgs_core.tracking.publish import Correction, Update
from mvsgs_core.tracking.tracker import Tracker as CoreTracker
from nodes.tracking import TrackerNode


class Tracker(TrackerNode):
    """Dense bundle adjustment over semi-dense matches; see mvsgs_core.tracking.tracker."""

    @dataclass(frozen=True)
    class Config(TrackerConfig):
        rectify_rolling_shutter: bool = True  # take account of it after the tracker: rectify the images of stereo
        map: str | None = None  # output of a run whose map is gone on with; null: a new map
        output: str | None = None  # folder of the map that is kept
        keep_map: bool = False  # for another run to begin on

    config: Config
    core: CoreTracker
    frozen: ClassVar[bool] = False  # frames are only found in the map

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        known = None if self.config.map is None else known_map.load(tracker_file(self.config.map)).renumbered(STREAM)
        self.core = CoreTracker(self.config, known=known, frozen=self.frozen)
        self._readout_times: list[float] = []  # seconds, what was taken out of each keyframe's image
        self._without_shutter: set[int] = set()  # keyframes that were sent before the readout time was known

    @classmethod
    def check(cls, config: Config) -> None:
        if config.map is not None:
            check_kept_map(config.map)
            known_map.load(tracker_file(config.map))

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | Trajectory]:
        yield from super().on_end()
        if self.config.keep_map and not self.frozen and self.config.output is not None:
            self._keep_map(self.config.output)

    def _keep_map(self, output: str) -> None:
        """A disk that is full costs the map of tomorrow, not today's."""
        try:
            self.core.keep_map(tracker_file(output))
        except (OSError, ValueError) as error:
            self.stats.warn(f"no other run can begin on this map: {error}")

    def _add(self, frame: Frame) -> Update:
        guessed = frame.intrinsics_guessed
        return self.core.follow(frame.index, frame.timestamp, frame.image, frame.intrinsics, guessed, frame.exposure)

    @property
    def _live(self) -> bool:
        return self.config.realtime

    @property
    def _focal_factor(self) -> float:
        return self.core.focal_factor

    @property
    def _readout_time(self) -> float:
        return self.core.readout_time if self.config.rectify_rolling_shutter else 0.0

    def _send(self, update: Update) -> Iterator[Keyframe | Poses | TrackedFrame]:
        if update.correction is not None:
            update = replace(update, correction=self._with_shutter(update.correction))
        yield from super()._send(update)

    def _with_shutter(self, correction: Correction) -> Correction:
        """Corrected keyframes that were sent before the readout time was known get it, and their velocities."""
        if not self.config.rectify_rolling_shutter:
            return replace(correction, velocity=None, readout_time=0.0)
        late = self._without_shutter.intersection(correction.index.tolist()) if self._readout_time else set()
        if correction.velocity is not None or not late:
            return correction
        self._without_shutter -= late
        found = np.full((len(correction.index), 6), np.nan)
        for k, index in enumerate(correction.index.tolist()):
            velocity = self._velocity(index) if index in late else None
            if velocity is not None:
                found[k] = velocity
        return replace(correction, velocity=found, readout_time=self._readout_time)

    def _velocity(self, index: int) -> np.ndarray | None:
        """(6,) of the camera at a keyframe, in the unit of its depths now; None: not known."""
        return camera_velocity(self.core.keyframe(index), self.core.session.graph.intrinsics)

    def _keyframe(self, index: int) -> Keyframe:
        frame, keyframe = self._frames[index], self.core.keyframe(index)
        inverse_depth, weight = coarse_map(keyframe)
        velocity = self._velocity(index) if self._readout_time else None
        if not self._readout_time:
            self._without_shutter.add(index)
        with self.stats.time("rectification"):
            image = rectified(frame.image, keyframe.image, self._readout_time)
        self._readout_times.append(0.0 if keyframe.image.velocity is None else self._readout_time)
        if max(self._readout_times) > 0.0:
            self.stats.values["rolling shutter taken out of keyframes"] = in_milliseconds(self._readout_times)
        if self._readout_time and keyframe.image.velocity is None:
            self.stats.count("keyframes with the rolling shutter still in: no velocity")
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=image,
            intrinsics=self._intrinsics(frame),
            world_from_cam=geometry.inverse(keyframe.cam_from_world),
            scale=1.0,
            inverse_depth=inverse_depth,
            inverse_depth_weight=weight,
            segment=keyframe.segment,
            exposure=self.core.exposure(index),
            vignetting=self.core.vignetting,
            photograph=None if velocity is None else frame.image,
            velocity=velocity,
            readout_time=0.0 if velocity is None else self._readout_time,
            captured=frame.captured,
        )

    def _camera_pose(self, frame: Frame) -> CameraPose | None:
        found = self.core.newest_pose()
        return None if found is None else CameraPose(frame.index, frame.timestamp, **found._asdict())

    def _between(self, found: Between) -> TrackedFrame:
        frame, velocity = self._frames[found.index], found.velocity if self.config.rectify_rolling_shutter else None
        return TrackedFrame(
            index=frame.index,
            timestamp=frame.timestamp,
            image=frame.image,
            intrinsics=self._intrinsics(frame),
            keyframe=found.keyframe,
            keyframe_from_cam=found.keyframe_from_cam,
            scale=self.core.scale(found.keyframe),
            exposure=found.exposure,
            velocity=velocity,
            readout_time=0.0 if velocity is None else self._readout_time,
        )

    def _intrinsics(self, frame: Frame) -> np.ndarray:
        return frame.intrinsics * [self.core.focal_factor, self.core.focal_factor, 1.0, 1.0]


def in_milliseconds(readout_times: list[float]) -> str:
    """What was taken out of the keyframes, seconds: the estimate gets better while they go out."""
    low, mean, high = (1e3 * float(f(readout_times)) for f in (np.min, np.mean, np.max))
    return f"{mean:.1f} ms" if high - low < 0.05 else f"{mean:.1f} ms in the mean, {low:.1f} to {high:.1f}"
