"""The tracker: images in; keyframes, corrected poses and the whole trajectory out.

All of it happens in `add` (see session.py), in bounded portions: the same frames always give the same poses, however
fast they come; `finish` adds what needs the whole stream.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mvsgs_core.camera import same_intrinsics, scale_intrinsics
from mvsgs_core.devices import resolve_device
from mvsgs_core.held_out import is_held_out
from mvsgs_core.kept_map import NOTHING_MAPPED
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.assessment import tell_what_moves, warn_of_few_matches, warn_of_gaps
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, check_device
from mvsgs_core.tracking.frames import record_of, seen_pose, solve_trajectory
from mvsgs_core.tracking.frozen_session import FrozenSession
from mvsgs_core.tracking.going_on import go_on
from mvsgs_core.tracking.graph import Keyframe
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.keyframe_choice import HELD_OUT
from mvsgs_core.tracking.known_map import KnownMap, save
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.tracking.session import Session
from mvsgs_core.trajectory import TrackingState, Trajectory

NOT_FOUND = (
    "the camera was not found at once in the map to go on in: a part of its own was begun, which is joined to it where "
    "the camera comes by"
)
NOWHERE = "the camera was found in the map in no frame: is it the place that the map shows?"
SPARED = "keyframes, about: farther apart, as the tracker took more than its share of time"


class NewestPose(NamedTuple):
    """Where the camera is, in the map as it is now."""

    world_from_cam: np.ndarray  # (4, 4)
    segment: int  # part of the map
    world_from_previous: np.ndarray | None  # (4, 4) of the frame before; None: it has no pose in that part
    confidence: float  # 0 to 1, see `msgs`


class Tracker:
    def __init__(
        self,
        config: TrackerConfig | None = None,
        clock: Callable[[], float] = time.perf_counter,
        known: KnownMap | None = None,
        frozen: bool = False,
        stats: Stats | None = None,
    ) -> None:
        """clock: what the stages are timed with, in seconds. known: a map to go on in; None: a new one. frozen: the map
        stays as it is, frames are only found in it. stats: those of a tracker before, which are counted on.

        Raises ValueError where there is no such device.
        """
        config = config or TrackerConfig()
        self.config = replace(config, device=resolve_device(config.device))
        check_device(self.config.device)
        self.stats = Stats(clock=clock) if stats is None else stats
        self.nothing = "no frame came"  # why there is no pose at all, after `finish`; empty where there is one
        self._known, self._frozen = known, frozen
        self._seeking = known is not None  # the camera was not found in it yet, and no other map was begun
        self._session: Session | None = None  # from the first frame on
        self._trajectory = Trajectory.empty()

    @property
    def session(self) -> Session:
        """The parts at work. Raises RuntimeError before the first frame."""
        if self._session is None:
            raise RuntimeError("there is no session before the first frame")
        return self._session

    @property
    def phase(self) -> Phase:
        """What the tracker is doing."""
        return Phase.INITIALIZING if self._session is None else self._session.phase

    @property
    def frozen(self) -> bool:
        """Whether frames are only found in the map."""
        return self._frozen

    @property
    def mapped(self) -> bool:
        """Whether there is a map to keep."""
        return self._session is not None and bool(self._session.publisher.published)

    @property
    def pending(self) -> set[int]:
        """Frames that may still go out, as keyframes or between them: their images are needed until then."""
        return set() if self._session is None else self._session.pending

    @property
    def late(self) -> bool:
        """Whether the `rest` of a keyframe must go on at once: its next frame may be lost without."""
        return self._session is not None and self._session.late

    @property
    def focal_factor(self) -> float:
        """What the focal lengths that came with the frames are to be multiplied with; 1 unless they were a guess."""
        return 1.0 if self._session is None else self._session.calibration.focal_factor

    @property
    def readout_time(self) -> float:
        """Seconds that the camera's rolling shutter needs for an image, as far as it is known; 0: global."""
        return 0.0 if self._session is None else self._session.graph.readout_time

    @property
    def reads_columns(self) -> bool:
        """Whether that is the time of its columns, not of its rows."""
        return self._session is not None and self._session.graph.reads_columns

    def keyframe(self, index: int) -> Keyframe:
        return self.session.graph.keyframes[index]

    def scale(self, index: int) -> float:
        """Of a published keyframe: its depths now over those when it was published."""
        return self.session.publisher.scale(index)

    def exposure(self, index: int) -> np.ndarray | None:
        """(3, 4) float32 color affine of a keyframe, see `msgs`; None: the identity, or not known."""
        return self.session.photometer.exposure(index)

    @property
    def vignetting(self) -> np.ndarray | None:
        """(3,) float32 of all images, see `msgs`; None: there is none."""
        return self.session.photometer.vignetting

    def newest_pose(self) -> NewestPose | None:
        """Of the frame that was added last; None where the camera is not seen in the map."""
        session = self._session
        if session is None or session.phase is not Phase.TRACKING:
            return None
        newest = len(session.records) - 1
        seen = seen_pose(session.records, newest, session.graph)
        if seen is None:
            return None
        before = seen_pose(session.records, newest - 1, session.graph) if newest else None
        same_part = before is not None and before[1] == seen[1]
        record = session.records[newest]
        if record.same_as is not None:
            record = record_of(session.records, record.same_as)
        confidence = 1.0 if record.index in session.graph.keyframes else record.found_percent / 100  # all of its own
        return NewestPose(*seen, before[0] if before is not None and same_part else None, confidence)

    def trajectory(self) -> Trajectory:
        """Every frame's pose and exposure, after `finish`."""
        return self._trajectory

    def begin(
        self, size: tuple[int, int], intrinsics: np.ndarray, guessed: bool = False, original: np.ndarray | None = None
    ) -> Session:
        """A stream of frames (height, width) with intrinsics (4,); the first frame does it, where nobody did before.

        original: see `follow`.

        Raises BadFileError for another camera than that of the map to go on in.
        """
        kind = FrozenSession if self._frozen else Session
        session = kind(self.config, self.stats, size, intrinsics, guessed)
        if original is not None:
            session.calibration.original = np.array(original, np.float64)
        if self._known is not None:
            with self.stats.time("taking up the map"):
                go_on(session, self._known, size)
            self._known = None
        self._session = session
        return session

    def freeze(self) -> None:
        """From the next frame on, frames are only found in the map there is. Raises ValueError where there is none."""
        if not self._frozen and not self.mapped and self._known is None:
            raise ValueError(NOTHING_MAPPED)
        if not self._frozen and self._session is not None:
            self._session = FrozenSession.of(self._session)
        self._frozen = True

    def thaw(self) -> None:
        """From the next frame on, the map grows."""
        if isinstance(self._session, FrozenSession):
            self._session = self._session.thawed()
        self._frozen = False

    def keep_map(self, file: Path) -> None:
        """Writes the map as it is, for another stream to go on in. Raises OSError; ValueError where there is none."""
        if self._session is None:
            raise ValueError("there is no keyframe to keep a map of")
        save(file, self._session.graph, self._session.publisher, self.vignetting)

    def add(
        self,
        index: int,
        timestamp: float,
        image: np.ndarray,
        intrinsics: np.ndarray,
        guessed: bool = False,
        exposure: float = 0.0,
        mask: np.ndarray | None = None,
        original: np.ndarray | None = None,
    ) -> Update:
        """The next frame, and all that becomes of it, see `follow`."""
        return self.follow(index, timestamp, image, intrinsics, guessed, exposure, mask, original).whole()

    def follow(
        self,
        index: int,
        timestamp: float,
        image: np.ndarray,
        intrinsics: np.ndarray,
        guessed: bool = False,
        exposure: float = 0.0,
        mask: np.ndarray | None = None,
        original: np.ndarray | None = None,
    ) -> Update:
        """The next frame: (H, W, 3) uint8 RGB with its intrinsics (4,); indices must grow.

        Its pose is known then; where it becomes a keyframe that is the update's `rest`. Frames may be followed before
        all steps of that are done, and then are none themselves.

        guessed: the focal length is to be estimated; keyframes are published when it is settled, see `focal_factor`.
        exposure: time times gain over the f-number squared, in a unit that the stream keeps; 0: not known.
        mask: (H, W) bool, False where a pixel is to be ignored; None: all count.
        original: intrinsics (4,) of the image before its undistortion and scaling, in whose pixels focal lengths are
        told; None: of this image.
        """
        size = image.shape[0], image.shape[1]
        session = self._session or self.begin(size, intrinsics, guessed, original)
        if not same_intrinsics(intrinsics, scale_intrinsics(session.intrinsics, session.size, size)):
            self.stats.warn("the intrinsics change between frames: the tracker goes on with those of the first")
        with self.stats.time("image"):
            frame = self._image(session, index, timestamp, image, exposure, mask)
        self.stats.count("frames")
        update = session.add(frame)
        if self._seeking and session.phase in (Phase.INITIALIZING, Phase.TRACKING):
            self._seeking = False
            if session.phase is Phase.INITIALIZING:
                self.stats.warn(NOT_FOUND)
        return update

    def follows(self, index: int, timestamp: float, image: np.ndarray, mask: np.ndarray | None = None) -> bool:
        """Whether the camera would be followed to this frame, were it the next, as surely as from frame to frame.

        Of a live stream some of whose frames were passed over; parameters as of `follow`. Nothing changes. False before
        there is a map and where the camera is lost.
        """
        session = self._session
        if session is None or session.phase is not Phase.TRACKING:
            return False
        frame = self._image(session, index, timestamp, image, 0.0, mask)
        return session.front_end.would_follow(frame, with_pose=True)

    def finish(self) -> Iterator[Update]:
        """The stream has ended: last keyframes, global bundle adjustment, every frame's pose, and what to warn of."""
        session = self._session
        if session is None:
            return
        for update in session.last_keyframes():
            yield update.whole()
        graph, stats = session.graph, self.stats
        if not self._frozen:
            with stats.time("global bundle adjustment"):
                for segment in sorted({k.segment for k in graph.keyframes.values()}):
                    if set(session.local_map.members(segment)) <= session.publisher.published:
                        session.back_end.put_right(segment, stats)
        with stats.time("frames without a pose"):
            found = session.recovery.fill_in(session.records)
            solver = Solver(steps=8, threads=self.config.threads or 1)
            trajectory = solve_trajectory(session.records, graph, solver)
        session.photometer.update(at_the_end=not self._frozen)
        exposure = session.photometer.of_frames(session.records, trajectory.posed)
        self._trajectory = replace(trajectory, exposure=exposure, vignetting=session.photometer.vignetting)
        stats.count("frames posed in the end", found)
        stats.count(HELD_OUT, sum(is_held_out(index) for index in graph.keyframes))
        tell_what_moves(stats, graph)
        tracking = session.phase is not Phase.INITIALIZING
        if session.choice.spacing is not None and (spared := round(session.choice.spacing.spared)):
            stats.skip(SPARED, spared)
        stats.counts["matches"] = session.matcher.calls
        stats.counts["matches that needed features"] = session.matcher.feature_calls
        if trajectory.posed.any():
            self.nothing = ""
        elif session.records:
            self.nothing = self._why_nothing(session)
        if self.nothing:
            stats.warn(self.nothing)
        warn_of_gaps(stats, self._trajectory)
        warn_of_few_matches(stats, graph, self.config.min_matches)
        state = TrackingState.TRACKED if tracking else TrackingState.NOT_INITIALIZED
        correction = None if self._frozen else session.publisher.corrections(everything=True)
        if correction is not None and (graph.readout_time != 0.0 or session.calibration.rolled):
            velocity = self._trajectory.velocities_of(correction.index)
            correction = replace(
                correction, velocity=velocity, readout_time=graph.readout_time, reads_columns=graph.reads_columns
            )
        yield Update(state, correction=correction)
        if not self._frozen:  # after what the map waits for
            session.calibration.check(session.local_map.largest())

    def _why_nothing(self, session: Session) -> str:
        """Of a stream no frame of which has a pose."""
        if not session.graph.keyframes:
            return f"tracking never started: {session.initializer.reason}"
        if self._frozen or session.phase is not Phase.INITIALIZING:
            return NOWHERE
        return f"the camera was not found in the map, and no part of its own started: {session.initializer.reason}"

    def _image(
        self, session: Session, index: int, timestamp: float, image: np.ndarray, exposure: float,
        mask: np.ndarray | None,
    ) -> TrackingImage:  # fmt: skip
        color = session.matcher.flow.needs_color
        return TrackingImage.of(index, timestamp, image, session.size, color, exposure, mask)


__all__ = ["Tracker", "TrackerConfig", "Update"]
