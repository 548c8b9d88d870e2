"""The tracker: images in; keyframes, corrected poses and the whole trajectory out.

Semi-dense matches (flow.py) of the newest keyframe give each frame's pose; keyframes join a graph (local_map.py) that
dense bundle adjustment keeps consistent; before that, the first keyframes are solved from nothing (initializer.py). A
lost camera is looked for in the map, and starts a new segment meanwhile; loops (loop_closure.py) correct or join.
All of it happens in `add`, in bounded portions: the same frames always give the same poses, however fast they come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.assessment import warn_of_few_matches, warn_of_gaps
from mvsgs_core.tracking.back_end import BackEnd
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.diagnosis import Diagnosis
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.estimation.calibration import REESTIMATED_AT, Calibration
from mvsgs_core.tracking.estimation.focal import FocalConfig
from mvsgs_core.tracking.frames import FrameRecord, solve_trajectory
from mvsgs_core.tracking.front_end import FrontEnd, Step
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage, tracking_size
from mvsgs_core.tracking.initializer import Initializer
from mvsgs_core.tracking.keyframe_choice import HELD_OUT, KeyframeChoice, newest
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.matching.flow import make_flow
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.covisibility import CovisibleKeyframes
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.places.loop_closure import LoopCloser
from mvsgs_core.tracking.places.recovery import Recovery
from mvsgs_core.tracking.places.relocalization import Relocalizer
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.publish import Publisher, Update
from mvsgs_core.trajectory import TrackingState, Trajectory


class Tracker:
    def __init__(self, config: TrackerConfig | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        """clock: what the stages are timed with, in seconds. Raises ValueError where there is no such device."""
        self.config = config or TrackerConfig()
        if self.config.device != "cpu":
            from mvsgs_core.tracking.estimation.torch_adjustment import find_device  # torch takes a second to load

            find_device(self.config.device)
        self.records: list[FrameRecord] = []
        self.stats = Stats(clock=clock)
        self.started = False
        self.segment = 0
        self.nothing = "no frame came"  # why there is no pose at all, after `finish`; empty where there is one
        self.graph: KeyframeGraph | None = None
        self._since = 0  # frames since the last keyframe
        self._tail: dict[int, tuple[TrackingImage, Step]] = {}  # the last two frames since, if they were tracked
        self._trajectory = solve_trajectory([], KeyframeGraph(np.ones(4)), Solver())

    def add(
        self, index: int, timestamp: float, image: np.ndarray, intrinsics: np.ndarray, guessed: bool = False
    ) -> Update:
        """The next frame: (H, W, 3) uint8 RGB with its intrinsics (4,); indices must grow.

        guessed: the focal length is to be estimated; keyframes are published when it is settled, see `focal_factor`.
        """
        if self.graph is None:
            self.set_up(image.shape[0], image.shape[1], intrinsics, guessed)
        here = scale_intrinsics(intrinsics, (image.shape[0], image.shape[1]), self.size)
        if not np.allclose(here, self.intrinsics, rtol=1e-3):
            self.stats.warn("the intrinsics change between frames: the tracker goes on with those of the first")
        with self.stats.time("image"):
            frame = TrackingImage.of(index, timestamp, image, self.size, self.flow.needs_color)
        self.stats.count("frames")
        record = FrameRecord(index, timestamp, TrackingState.NOT_INITIALIZED)
        self.records.append(record)
        self._since += 1
        if self.front_end.reference is None:
            return self._begin(frame, record)
        with self.stats.time("front end"):
            step = self.front_end.follow(frame, self.started)
        if not self.started:
            self.diagnosis.saw(self.front_end.reference, frame, step, self.front_end.is_lost(step))
        if step.still:
            self.stats.skip("frames that did not move")
            last = self.records[-2]
            record.state, record.same_as = last.state, last.index if last.same_as is None else last.same_as
            return Update(record.state)
        if self.front_end.is_lost(step):
            return self._lose(frame, record)
        self.relocalizer.found()
        return self._go_on(frame, step, record) if self.started else self._wait(frame, step, record)

    @property
    def pending(self) -> set[int]:
        """Frames that may still become keyframes that are published: their images are needed until then."""
        if self.graph is None:
            return set()
        waiting = set(self.initializer.waiting) | set(self.publisher.held)
        if self.started:
            return waiting | set(self._tail)
        last = self.front_end.last  # the end of the stream may force a start with it
        return waiting | (set() if last is None else {last.index})

    @property
    def focal_factor(self) -> float:
        """What the focal lengths that came with the frames are to be multiplied with; 1 unless they were a guess."""
        return 1.0 if self.graph is None else self.calibration.focal_factor

    @property
    def readout_time(self) -> float:
        """Seconds that the camera's rolling shutter needs for an image, as far as it is known; 0: global."""
        return 0.0 if self.graph is None else self.graph.readout_time

    def finish(self) -> Iterator[Update]:
        """The stream has ended: a start by force if there was none, and the global bundle adjustment."""
        if self.graph is None:
            return
        if not self.started:
            yield from self._force_start()
        else:
            yield from self._end_with_a_keyframe()
        if self.started:
            self.calibration.estimate_readout_time(self.local_map.members(self.segment)[-40:])
        if self.publisher.held:
            yield Update(TrackingState.TRACKED, self._settle())
        with self.stats.time("global bundle adjustment"):
            for segment in sorted({k.segment for k in self.graph.keyframes.values()}):
                if set(self.local_map.members(segment)) <= self.publisher.published:
                    self.back_end.put_right(segment, self.stats)
        with self.stats.time("frames without a pose"):
            found = self.recovery.fill_in(self.records)
            self._trajectory = solve_trajectory(self.records, self.graph, Solver(steps=8, threads=self.config.threads))
        self.stats.count("frames posed in the end", found)
        self.stats.count(HELD_OUT, sum(is_held_out(index) for index in self.graph.keyframes))
        if self.started:
            self.calibration.check(self.local_map.members(self.segment))
        self.stats.counts["matches"] = self.matcher.calls
        self.stats.counts["matches that needed features"] = self.matcher.feature_calls
        self.nothing = ""
        if not self.graph.keyframes:
            self.nothing = f"tracking never started: {self.initializer.reason}"
            self.stats.warn(self.nothing)
        warn_of_gaps(self.stats, self._trajectory)
        warn_of_few_matches(self.stats, self.graph, self.config.matches)
        yield Update(
            TrackingState.TRACKED if self.started else TrackingState.NOT_INITIALIZED,
            (),
            self.publisher.corrections(True),
        )

    def trajectory(self) -> Trajectory:
        """Every frame's pose, after `finish`."""
        return self._trajectory

    def keyframe(self, index: int) -> Keyframe:
        assert self.graph is not None
        return self.graph.keyframes[index]

    def set_up(self, height: int, width: int, intrinsics: np.ndarray, guessed: bool) -> None:
        config = self.config
        self.size = tracking_size(height, width, config.area)
        self.intrinsics = scale_intrinsics(intrinsics, (height, width), self.size)
        self.graph = KeyframeGraph(self.intrinsics)
        self.graph.device = config.device
        self.calibration = Calibration(
            self.graph, config.focal, self.stats, self.intrinsics, float(intrinsics[0]), not guessed,
            config.readout_time, config.threads,
        )  # fmt: skip
        self.flow = make_flow(config.flow)
        self.matcher = Matcher(self.flow)
        self.front_end = FrontEnd(self.graph, self.matcher, config.front_end, config.threads)
        self.choice = KeyframeChoice(config.front_end)
        self.diagnosis = Diagnosis(config.front_end, config.texture)
        self.initializer = Initializer(self.graph, self.matcher, config.initialization, config.threads, self.diagnosis)
        self.local_map = LocalMap(self.graph, self.matcher, config.local_map, config.threads)
        retrieval = Retrieval()
        self.loops = LoopCloser(self.graph, self.local_map, retrieval, config.loop)
        self.relocalizer = Relocalizer(self.graph, self.matcher, retrieval, config.relocalization)
        self.recovery = Recovery(self.graph, self.matcher, config.recovery, config.front_end)
        self.covisible_keyframes = CovisibleKeyframes(self.graph, self.local_map, config.covisibility, config.threads)
        self.back_end = BackEnd(self.graph, self.local_map, config.back_end, config.threads)
        self.publisher = Publisher(self.graph, config.tolerance, lambda index: self.keyframe(index).segment)

    def _begin(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """First keyframe of a segment that has not started yet."""
        record.state = TrackingState.NOT_INITIALIZED
        if frame.cells.textured.mean() < self.config.texture:
            self.stats.count("frames without texture")
            self.diagnosis.no_texture(frame)
            return Update(record.state)
        self.recovery.keep(frame)
        self.initializer.add(frame, self.segment)
        self._refer_to(frame)
        self.front_end.pose = None
        self._since = 0
        return Update(record.state)

    def _wait(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """Before the start: keyframes are collected until they can be solved."""
        assert self.front_end.reference is not None
        self.recovery.keep(frame)
        reference, width = self.front_end.reference.index, frame.size[1]
        if not self.choice.wants(frame.index, reference, step, width, self.initializer.flow(self._since)):
            if self.initializer.waiting == [reference] and is_held_out(reference) and not is_held_out(frame.index):
                self.initializer.abandon()
                return self._begin(frame, record)
            return Update(TrackingState.NOT_INITIALIZED)
        with self.stats.time("start"):
            self.initializer.add(frame, self.segment, step.matches)
            self._refer_to(frame)
            self._since = 0
            waiting = list(self.initializer.waiting)
            started = self.initializer.initialize(focal=self._unknown_focal())
        if not started:
            place = self.relocalizer.relocalize(frame) if self.segment > 0 else None
            if place is None:
                return Update(TrackingState.NOT_INITIALIZED)
            self.initializer.abandon()
            self.segment -= 1
            return self._resume(frame, record, place)
        return self._started(waiting, record)

    def _started(self, waiting: list[int], record: FrameRecord) -> Update:
        assert self.graph is not None
        self.started = True
        self.calibration.estimate_readout_time(waiting)
        self.local_map.adjust_window(waiting[-1])
        self.calibration.refine(waiting)
        self.front_end.pose = self.graph.keyframes[waiting[-1]].cam_from_world
        if self.config.loops:
            for index in waiting:
                self.loops.add(index)
        self.stats.count("keyframes", len(waiting))
        record.state = TrackingState.TRACKED
        return Update(TrackingState.TRACKED, self._publish(waiting))

    def _go_on(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """A tracked frame; perhaps a keyframe."""
        assert self.graph is not None
        assert self.front_end.reference is not None
        assert step.localization is not None
        record.state = TrackingState.TRACKED
        pose = step.localization.cam_from_world
        reference = self.front_end.reference.index
        record.follow(self.graph, reference, step.matches, pose)
        limit = self.covisible_keyframes.limit(reference, self.config.front_end.keyframe_flow)
        moved = self.front_end.wants_keyframe(step, limit)
        wanted = self.choice.wants(frame.index, reference, step, frame.size[1], limit)
        if moved and self._reuse_keyframe(frame, pose, reference):
            return Update(TrackingState.TRACKED)
        if not wanted:
            self._tail = {index: self._tail[index] for index in sorted(self._tail)[-1:]} | {frame.index: (frame, step)}
            return Update(TrackingState.TRACKED)
        return self._keyframe_of(frame, step, record) or self._lose(frame, record)

    def _keyframe_of(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update | None:
        """A tracked frame becomes a keyframe; None, and it is none, where the map contradicts its pose."""
        assert self.graph is not None
        assert record.reference is not None
        assert step.localization is not None
        with self.stats.time("local map"):
            pose = step.localization.cam_from_world
            self.local_map.insert(frame, pose, self.segment, {record.reference: step.matches})
        with self.stats.time("local bundle adjustment"):
            solution = self.local_map.adjust_window(frame.index)
        if solution.failure:
            self.stats.warn(f"local bundle adjustment failed: {solution.failure}")
        if self.local_map.agreement(frame.index) < self.config.front_end.lost_inliers:
            self.graph.remove(frame.index)
            self.stats.count("keyframes taken back")
            return None
        if self.graph.keyframes[frame.index].triangulated.mean() < 0.3 * frame.cells.textured.mean():
            record.state = TrackingState.DEGENERATE
            self.stats.warn("keyframes without parallax: a camera that only turns gives no depth")
        self.stats.count("keyframes")
        self.covisible_keyframes.made(frame.index)
        self._since = 0
        if len(self.graph.keyframes) in REESTIMATED_AT:
            self.calibration.estimate_readout_time(self.local_map.members(self.segment)[-12:])
        self.calibration.refine(self.local_map.members(self.segment))
        self._close_loops(frame.index)
        for index in self.local_map.members(self.segment)[: -self.config.local_map.window]:
            self.graph.keyframes[index].image.release()
        self._refer_to(frame)
        self.front_end.pose = self.graph.keyframes[frame.index].cam_from_world
        correction = self.publisher.corrections()
        return Update(record.state, self._publish([frame.index]), correction)

    def _end_with_a_keyframe(self) -> Iterator[Update]:
        """The last frames show what no keyframe does: one of them becomes one."""
        tail = {i: t for i, t in self._tail.items() if self.choice.shows_new(t[1], t[0].size[1])}
        last = newest(tail)
        if last is not None:
            record = next(r for r in reversed(self.records) if r.index == last)
            update = self._keyframe_of(*tail[last], record)
            if update is not None:
                yield update

    def _refer_to(self, image: TrackingImage) -> None:
        """A new keyframe is followed from here on."""
        self.front_end.refer_to(image)
        self._tail = {}

    def _publish(self, keyframes: list[int]) -> tuple[int, ...]:
        return self.publisher.publish_all(keyframes, self.calibration.settled)

    def _settle(self) -> tuple[int, ...]:
        """Keyframes that were held back, with the focal length as far as it is known."""
        self.calibration.settle(list(self.publisher.held))
        return self._publish([])

    def _unknown_focal(self) -> FocalConfig | None:
        return None if self.calibration.settled else self.config.focal

    def _reuse_keyframe(self, frame: TrackingImage, pose: np.ndarray, reference: int) -> bool:
        """An old keyframe sees this: it becomes the reference, and no further one is made."""
        with self.stats.time("covisible keyframes"):
            known = self.covisible_keyframes.find(frame, pose, reference)
        if known is None:
            return False
        self._tail = {}
        image = self.keyframe(known.index).image
        self.front_end.resume(image, frame, known.matches, known.localization.cam_from_world)
        self.stats.skip("keyframes spared by covisible ones")
        return True

    def _close_loops(self, index: int) -> None:
        assert self.graph is not None
        if not self.config.loops:
            return
        with self.stats.time("loops"):
            closure = self.loops.search(index)
            self.loops.add(index)
            if closure is not None:
                self.stats.count("loops")
                if closure.failure:
                    self.stats.warn(f"a loop could not be closed: {closure.failure}")
                if closure.moved:
                    self.stats.count("loops that moved the map")
                    self.back_end.pending = self.config.back_end.steps
                if closure.joined is not None:
                    self.segment = self.graph.keyframes[index].segment
                    self.stats.count("segments joined")
        with self.stats.time("background bundle adjustment"):
            self.back_end.work(self.segment)

    def _lose(self, frame: TrackingImage, record: FrameRecord) -> Update:
        """The frame could not be matched: look for it in the map, else begin anew."""
        assert self.graph is not None
        record.state = TrackingState.LOST if self.started else TrackingState.NOT_INITIALIZED
        record.forget()
        if frame.cells.textured.mean() < self.config.texture:
            self.stats.count("frames without texture")
            return Update(record.state)
        self.recovery.keep(frame)
        with self.stats.time("relocalization"):
            place = self.relocalizer.lost(frame)
        if place is not None:
            if not self.started:
                self.initializer.abandon()
                self.segment -= 1
            return self._resume(frame, record, place)
        if not self.started:
            self.initializer.abandon()
            return self._begin(frame, record)
        if self.relocalizer.hopeless:
            self.started = False
            self.segment = 1 + max(self.publisher.highest_segment, *(k.segment for k in self.graph.keyframes.values()))
            published = self._settle() if self.publisher.held else ()
            return Update(self._begin(frame, record).state, published)
        return Update(record.state)

    def _resume(self, frame: TrackingImage, record: FrameRecord, place: PlaceMatch) -> Update:
        """Tracking goes on from a keyframe that was found in a frame."""
        assert self.graph is not None
        keyframe = self.graph.keyframes[place.index]
        self.started, self._tail = True, {}
        self.segment = keyframe.segment
        self.front_end.resume(keyframe.image, frame, place.matches, place.localization.cam_from_world)
        self.relocalizer.found()
        self.stats.count("relocalized")
        record.state = TrackingState.TRACKED
        record.follow(self.graph, place.index, place.matches, place.localization.cam_from_world)
        return Update(TrackingState.TRACKED)

    def _force_start(self) -> Iterator[Update]:
        """The stream ended before the start: what was collected, with weaker criteria."""
        assert self.graph is not None
        frame = self.front_end.last
        reference = self.front_end.reference
        step = self.front_end.step
        if frame is None or reference is None:
            return
        if step is not None and frame.index not in self.graph.keyframes:
            self.initializer.add(frame, self.segment, step.matches)
        waiting = list(self.initializer.waiting)
        record = next(r for r in self.records if r.index == frame.index)
        if self.initializer.initialize(True, self._unknown_focal()):
            self.stats.warn(f"the start was forced at the end of the stream: {self.initializer.reason}")
            yield self._started(waiting, record)
        else:
            self.initializer.abandon()


__all__ = ["Tracker", "TrackerConfig", "Update"]
