"""The tracker: images in; keyframes, corrected poses and the whole path out.

Semi-dense matches (flow.py) of the newest keyframe give each frame's pose; keyframes join a graph (local_map.py) that
dense bundle adjustment keeps consistent; before that, the first keyframes are solved from nothing (initialization.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.camera import fit_size, scale_intrinsics
from mvsgs_core.tracking.back_end import BackEnd, BackEndConfig
from mvsgs_core.tracking.bundle_adjustment import Solver
from mvsgs_core.tracking.flow import Matches, make_flow, spread
from mvsgs_core.tracking.frames import FrameRecord, Path, State, compact, solve_path
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig, Step
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.initialization import StartCriteria, start_up
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.matcher import Matcher
from mvsgs_core.tracking.publish import Correction, Publisher
from mvsgs_core.tracking.stats import TrackingStats


@dataclass(frozen=True)
class TrackerConfig:
    area: int = 320 * 240  # pixels of the tracker's image, same aspect as the input
    flow: str = "lucas_kanade"  # mvsgs_core.tracking.flow.FLOWS, or module:Class
    start_keyframes: int = 6  # before a start is tried
    start_flow: float = 0.035  # of the width: median flow between keyframes before the start
    start_limit: int = 10  # keyframes held before the start; the oldest goes first
    tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not told
    threads: int = 1
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)
    start: StartCriteria = field(default_factory=StartCriteria)


@dataclass(frozen=True)
class Update:
    """What one frame changed."""

    state: State
    keyframes: tuple[int, ...] = ()  # indices of frames that became keyframes, in order
    correction: Correction | None = None  # of keyframes told before


class Tracker:
    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config or TrackerConfig()
        self.records: list[FrameRecord] = []
        self.started = False
        self.segment = 0
        self.stats = TrackingStats()
        self.graph: KeyframeGraph | None = None
        self._waiting: list[int] = []  # keyframes before the start

    def add(self, index: int, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> Update:
        """The next frame: (H, W, 3) uint8 RGB with its intrinsics (4,); indices must grow."""
        if self.graph is None:
            self._set_up(image.shape[0], image.shape[1], intrinsics)
        with self.stats.time("image"):
            frame = TrackingImage.of(index, timestamp, image, self.size, self.flow.needs_color)
        self.stats.count("frames")
        record = FrameRecord(index, timestamp, State.NOT_STARTED)
        self.records.append(record)
        if self.front_end.reference is None:
            return self._begin(frame)
        with self.stats.time("front end"):
            step = self.front_end.follow(frame, self.started)
        if step.still:
            self.stats.skip("frames that did not move")
            record.state, record.same_as = self.records[-2].state, self.records[-2].index
            if self.records[-2].same_as is not None:
                record.same_as = self.records[-2].same_as
            return Update(record.state)
        if self.front_end.is_lost(step):
            return self._lose(frame, record)
        record.reference = self.front_end.reference.index
        record.matches = compact(step.matches)
        record.cam_from_reference = self.front_end.cam_from_reference(step)
        return self._go_on(frame, step, record) if self.started else self._wait(frame, step, record)

    @property
    def pending(self) -> set[int]:
        """Frames that may still become keyframes that are told: their images are needed until then."""
        return set(self._waiting)

    def idle(self) -> Update | None:
        """A slice of background work; None when there is nothing to do."""
        return None

    def finish(self) -> Iterator[Update]:
        """The stream has ended: a start by force if there was none, and the global bundle adjustment."""
        if self.graph is None:
            return
        with self.stats.time("global bundle adjustment"):
            for segment in sorted({k.segment for k in self.graph.keyframes.values()}):
                self._adjust_globally(segment)
        yield Update(State.TRACKED, (), self.publisher.corrections(everything=True))

    def path(self) -> Path:
        """Every frame's pose, after `finish`."""
        if self.graph is None:
            return solve_path([], KeyframeGraph(np.ones(4)), Solver())
        return solve_path(self.records, self.graph, Solver(steps=8, threads=self.config.threads))

    def keyframe(self, index: int) -> Keyframe:
        assert self.graph is not None
        return self.graph.keyframes[index]

    def _set_up(self, height: int, width: int, intrinsics: np.ndarray) -> None:
        config = self.config
        self.size = fit_size(height, width, config.area)
        self.graph = KeyframeGraph(scale_intrinsics(intrinsics, (height, width), self.size))
        self.flow = make_flow(config.flow)
        self.matcher = Matcher(self.flow)
        self.front_end = FrontEnd(self.graph, self.matcher, config.front_end, config.threads)
        self.local_map = LocalMap(self.graph, self.matcher, config.local_map, config.threads)
        self.back_end = BackEnd(self.graph, self.local_map, config.back_end, config.threads)
        self.publisher = Publisher(self.graph, config.tolerance)

    def _begin(self, frame: TrackingImage) -> Update:
        """First keyframe of a segment that has not started yet."""
        if frame.cells.textured.mean() < 0.05:
            self.stats.warn("frames without texture before the start")
            return Update(State.NOT_STARTED)
        self._add_waiting(frame)
        self.front_end.refer_to(frame)
        return Update(State.NOT_STARTED)

    def _add_waiting(self, frame: TrackingImage) -> None:
        assert self.graph is not None
        ones = np.ones(len(frame.cells.points))
        self.graph.add(Keyframe(frame, np.eye(4), ones, ones.copy(), 0.0 * ones, self.segment))
        self._waiting.append(frame.index)

    def _wait(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """Before the start: keyframes are collected until they can be solved."""
        assert self.graph is not None
        if not self.front_end.wants_keyframe(step, self.config.start_flow):
            return Update(State.NOT_STARTED)
        with self.stats.time("start"):
            earlier = list(self._waiting)
            self._add_waiting(frame)
            self._connect_waiting(frame, earlier, step.matches)
            self.front_end.refer_to(frame)
            if len(self._waiting) < self.config.start_keyframes:
                return Update(State.NOT_STARTED)
            start = start_up(self.graph, self._waiting, self.config.start, self.config.threads)
            self.stats.count("start attempts")
            if start.failure:
                if len(self._waiting) >= self.config.start_limit:
                    self.graph.remove(self._waiting.pop(0))
                return Update(State.NOT_STARTED)
            for n, index in enumerate(self._waiting):
                keyframe = self.graph.keyframes[index]
                keyframe.cam_from_world, keyframe.inverse_depth = start.cam_from_world[n], start.inverse_depth[n]
                keyframe.information, keyframe.prior = start.information[n], np.ones_like(start.inverse_depth[n])
        self.started = True
        self.front_end.pose = self.graph.keyframes[frame.index].cam_from_world
        told, self._waiting = tuple(self._waiting), []
        for index in told:
            self.publisher.tell(index)
        record.state = State.TRACKED
        return Update(State.TRACKED, told)

    def _connect_waiting(self, frame: TrackingImage, earlier: list[int], matches: Matches) -> None:
        """Edges both ways between a keyframe before the start and those before it, chained from one to the next."""
        assert self.graph is not None
        share = self.config.local_map.min_share
        points = frame.cells.points.astype(np.float64)
        newest = earlier[-1]
        forward = {newest: matches}  # matches of an earlier keyframe's points in the new one
        self.graph.connect(newest, frame.index, matches, share)
        for n, index in enumerate(reversed(earlier[-5:])):
            image = self.graph.keyframes[index].image
            if n:
                link = self.graph.edges.get((index, newest))
                if link is None:
                    continue
                seen, hop = link.weight > 0, forward[newest]
                near = self.graph.keyframes[newest].points.astype(np.float64)
                guess = spread(
                    near[hop.alive], hop.target[hop.alive] - near[hop.alive], link.target.T[seen].astype(np.float64)
                )
                start = image.cells.points.astype(np.float64)
                guess_all = spread(start[seen], guess - start[seen], start)
                forward[index], _ = self.matcher.match(image, frame, guess_all, share)
                self.graph.connect(index, frame.index, forward[index], share)
            found = forward[index]
            if found.alive.sum() < 30:
                continue
            at = found.target[found.alive]
            back = spread(at, image.cells.points[found.alive] - at, points)
            self.graph.connect(frame.index, index, self.matcher.match(frame, image, back, share)[0], share)

    def _go_on(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        """A tracked frame; perhaps a keyframe."""
        assert self.graph is not None
        assert step.localization is not None
        record.state = State.TRACKED
        if not self.front_end.wants_keyframe(step, self.config.front_end.keyframe_flow):
            return Update(State.TRACKED)
        assert self.front_end.reference is not None
        with self.stats.time("local map"):
            reference = self.front_end.reference.index
            self.local_map.insert(frame, step.localization.cam_from_world, self.segment, {reference: step.matches})
        with self.stats.time("local bundle adjustment"):
            solution = self.local_map.adjust_window(frame.index)
        if solution.failure:
            self.stats.warn(f"local bundle adjustment failed: {solution.failure}")
        self.stats.count("keyframes")
        for index in self.local_map.members(self.segment)[: -self.config.local_map.window]:
            self.graph.keyframes[index].image.release()
        self.front_end.refer_to(frame)
        self.front_end.pose = self.graph.keyframes[frame.index].cam_from_world
        correction = self.publisher.corrections()
        self.publisher.tell(frame.index)
        return Update(State.TRACKED, (frame.index,), correction)

    def _lose(self, frame: TrackingImage, record: FrameRecord) -> Update:
        record.state = State.LOST if self.started else State.NOT_STARTED
        self.stats.count("lost frames")
        return Update(record.state)

    def _adjust_globally(self, segment: int) -> None:
        members = self.local_map.members(segment)
        if len(members) < 3 or not set(members) <= self.publisher.told:
            return
        for index in members:
            self.stats.count("edges matched again", self.back_end.rematch_edges(index))
            self.stats.count("edges by proximity", self.back_end.extend_edges(index, segment))
        for solution in self.back_end.adjust(segment):
            if solution.failure:
                self.stats.warn(f"global bundle adjustment failed: {solution.failure}")


__all__ = ["Tracker", "TrackerConfig", "Update"]
