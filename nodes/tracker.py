"""Frame -> Keyframe, Poses, CameraPose, TrackerPhase, Trajectory: the weight-free tracker (mvsgs_core.tracking)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from msgs import Asked, CameraPose, Frame, Keyframe, Poses, Request, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core import geometry
from mvsgs_core.kept_map import NOTHING_MAPPED, STREAM, check_kept_map, check_no_map, tracker_file
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.tracking import known_map
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.rolling_shutter import camera_velocity
from mvsgs_core.tracking.matching.flow import check_flow
from mvsgs_core.tracking.publish import Correction, Update
from mvsgs_core.tracking.tracker import Tracker as CoreTracker
from nodes.catching_up import KEPT, PASSED_OVER, CatchingUp
from nodes.localization_file import LocalizationFile
from nodes.returning import Returning
from nodes.tracked_messages import keyframe_message, tracked_frame_message
from nodes.tracking import TrackerNode

ONLY_LOCALIZES = "this run only localizes: begin one with map=DIR and without mapper=frozen, and switch by localize"


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
    restartable: ClassVar[bool] = True
    missed_kept: ClassVar[int] = KEPT
    only_localizes: ClassVar[bool] = False  # from the start to the end, frames are only found in the map

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        known = None if self.config.map is None else _known(self.config.map)
        self.core = CoreTracker(self.config, known=known, frozen=self.only_localizes)
        self._localized = LocalizationFile(self.config.output, self.stats)
        self._newest: Frame | None = None
        self._catching_up = CatchingUp()
        self._returning: Returning | None = None
        self._readout_times: list[float] = []  # seconds, what was taken out of each keyframe's image
        self._without_shutter: set[int] = set()  # keyframes that were sent before the readout time was known

    @classmethod
    def check(cls, config: Config) -> None:
        check_flow(config.flow)
        if config.map is not None:
            check_kept_map(config.map)
            known_map.load(tracker_file(config.map))

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        self._begin()
        if self._returning is not None and frame.index <= self._returning.newest:
            self.stats.skip("frames that came again")
            return
        self._catching_up.came([*self.missed(Frame), frame])
        yield from self._next_frame()
        self._save_to_return()

    def _next_frame(self) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase]:
        """Of those that wait; what it begins is done at once where others do."""
        frame = self._catching_up.take(self.core.phase, self._follows)
        if self._catching_up.passed_over:
            self.stats.skipped[PASSED_OVER] = self._catching_up.passed_over
        yield from super().on_frame(frame)
        if self.core.frozen:
            self._localized.add(frame, self.core.newest_pose())
        if self._catching_up.behind:
            self.stats.count("frames taken up late")
            yield from self._work_for(np.inf)

    def _follows(self, frame: Frame) -> bool:
        return self.core.follows(frame.index, frame.timestamp, frame.image, frame.mask)

    def on_idle(self) -> list[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase] | None:
        if self._catching_up.behind:
            return list(self._next_frame())
        found = super().on_idle()
        if not found:  # what is saved was sent
            self._save_to_return()
        return found

    def _save_to_return(self) -> None:
        """Where the map is no further than what was sent of it."""
        if self._returning is not None and self._work is None:
            self._returning.save(self.core)

    def _begin(self) -> None:
        """With the first message: this process may be one that was started in another's place."""
        if self.kept_in is None or self._returning is not None:
            return
        returning = self._returning = Returning(self.kept_in, self.stats)
        self._revision = returning.revision
        if returning.returned:
            self._localized.go_on()
        if (known := returning.known()) is not None:
            self.core = CoreTracker(self.config, known=known, frozen=returning.frozen)
        elif returning.another is not None:
            self.core = CoreTracker(self.config)
        elif returning.frozen:
            self.core.freeze()

    def on_request(self, request: Request) -> Iterator[Keyframe | Poses | TrackedFrame | Request]:
        """Between two frames: what is saved is the map as it is there, and what is begun begins there."""
        self._begin()
        if self._returning is not None and request.number == self._returning.another:
            yield request  # met by the process before, which may have ended before it was sent; others pass over it
            return
        if self._returning is not None and request.number in self._returning.met:
            self.stats.skip("requests that came again")
            return
        yield from self._settled()
        if not request.problem and request.asked != Asked.PAUSE:
            try:
                self._meet(request)
            except (OSError, ValueError) as error:
                request = replace(request, problem=str(error))
        if self._returning is not None:
            self._returning.note(request)
        yield request

    def on_end(self) -> Iterator[Keyframe | Poses | TrackedFrame | CameraPose | TrackerPhase | Trajectory]:
        while self._catching_up.behind:
            yield from self._next_frame()
        yield from super().on_end()
        if self.config.keep_map and not self.only_localizes and self.config.output is not None:
            self._keep_map(self.config.output)
        self._localized.close()

    def _keep_map(self, output: str) -> None:
        """A disk that is full costs the map of tomorrow, not today's."""
        try:
            self.core.keep_map(tracker_file(output))
        except (OSError, ValueError) as error:
            self.stats.warn(f"no other run can begin on this map: {error}")

    def _meet(self, request: Request) -> None:
        """Raises OSError and ValueError, saying what to do, where it cannot be done; then nothing has changed."""
        if self.only_localizes and (request.asked in (Asked.SAVE_MAP, Asked.RESET) or _grows(request)):
            raise ValueError(ONLY_LOCALIZES)
        match request.asked:
            case Asked.SAVE_MAP:
                self._save(request.folder)
            case Asked.RESET:
                self._go_on_with(CoreTracker(self.config, stats=self.core.stats), request)
            case Asked.LOAD_MAP:
                self._go_on_with(self._on(request.folder), request)
            case Asked.LOCALIZE if request.on:
                self.core.freeze()
                self._note_mode()
            case Asked.LOCALIZE:
                self.core.thaw()
                self._note_mode()
            case _:
                raise ValueError(f"{request.asked}: no tracker does that")

    def _note_mode(self) -> None:
        if self._returning is not None:
            self._returning.note_mode(self.core.frozen)

    def _on(self, folder: str) -> CoreTracker:
        """A tracker that looks for the camera in a map. Raises ValueError, saying what to do."""
        check_kept_map(folder)
        checkpoint_info(folder)
        if self._newest is None:
            raise ValueError("no frame has come yet: ask again when one has, or begin the run with map=DIR")
        core = CoreTracker(self.config, known=_known(folder), frozen=self.core.frozen, stats=self.core.stats)
        frame = self._newest
        size, guessed = (frame.image.shape[0], frame.image.shape[1]), frame.intrinsics_guessed
        core.begin(size, frame.intrinsics, guessed, frame.original_intrinsics)
        return core

    def _save(self, folder: str) -> None:
        if not self.core.mapped:
            raise ValueError(NOTHING_MAPPED)
        check_no_map(folder, returned=self._returning is not None and self._returning.returned)
        self.core.keep_map(tracker_file(folder))

    def _go_on_with(self, core: CoreTracker, request: Request) -> None:
        """Another map; what is there of the one before is kept, and goes out no more."""
        core.nothing = "no frame came after another map was begun on request"
        if self.core.mapped and not self.only_localizes:
            self._save(request.kept)
            core.nothing += f"; the one before is in {request.kept}"
        self.stats.warn("another map was begun on request: what is reported is the last one")
        self.core = core
        if self._returning is not None:
            self._returning.begin(core, request.number, 0 if self._newest is None else self._newest.index + 1)
            self._returning.note_mode(core.frozen)
        self._catching_up.forget()
        self._frames.clear()
        self._readout_times.clear()
        self._without_shutter.clear()

    def _add(self, frame: Frame) -> Update:
        self._newest = frame
        return self.core.follow(
            frame.index, frame.timestamp, frame.image, frame.intrinsics, frame.intrinsics_guessed, frame.exposure,
            frame.mask, frame.original_intrinsics,
        )  # fmt: skip

    @property
    def _live(self) -> bool:
        return self.config.realtime

    @property
    def _late(self) -> bool:
        return self.core.late

    @property
    def _focal_factor(self) -> float:
        return self.core.focal_factor

    @property
    def _readout_time(self) -> float:
        return self.core.readout_time if self.config.rectify_rolling_shutter else 0.0

    @property
    def _reads_columns(self) -> bool:
        return self.core.reads_columns

    def _send(self, update: Update) -> Iterator[Keyframe | Poses | TrackedFrame]:
        if update.correction is not None:
            update = replace(update, correction=self._with_shutter(update.correction))
        for message in super()._send(update):
            if self._returning is not None:
                self._returning.note(message)
            yield message

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
        return replace(correction, velocity=found, readout_time=self._readout_time, reads_columns=self._reads_columns)

    def _velocity(self, index: int) -> np.ndarray | None:
        """(6,) of the camera at a keyframe, in the unit of its depths now; None: not known."""
        return camera_velocity(self.core.keyframe(index), self.core.session.graph.intrinsics)

    def _keyframe(self, index: int) -> Keyframe:
        frame, keyframe = self._frames[index], self.core.keyframe(index)
        velocity = self._velocity(index) if self._readout_time else None
        if not self._readout_time:
            self._without_shutter.add(index)
        self._readout_times.append(0.0 if keyframe.image.velocity is None else self._readout_time)
        if any(self._readout_times):
            self.stats.values["rolling shutter taken out of keyframes"] = in_milliseconds(self._readout_times)
        if self._readout_time and keyframe.image.velocity is None:
            self.stats.count("keyframes with the rolling shutter still in: no velocity")
        with self.stats.time("rectification"):
            return keyframe_message(
                frame, keyframe, self._intrinsics(frame), geometry.inverse(keyframe.cam_from_world),
                self.core.exposure(index), self.core.vignetting, velocity, self._readout_time, self._reads_columns,
            )  # fmt: skip

    def _camera_pose(self, frame: Frame) -> CameraPose | None:
        found = self.core.newest_pose()
        return None if found is None else CameraPose(frame.index, frame.timestamp, stamp=frame.stamp, **found._asdict())

    def _between(self, found: Between) -> TrackedFrame:
        frame, velocity = self._frames[found.index], found.velocity if self.config.rectify_rolling_shutter else None
        intrinsics, scale = self._intrinsics(frame), self.core.scale(found.keyframe)
        return tracked_frame_message(frame, found, intrinsics, scale, velocity, self._readout_time, self._reads_columns)

    def _intrinsics(self, frame: Frame) -> np.ndarray:
        return frame.intrinsics * [self.core.focal_factor, self.core.focal_factor, 1.0, 1.0]


def _grows(request: Request) -> bool:
    return request.asked == Asked.LOCALIZE and not request.on


def _known(folder: str) -> known_map.KnownMap:
    """The tracker's half of a map, as a new stream goes on in it. Raises ValueError."""
    return known_map.load(tracker_file(folder)).renumbered(STREAM)


def in_milliseconds(readout_times: list[float]) -> str:
    """What was taken out of the keyframes, seconds: the estimate gets better while they go out."""
    low, mean, high = (1e3 * float(f(readout_times)) for f in (np.min, np.mean, np.max))
    return f"{mean:.1f} ms" if high - low < 0.05 else f"{mean:.1f} ms in the mean, {low:.1f} to {high:.1f}"
