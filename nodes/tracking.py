"""What every tracker that finds its own poses does with messages: frames are kept while they may become keyframes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Protocol

from msgs import CameraPose, Frame, Keyframe, Poses, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes import Node


class CoreTracker(Protocol):
    """The part of a tracker of the core that is the same for all."""

    stats: Stats
    nothing: str  # why no frame has a pose, once the stream has ended; empty where one has

    @property
    def phase(self) -> Phase: ...

    @property
    def pending(self) -> set[int]: ...  # frames that may still be sent, as keyframes or between them

    def finish(self) -> Iterator[Update]: ...

    def trajectory(self) -> CameraTrajectory: ...


def warn_of_guessed_focal(stats: Stats, frame: Frame) -> None:
    """For trackers that do not estimate the focal length."""
    if frame.intrinsics_guessed:
        stats.warn("the focal length is a guess, which this tracker takes for true: tracker=dense estimates it")


class TrackerNode(Node, ABC):
    """A subclass makes the tracker of the core, gives it frames and describes a keyframe."""

    core: CoreTracker

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._frames: dict[int, Frame] = {}  # those that may still be sent
        self._revision = 0
        self._phase = Phase.INITIALIZING  # that was sent last

    @abstractmethod
    def _add(self, frame: Frame) -> Update: ...

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

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        self._frames[frame.index] = frame
        update = self._add(frame)
        if CameraPose not in self.unread and (pose := self._camera_pose(frame)) is not None:
            yield pose  # first: who waits for it steers by it
        yield from self._send(update)
        if self.core.phase != self._phase:
            self._phase = self.core.phase
            yield TrackerPhase(frame.index, frame.timestamp, self._phase.value)

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | Trajectory]:
        for update in self.core.finish():
            yield from self._send(update)
        self._report()
        if self.core.nothing:
            self.stats.nothing(self.core.nothing)
        found = {"focal_factor": self._focal_factor, "readout_time": self._readout_time}
        yield Trajectory(**vars(self.core.trajectory()) | found)

    def _camera_pose(self, frame: Frame) -> CameraPose | None:
        """Of a tracker that knows the pose of a frame as it comes."""
        return None

    def _between(self, found: Between) -> TrackedFrame:
        """Of a tracker that poses frames between keyframes while the stream runs."""
        raise TypeError(f"{type(self).__name__} sends keyframes alone")

    def _send(self, update: Update) -> Iterator[Keyframe | Poses | TrackedFrame]:
        for index in update.keyframes:
            yield self._keyframe(index)
        if update.correction is not None:
            self._revision += 1
            yield Poses(self._revision, **vars(update.correction))
        for found in update.between:
            self.stats.count("frames between keyframes")
            yield self._between(found)
        for index in self._frames.keys() - self.core.pending:
            del self._frames[index]
        self.stats.values["tracking"] = self.core.phase.value
        self._report()

    def _report(self) -> None:
        self.stats.include(self.core.stats)
