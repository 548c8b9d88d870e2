"""What every tracker that finds its own poses does with messages: frames are kept while they may become keyframes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from msgs import Frame, Keyframe, Poses, Trajectory
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.publish import Correction
from mvsgs_core.tracking.tracker import Update
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes import Node


class CoreTracker(Protocol):
    """The part of a tracker of the core that is the same for all."""

    @property
    def stats(self) -> Stats: ...

    @property
    def pending(self) -> set[int]: ...  # frames that may still be sent as keyframes

    @property
    def nothing(self) -> str: ...  # why no frame has a pose, once the stream has ended; empty where one has

    def finish(self) -> Iterator[Update]: ...

    def trajectory(self) -> CameraTrajectory: ...


class TrackerNode(Node, ABC):
    """A subclass makes the tracker in `_make_tracker`, feeds it in its own `on_frame` and describes a keyframe."""

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._frames: dict[int, Frame] = {}  # those that may still be sent as keyframes
        self._revision = 0

    @property
    @abstractmethod
    def _core(self) -> CoreTracker: ...

    @abstractmethod
    def _keyframe(self, index: int) -> Keyframe: ...

    @property
    def _focal_factor(self) -> float:
        """Focal length found, over the one that was given."""
        return 1.0

    @property
    def _readout_time(self) -> float:
        """Seconds of the rolling shutter that was taken out of the keyframes' images."""
        return 0.0

    def on_end(self) -> Iterator[Keyframe | Poses | Trajectory]:
        for update in self._core.finish():
            yield from self._send(update)
        trajectory = self._core.trajectory()
        self._report()
        if self._core.nothing:
            self.stats.nothing(self._core.nothing)
        yield Trajectory(
            index=trajectory.index,
            timestamp=trajectory.timestamp,
            world_from_cam=trajectory.world_from_cam,
            keyframe=trajectory.keyframe,
            state=trajectory.state,
            segment=trajectory.segment,
            focal_factor=self._focal_factor,
            readout_time=self._readout_time,
        )

    def _send(self, update: Update) -> Iterator[Keyframe | Poses]:
        for index in update.keyframes:
            yield self._keyframe(index)
        if update.correction is not None:
            yield self._poses(update.correction)
        for index in self._frames.keys() - self._core.pending:
            del self._frames[index]
        self.stats.values["tracking"] = update.state.name.lower()
        self._report()

    def _poses(self, correction: Correction) -> Poses:
        self._revision += 1
        return Poses(
            self._revision, correction.index, correction.world_from_cam, correction.scale.astype(np.float64),
            correction.segment,
        )  # fmt: skip

    def _report(self) -> None:
        self.stats.include(self._core.stats)
