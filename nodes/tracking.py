"""What every tracker that finds its own poses does with messages: frames are kept while they may become keyframes."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator
from typing import Any, Protocol

import numpy as np

from msgs import CameraPose, Frame, Keyframe, Poses, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.tracking.settling import Settling
from mvsgs_core.trajectory import TrackingState
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes import Node

POSE = "frame to pose"  # the latency
PERIOD = 1.0  # s between two TrackerPhase of a live stream


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
        self._told = 0.0  # when, by time.monotonic
        self._later: Settling | None = None  # what is done as there is time, in a live stream

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
        if update.state in (TrackingState.TRACKED, TrackingState.DEGENERATE):
            self.stats.arrived(POSE, frame.captured)
        yield from self._send((yield from self._begun(update)) if self._live else update.whole())
        due = frame.captured > 0.0 and time.monotonic() - self._told >= PERIOD
        if self.core.phase != self._phase or due:
            self._phase, self._told = self.core.phase, time.monotonic()
            latency = np.array(self.stats.latency(POSE)[0]) if frame.captured > 0.0 else None
            yield TrackerPhase(frame.index, frame.timestamp, self._phase.value, latency)

    def on_idle(self) -> list[TrackedFrame] | None:
        if self._later is None:
            return None
        return [] if self._later.step() else list(self._settled())

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | Trajectory]:
        while self._later is not None and self._later.step():
            pass
        yield from self._settled()
        for update in self.core.finish():
            yield from self._send(update)
        self._report()
        if self.core.nothing:
            self.stats.nothing(self.core.nothing)
        found = {"focal_factor": self._focal_factor, "readout_time": self._readout_time}
        yield Trajectory(**vars(self.core.trajectory()) | found)

    @property
    def _live(self) -> bool:
        """Whether the next frame is not to wait for what can be done later."""
        return False

    def _begun(self, update: Update) -> Generator[TrackedFrame, None, Update]:
        """With what is to be done before the next frame; what is left of the keyframe before is settled first."""
        if update.rest is not None:
            yield from self._settled()
        update = update.begun()
        if update.later is not None:
            yield from self._settled()
            self._later = update.later
        return update

    def _settled(self) -> Iterator[TrackedFrame]:
        """The frames between keyframes, with the poses that they have by now."""
        later, self._later = self._later, None
        yield from self._frames_between(() if later is None else later.finish())

    def _frames_between(self, found: Iterable[Between]) -> Iterator[TrackedFrame]:
        for frame in found:
            self.stats.count("frames between keyframes")
            yield self._between(frame)

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
        yield from self._frames_between(update.between)
        needed = self.core.pending | (set() if self._later is None else self._later.frames)
        for index in self._frames.keys() - needed:
            del self._frames[index]
        self.stats.values["tracking"] = self.core.phase.value
        self._report()

    def _report(self) -> None:
        self.stats.include(self.core.stats)
