"""The tracker at work on a stream: its parts, made whole with the first frame, and what it does in each phase.

    INITIALIZING --- the first keyframes are solved ---> TRACKING --- a frame can't be followed ---> RELOCALIZING, LOST
    RELOCALIZING --- found in the map, or followed again ---> TRACKING
    RELOCALIZING --- patience is over ---> INITIALIZING, a segment of its own, which a loop may join later

Semi-dense matches (flow.py) of the newest keyframe give each frame's pose; keyframes join a graph (local_map.py) that
dense bundle adjustment keeps consistent; loops (loop_closure.py) correct or join. That work is done in steps, between
which frames may come: they are followed from the keyframe before, and none of them becomes a keyframe before its end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.back_end import BackEnd
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.diagnosis import Diagnosis
from mvsgs_core.tracking.estimation.calibration import LAST, Calibration
from mvsgs_core.tracking.frames import FrameRecord, record_of
from mvsgs_core.tracking.front_end import FrontEnd, Step
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage, tracking_size
from mvsgs_core.tracking.initializer import Initializer
from mvsgs_core.tracking.keyframe_choice import KeyframeChoice, Tail
from mvsgs_core.tracking.keyframe_spacing import spacing_of
from mvsgs_core.tracking.keyframe_work import KeyframeWork
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.matching.flow import make_flow
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.photometer import Photometer, observed
from mvsgs_core.tracking.places.covisibility import CovisibleKeyframes
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.places.loop_closure import LoopCloser
from mvsgs_core.tracking.places.recovery import Recovery
from mvsgs_core.tracking.places.relocalization import Relocalizer
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.publish import Correction, Publisher, Update
from mvsgs_core.tracking.steps import Steps, timed, whole
from mvsgs_core.tracking.waiting import WaitingFrames
from mvsgs_core.trajectory import TrackingState


class Session:
    def __init__(
        self, config: TrackerConfig, stats: Stats, size: tuple[int, int], intrinsics: np.ndarray, guessed: bool
    ) -> None:
        """size (height, width), intrinsics (4,): of the frames as they come; guessed: the focal length is."""
        threads = config.threads or 1
        self.config, self.stats = config, stats
        self.phase, self.segment = Phase.INITIALIZING, 0
        self.records: list[FrameRecord] = []
        self.size = tracking_size(*size, config.area)
        self.intrinsics = scale_intrinsics(intrinsics, size, self.size)
        self.graph = KeyframeGraph(self.intrinsics, config.device)
        self.calibration = Calibration(
            self.graph, config.focal, stats, np.array(intrinsics, np.float64), guessed,
            config.readout_time, config.reads_columns, threads,
        )  # fmt: skip
        self.matcher = Matcher(make_flow(config.flow))
        self.front_end = FrontEnd(self.graph, self.matcher, config.front_end.at(self.size, config.area), threads)
        self.choice = KeyframeChoice(config.keyframe_choice, spacing_of(config.share) if config.realtime else None)
        self.diagnosis = Diagnosis(self.front_end.config.lost_fraction, config.min_texture)
        self.initializer = Initializer(self.graph, self.matcher, config.initialization, threads, self.diagnosis)
        self.local_map = LocalMap(self.graph, self.matcher, config.local_map, threads)
        self.covisible_keyframes = CovisibleKeyframes(self.graph, self.local_map, config.covisibility, threads)
        self.back_end = BackEnd(self.graph, self.local_map, config.back_end, threads)
        retrieval = Retrieval()
        self.loops = LoopCloser(self.graph, self.local_map, retrieval, config.loop)
        self.relocalizer = Relocalizer(self.graph, self.matcher, retrieval, config.relocalization)
        self.recovery = Recovery(self.graph, self.matcher, config.recovery, self.front_end.config)
        self.photometer = Photometer(self.graph, stats)
        self.publisher = Publisher(
            self.graph, config.tolerance, lambda index: self.graph.keyframes[index].segment, self.photometer
        )
        self.waiting = WaitingFrames(self.graph, self.matcher, self.photometer, config.frames_between, threads, stats)
        self.keyframe_work = KeyframeWork(
            config, stats, self.graph, self.calibration, self.local_map, self.covisible_keyframes, self.loops,
            self.back_end, self.photometer,
        )  # fmt: skip
        self.late = False  # the work on a keyframe must go on at once, or the camera may be lost
        self._at_work: frozenset[int] = frozenset()  # keyframes whose work has begun; frames may come meanwhile
        self._since = 0  # frames since the last keyframe
        self._tail = Tail()
        self._missed: TrackingImage | None = None  # the frame before, if a start could not follow it

    def add(self, frame: TrackingImage) -> Update:
        """The next frame of the stream; its pose is known then, and the update's `rest` is still to be done."""
        record = FrameRecord(frame.index, frame.timestamp, TrackingState.NOT_INITIALIZED)
        self.records.append(record)
        self._since += 1
        update = self._handle(frame, record)
        self.stats.count(f"frames while {self.phase}")
        return update

    @property
    def pending(self) -> set[int]:
        """Frames that may still go out, as keyframes or between them: their images are needed until then."""
        waiting = set(self.initializer.waiting) | set(self.publisher.held) | self.waiting.indices | self._at_work
        if self.phase is not Phase.INITIALIZING:
            return waiting | self._tail.indices
        # the end of the stream may force an initialization with one, the next frame may begin one with the other
        return waiting | {frame.index for frame in (self.front_end.last, self._missed) if frame is not None}

    def last_keyframes(self) -> Iterator[Update]:
        """The stream has ended: an initialization by force if there was none, else a keyframe of the last frames."""
        if self.phase is Phase.INITIALIZING:
            yield from self._force_initialization()
        elif last := self._tail.last(self.choice):
            record = record_of(self.records, last[0].index)
            yield from self._begin_work(last[0], record, self._add_keyframe(*last, record)).following()
            if self.phase is Phase.INITIALIZING:  # the map contradicted it: a part of its own would begin
                self.initializer.abandon()
        if largest := self.local_map.largest():
            self.calibration.estimate_readout(largest, LAST)
        if self.publisher.held:
            yield self._publish_held()

    def _handle(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """The phase decides what becomes of a frame, and what becomes of it decides the next phase."""
        initializing = self.phase is Phase.INITIALIZING
        if self.front_end.reference is None:  # a stream that goes on in a map begins lost
            return self._begin_segment(frame, record) if initializing else self._lose(frame, record)
        with self.stats.time("front end"):
            step = self.front_end.follow(frame, with_pose=not initializing)
        followed = not self.front_end.is_lost(step)
        if initializing and (followed or self._at_work):
            self.diagnosis.saw(self.front_end.reference, frame, step, not followed)
        if followed:
            self._missed = None
        if step.still:
            return self._stand_still(frame, step, record)
        if followed:
            self.relocalizer.found()
        if self._at_work:
            return self._follow_beside_work(frame, step if followed else None, record)
        if initializing:
            return (self._initialize if followed else self._initialize_anew)(frame, step, record)
        return self._track(frame, step, record) if followed else self._lose(frame, record)

    def _stand_still(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """It shows what the frame that was followed last does, whatever came between: a hand before the lens."""
        assert self.front_end.last is not None
        same = record_of(self.records, self.front_end.last.index)
        if same.state == TrackingState.LOST:  # the map contradicted it when it was to be a keyframe
            return self._lose(frame, record)
        self.stats.skip("frames that did not move")
        record.state, record.same_as = same.state, same.index
        if self.phase is not Phase.INITIALIZING:
            record.light = observed(self.graph, step.reference, frame, step.matches)  # the light may have changed
            self.phase = Phase.TRACKING
            self.relocalizer.found()
        return Update(record.state)

    def _follow_beside_work(self, frame: TrackingImage, step: Step | None, record: FrameRecord) -> Update:
        """A frame that came while a keyframe is worked on. step: None where it can't be followed, as yet."""
        tracking = self.phase is not Phase.INITIALIZING
        if step is None or not tracking:
            self.recovery.keep(frame)
        if step is None:
            record.state = TrackingState.LOST if tracking else TrackingState.NOT_INITIALIZED
            self.late = True
            return Update(record.state)
        if tracking:
            record.state = TrackingState.TRACKED
            record.follow(self.graph, step.reference, step.matches, step.pose, frame)
            self._tail.add(frame, step)
        self.waiting.add(frame, record)
        self.choice.saw(step)
        self.late |= self.choice.is_late(step, frame.longer_side, self.choice.max_flow)
        return Update(record.state)

    def _begin_work(self, frame: TrackingImage, record: FrameRecord, steps: Steps[Update]) -> Update:
        """A frame becomes a keyframe; until all steps are done, frames that come are followed and no more."""
        self._at_work = frozenset({frame.index, *self.initializer.waiting})
        self.waiting.end()
        return Update(record.state, rest=self._until_done(steps))

    def _until_done(self, steps: Steps[Update]) -> Steps[Update]:
        """Where a frame that came meanwhile is as far away as the next one may be, it is a keyframe at once, too."""
        update, worked_on = (yield from steps), max(self._at_work)
        self._at_work, self.late = frozenset(), False
        came = self._tail.newest_after(worked_on)
        if came is None or not self.choice.is_late(came[1], came[0].longer_side, self.choice.max_flow):
            return update
        record = record_of(self.records, came[0].index)
        return replace(update, rest=self._begin_work(came[0], record, self._add_keyframe(*came, record)).rest)

    # INITIALIZING

    def _begin_segment(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """The first keyframe of a segment, if the image has any texture."""
        self.phase, self._missed = Phase.INITIALIZING, None
        self.waiting.forget()
        record.state = TrackingState.NOT_INITIALIZED
        if not self._has_texture(frame):
            self.diagnosis.no_texture(frame)
            return Update(record.state)
        self.recovery.keep(frame)
        self.initializer.add(frame, self.segment)
        self._refer_to(frame, None)
        return Update(record.state)

    def _initialize(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """Keyframes are collected until they can be solved; those of a later segment are looked for in the map too."""
        self.recovery.keep(frame)
        limit = self.initializer.flow(self._since)
        if not self.choice.wants(frame.index, step, frame.longer_side, limit):
            only = self.initializer.waiting == [step.reference]
            if only and is_held_out(step.reference) and not is_held_out(frame.index):  # this one is as good
                self.initializer.abandon()
                return self._begin_segment(frame, record)
            self.waiting.add(frame, record)
            return Update(record.state)
        self._refer_to(frame, None)
        return self._begin_work(frame, record, self._start(frame, step, record))

    def _start(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Steps[Update]:
        """One more keyframe to solve all from, which takes longer than a frame: this one has no pose as it comes."""
        yield from timed(self.stats, "start", self.initializer.adding(frame, self.segment, step.matches))
        waiting = list(self.initializer.waiting)
        if (yield from timed(self.stats, "start", self.initializer.initializing(focal=self.calibration.sought))):
            return (yield from self._begin_tracking(waiting, record))
        self.waiting.forget_before(self.initializer.waiting[0])
        place = self.relocalizer.relocalize(frame) if self.segment > 0 else None
        return Update(record.state) if place is None else self._resume(frame, record, place)

    def _initialize_anew(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """The keyframes that wait can't be followed: they go where the next frame only can be from this one.

        Else this one was bad: a hand before the lens, a jerk. The camera may be in an earlier segment, too.
        """
        before = self._missed
        follows = before is not None and self.front_end.follows(before, frame)
        if not follows and self.front_end.reference is not None:
            self.diagnosis.saw(before or self.front_end.reference, frame, step, True)
        if not self._has_texture(frame):
            return Update(record.state)
        if (place := self._search_map(frame)) is not None:
            return self._resume(frame, record, place)
        self._missed = frame
        if before is None or not follows:
            return Update(record.state)
        self.initializer.abandon()
        self._begin_segment(before, record_of(self.records, before.index))
        step = self.front_end.follow(frame, with_pose=False)
        self.diagnosis.saw(before, frame, step, False)
        return self._initialize(frame, step, record)

    def _begin_tracking(self, keyframes: list[int], record: FrameRecord) -> Steps[Update]:
        """The first keyframes of a segment are solved; frames before and between them are matched at once."""
        self.phase, keyframes = Phase.TRACKING, [index for index in keyframes if index in self.graph.keyframes]
        yield
        yield from self.keyframe_work.first(keyframes)
        self.front_end.pose = self.graph.keyframes[keyframes[-1]].cam_from_world
        self.stats.count("keyframes", len(keyframes))
        record.state = TrackingState.TRACKED
        yield from self.recovery.filling_in([record for record in self.records if record.index >= keyframes[0]])
        return self._published(record, keyframes)

    def _published(self, record: FrameRecord, keyframes: list[int], correction: Correction | None = None) -> Update:
        """Keyframes are ready: they go out, where the focal length is certain, and the frames before them are posed."""
        published = self.publisher.publish_all(keyframes, self.calibration.settled)
        later = self.waiting.settle(list(published) or keyframes, self.records, self.publisher)
        return Update(record.state, published, correction, later=later)

    def _force_initialization(self) -> Iterator[Update]:
        """The stream ended before there was a map: what was collected, with weaker criteria."""
        frame, step = self.front_end.last, self.front_end.step
        if frame is None:
            return
        if step is not None and frame.index not in self.graph.keyframes:
            self.initializer.add(frame, self.segment, step.matches)
        waiting = list(self.initializer.waiting)
        self.waiting.end()
        if self.initializer.initialize(True, self.calibration.sought):
            self.stats.warn(f"the start was forced at the end of the stream: {self.initializer.reason}")
            yield whole(self._begin_tracking(waiting, record_of(self.records, frame.index)))
        else:
            self.initializer.abandon()

    # TRACKING

    def _track(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """A frame whose pose is known; perhaps a keyframe."""
        self.phase, record.state = Phase.TRACKING, TrackingState.TRACKED
        record.follow(self.graph, step.reference, step.matches, step.pose, frame)
        limit = self.covisible_keyframes.limit(step.reference, self.choice.max_flow)
        wanted = self.choice.wants(frame.index, step, frame.longer_side, limit)
        if self.choice.moved(step, frame.longer_side, limit) and self._reuse_keyframe(frame, step):
            return Update(record.state)
        if not wanted:
            self._tail.add(frame, step)
            self.waiting.add(frame, record)
            return Update(record.state)
        return self._begin_work(frame, record, self._add_keyframe(frame, step, record))

    def _add_keyframe(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Steps[Update]:
        """A tracked frame becomes a keyframe; it is none, and lost, where the map contradicts its pose."""
        if not (yield from self.keyframe_work.insert(frame, step, self.segment)):
            self.waiting.reopen()
            return self._lose(frame, record)
        if self.graph.keyframes[frame.index].triangulated.mean() < 0.3 * frame.cells.textured.mean():
            record.state = TrackingState.DEGENERATE
            self.stats.warn("keyframes without parallax: a camera that only turns gives no depth")
        self._refer_to(frame, self.graph.keyframes[frame.index].cam_from_world)
        yield
        yield from self.keyframe_work.tie(frame.index)
        self.segment = self.graph.keyframes[frame.index].segment  # a loop may have joined two
        self.front_end.pose = self.graph.keyframes[frame.index].cam_from_world
        correction = self.publisher.corrections()
        yield
        return self._published(record, [frame.index], correction)

    def _reuse_keyframe(self, frame: TrackingImage, step: Step) -> bool:
        """An old keyframe sees this: it becomes the reference, and no further one is made."""
        with self.stats.time("covisible keyframes"):
            known = self.covisible_keyframes.find(frame, step.pose, step.reference)
        if known is None:
            return False
        self._follow_place(frame, known)
        self.stats.skip("keyframes spared by covisible ones")
        return True

    # LOST and RELOCALIZING

    def _lose(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """A frame of the map that could not be followed."""
        record.state = TrackingState.LOST
        record.forget()
        if self._has_texture(frame):
            return self._relocalize(frame, record)
        self.phase = Phase.LOST
        return Update(record.state)

    def _relocalize(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """The map is searched; a frame that shows little of it becomes a keyframe. At last a segment begins."""
        self.phase = Phase.RELOCALIZING
        if (place := self._search_map(frame)) is not None:
            resumed, step = self._resume(frame, record, place), self.front_end.found(place)
            if self._at_work or is_held_out(frame.index) or not self.front_end.is_lost(step):
                return resumed
            return self._begin_work(frame, record, self._add_keyframe(frame, step, record))
        if not self.relocalizer.hopeless:
            return Update(record.state)
        self.segment = 1 + max(self.publisher.highest_segment, *(k.segment for k in self.graph.keyframes.values()))
        return self._begin_segment(frame, record)

    def _search_map(self, frame: TrackingImage) -> PlaceMatch | None:
        self.recovery.keep(frame)
        with self.stats.time("relocalization"):
            return self.relocalizer.lost(frame)

    def _resume(self, frame: TrackingImage, record: FrameRecord, place: PlaceMatch) -> Update:
        """Tracking goes on from a keyframe that was found in a frame; a segment that has no map yet is given up."""
        self.initializer.abandon()
        self.phase, self.segment = Phase.TRACKING, self.graph.keyframes[place.index].segment
        self._follow_place(frame, place)
        self.relocalizer.found()
        self.stats.count("relocalized")
        record.state = TrackingState.TRACKED
        record.follow(self.graph, place.index, place.matches, place.localization.cam_from_world, frame)
        return Update(record.state)

    # In all phases

    def _has_texture(self, frame: TrackingImage) -> bool:
        """Whether the image is of any use; counted where it is not."""
        enough = bool(frame.cells.textured.mean() >= self.config.min_texture)
        if not enough:
            self.stats.count("frames without texture")
        return enough

    def _refer_to(self, keyframe: TrackingImage, pose: np.ndarray | None) -> None:
        """A new keyframe is followed from here on, by frames that came since, too. pose (4, 4): its own, in a map."""
        last, self._tail, self._since, self.late = self.front_end.last, Tail(), 0, False
        later = last if last and last.index > keyframe.index else None
        if pose is not None and later and (step := self.front_end.move_to(keyframe, pose)):
            self._tail.add(later, step)
            return self.choice.saw(step)
        self.front_end.refer_to(keyframe)
        self.front_end.pose = pose

    def _follow_place(self, frame: TrackingImage, place: PlaceMatch) -> None:
        """An earlier keyframe is followed from here on, whose points were found in this frame."""
        keyframe = self.graph.keyframes[place.index].image
        self.front_end.resume(keyframe, frame, place.matches, place.localization.cam_from_world)
        self._tail = Tail()

    def _publish_held(self) -> Update:
        """Keyframes that were held back, with the focal length as far as it is known, and the frames between them."""
        self.calibration.settle(list(self.publisher.held))
        return self._published(self.records[-1], []).whole()
