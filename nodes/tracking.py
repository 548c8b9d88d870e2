"""What every tracker that finds its own poses does with messages: frames are kept while they may become keyframes."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np

from msgs import Asked, CameraPose, Frame, Keyframe, Poses, Request, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core.geodesy import is_place
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.tracking.settling import Settling
from mvsgs_core.tracking.steps import Steps
from mvsgs_core.trajectory import TrackingState
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes import Node
from nodes.one_camera import OneCamera

POSE = "frame to pose"  # the latency
PERIOD = 1.0  # s between two TrackerPhase of a live stream
SLICE = 0.005  # s of a keyframe's work, about, between two looks for a frame: looking costs a tenth of that


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


def keep_place(places: dict[int, np.ndarray], frame: Frame) -> None:
    """What can be no place, as a receiver without a fix sends it, is none."""
    if frame.place is not None and is_place(frame.place):
        places[frame.index] = frame.place.copy()  # a view would keep the whole frame


def places_of(index: np.ndarray, places: dict[int, np.ndarray]) -> np.ndarray | None:
    """(N, 3) of frames `index` (N,), as `Trajectory` has them."""
    unknown = np.full(3, np.nan)
    return np.stack([places.get(int(i), unknown) for i in index]) if places and len(index) else None


def refused(request: Request, tracker: type[Node]) -> Request:
    """Passed on by a tracker that can only be paused."""
    if request.problem or request.asked == Asked.PAUSE:
        return request
    return replace(request, problem=f"{tracker.__name__} cannot: start the run with tracker=dense")


class TrackerNode(Node, ABC):
    """A subclass makes the tracker of the core, gives it frames and describes a keyframe."""

    core: CoreTracker
    one_camera: ClassVar[bool] = True  # of all frames: what their intrinsics differ by is taken out of their images

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._camera = OneCamera()
        self._frames: dict[int, Frame] = {}  # those that may still be sent
        self._places: dict[int, np.ndarray] = {}  # by GPS, of the frames that have one
        self._revision = 0
        self._phase = Phase.INITIALIZING  # that was sent last
        self._told = 0.0  # when, by time.monotonic
        # what is done as there is time, in a live stream:
        self._work: Steps[Update] | None = None  # what a keyframe takes
        self._worked = False  # some of it was done since the last frame
        self._later: Settling | None = None  # the frames before the keyframe whose work is done

    @abstractmethod
    def _add(self, frame: Frame) -> Update: ...

    @abstractmethod
    def _keyframe(self, index: int) -> Keyframe: ...

    @property
    def _focal_factor(self) -> float:
        """Focal length found, over the one that was given."""
        return 1.0

    @property
    def _distortion(self) -> np.ndarray | None:
        """k1, k2 of the frames, which were taken out of the keyframes' images."""
        return None

    @property
    def _readout_time(self) -> float:
        """Seconds of the rolling shutter that was taken out of the keyframes' images."""
        return 0.0

    @property
    def _reads_columns(self) -> bool:
        """Whether that is the time of its columns, not of its rows."""
        return False

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        if self.one_camera:
            frame = self._camera.frame(frame, self.stats)
        self._frames[frame.index] = frame
        keep_place(self._places, frame)
        update = self._add(frame)
        if CameraPose not in self.unread and (pose := self._camera_pose(frame)) is not None:
            yield pose  # first: who waits for it steers by it
        if update.state in (TrackingState.TRACKED, TrackingState.DEGENERATE):
            self.stats.arrived(POSE, frame.captured)
        yield from self._send_live(update) if self._live else self._send(update.whole())
        due = frame.captured > 0.0 and time.monotonic() - self._told >= PERIOD
        if self.core.phase != self._phase or due:
            self._phase, self._told = self.core.phase, time.monotonic()
            latency = np.array(self.stats.latency(POSE)[0]) if frame.captured > 0.0 else None
            yield TrackerPhase(frame.index, frame.timestamp, self._phase.value, latency)

    def on_request(self, request: Request) -> Iterator[Keyframe | Poses | TrackedFrame | Request]:
        yield refused(request, type(self))

    def on_idle(self) -> list[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase] | None:
        if self._work is not None:
            return list(self._work_for(SLICE))
        if self._later is None:
            return None
        return [] if self._later.step() else list(self._settled())

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase | Trajectory]:
        yield from self._work_for(np.inf)
        while self._later is not None and self._later.step():
            pass
        yield from self._settled()
        for update in self.core.finish():
            yield from self._send(update)
        self._report()
        if self.core.nothing:
            self.stats.nothing(self.core.nothing)
        trajectory = self.core.trajectory()
        found: dict[str, Any] = {"focal_factor": self._focal_factor, "readout_time": self._readout_time}
        found["reads_columns"], found["in_order"] = self._reads_columns, self.in_stream_order
        known = {"places": places_of(trajectory.index, self._places), "distortion": self._distortion}
        yield Trajectory(**vars(trajectory) | found | known)

    @property
    def _live(self) -> bool:
        """Whether the next frame is not to wait for what can be done later."""
        return False

    @property
    def _late(self) -> bool:
        """Whether the camera may be lost before there is time for the work on a keyframe."""
        return False

    def _send_live(self, update: Update) -> Iterator[Keyframe | Poses | TrackedFrame]:
        """What is left to do is done as there is time, but some of it with every frame that comes meanwhile."""
        yield from self._send(update)
        if update.rest is not None:
            yield from self._settled()
            self._work = update.rest
        elif not self._worked:
            yield from self._work_for(SLICE)
        self._worked = False
        while self._late and self._work is not None:
            yield from self._work_for(SLICE)

    def _work_for(self, seconds: float) -> Iterator[Keyframe | Poses | TrackedFrame]:
        """The work on a keyframe goes on for about so long; what comes of it is sent when it is done."""
        until = time.monotonic() + seconds
        while self._work is not None:
            self._worked = True
            try:
                next(self._work)
            except StopIteration as done:
                update: Update = done.value
                self._work, self._later = None, update.later
                yield from self._send(update)
                if update.rest is not None:
                    yield from self._settled()
                    self._work = update.rest
            if time.monotonic() >= until:
                return

    def _settled(self) -> Iterator[Keyframe | Poses | TrackedFrame]:
        """The last keyframe, with all the work on it, and the frames before it with the poses that they have by now."""
        yield from self._work_for(np.inf)
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
        if update.correction is not None:  # first: stereo looks at the new keyframes and at those around them at once
            self._revision += 1
            yield Poses(self._revision, **vars(update.correction))
        for index in update.keyframes:
            yield self._keyframe(index)
        yield from self._frames_between(update.between)
        needed = self.core.pending | (set() if self._later is None else self._later.frames)
        for index in self._frames.keys() - needed:
            del self._frames[index]
        self.stats.values["tracking"] = self.core.phase.value
        self._report()

    def _report(self) -> None:
        self.stats.include(self.core.stats)
