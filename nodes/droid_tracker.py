"""Frame -> Keyframe, Poses, TrackerPhase, Trajectory: DROID-SLAM (mvsgs_core.droid); needs its published weights."""

from __future__ import annotations

from dataclasses import dataclass

from msgs import Frame, Keyframe
from mvsgs_core import geometry
from mvsgs_core.droid import networks
from mvsgs_core.droid.config import DroidConfig
from mvsgs_core.droid.system import DroidSlam
from mvsgs_core.tracking.publish import Update
from nodes.tracking import TrackerNode, warn_of_guessed_focal


class DroidTracker(TrackerNode):
    """Learned tracking as published in 2021; see mvsgs_core.droid."""

    @dataclass(frozen=True)
    class Config(DroidConfig):
        pass

    config: Config
    core: DroidSlam

    @classmethod
    def check(cls, config: Config) -> None:
        networks.check(config.weights)

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.core = DroidSlam(self.config)
        self._report()

    def _add(self, frame: Frame) -> Update:
        warn_of_guessed_focal(self.stats, frame)
        if frame.mask is not None:
            self.stats.warn("DROID-SLAM tracks on whole images: masks are left out of the map alone")
        return self.core.add(frame.index, frame.timestamp, frame.image, frame.intrinsics)

    def _keyframe(self, index: int) -> Keyframe:
        frame, coarse = self._frames[index], self.core.coarse_map(index)
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=frame.image,
            intrinsics=frame.intrinsics,
            world_from_cam=geometry.inverse(self.core.keyframe(index).cam_from_world),
            scale=1.0,
            inverse_depth=coarse.inverse_depth,
            inverse_depth_weight=coarse.weight,
            segment=0,
            captured=frame.captured,
            stamp=frame.stamp,
            mask=frame.mask,
        )
