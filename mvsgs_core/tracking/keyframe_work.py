"""What a new keyframe of a map takes, in steps: edges, bundle adjustment of the window, loops, light.

Nothing of it is needed for the pose of the next frame, which is found against the keyframe before.
"""

from __future__ import annotations

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.back_end import BackEnd
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.calibration import Calibration
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.photometer import Photometer
from mvsgs_core.tracking.places.covisibility import CovisibleKeyframes
from mvsgs_core.tracking.places.loop_closure import Closure, LoopCloser
from mvsgs_core.tracking.steps import Steps, timed


class KeyframeWork:
    """The parts of a session that a keyframe goes through."""

    def __init__(
        self,
        config: TrackerConfig,
        stats: Stats,
        graph: KeyframeGraph,
        calibration: Calibration,
        local_map: LocalMap,
        covisible_keyframes: CovisibleKeyframes,
        loops: LoopCloser,
        back_end: BackEnd,
        photometer: Photometer,
    ) -> None:
        self.config, self.stats, self.graph = config, stats, graph
        self.calibration, self.local_map, self.covisible_keyframes = calibration, local_map, covisible_keyframes
        self.loops, self.back_end, self.photometer = loops, back_end, photometer

    def insert(self, frame: TrackingImage, step: Step, segment: int) -> Steps[bool]:
        """A frame becomes a keyframe that can be followed; False, and it is none, where the map contradicts its pose.

        step: of the frame when it was followed; its pose may be of a time before a loop.
        """
        pose = step.pose_in(self.graph)
        matches, before = {step.reference: step.matches}, self.graph.solved(self.local_map.window(segment))
        yield from timed(self.stats, "local map", self.local_map.inserting(frame, pose, segment, matches))
        self._adjust_window(frame.index)
        yield
        if self.local_map.agreement(frame.index) < self.config.front_end.lost_inliers:
            self.graph.remove(frame.index)
            self.graph.put_back(before)  # it bent what is around it
            self.stats.count("keyframes taken back")
            return False
        self.stats.count("keyframes")
        self.covisible_keyframes.made(frame.index)
        return True

    def tie(self, index: int) -> Steps[None]:
        """What an inserted keyframe tells of the camera, of the whole map and of the light."""
        members = self.local_map.members(self.graph.keyframes[index].segment)
        if self.calibration.readout_due(len(members)):
            yield from self.calibration.estimating_readout(members)
            yield
        self.calibration.refine()
        yield
        if self.config.loops:
            yield from self._close_loops(index)
        yield from self.photometer.updating()
        self.local_map.release_images(self.graph.keyframes[index].segment)

    def first(self, keyframes: list[int]) -> Steps[None]:
        """The same of a segment's first keyframes, once they are solved."""
        yield from self.calibration.estimating_readout(keyframes)
        yield
        self._adjust_window(keyframes[-1])
        yield
        self.calibration.refine()
        yield
        if self.config.loops:
            for index in keyframes:
                self.loops.add(index)
                yield
        yield from self.photometer.updating()

    def _adjust_window(self, newest: int) -> None:
        with self.stats.time("local bundle adjustment"):
            self._note(self.local_map.adjust_window(newest).failure, "local bundle adjustment failed")

    def _note(self, failure: str, what: str) -> None:
        """A bundle adjustment that changed nothing. failure: why; empty where it did not fail."""
        if failure:
            self.stats.count("failed bundle adjustments")
            self.stats.warn(f"{what}: {failure}")

    def _close_loops(self, index: int) -> Steps[None]:
        closure: Closure | None = yield from timed(self.stats, "loops", self._searching(index))
        yield
        if closure is not None:
            self.stats.count("loops")
            if closure.failure:
                self.stats.warn(f"a loop could not be closed: {closure.failure}")
            if closure.moved:
                self.stats.count("loops that moved the map")
                self.back_end.pending = self.config.back_end.steps
            if closure.joined is not None:
                self.stats.count("segments joined")
        segment = self.graph.keyframes[index].segment
        failure = yield from timed(self.stats, "background bundle adjustment", self.back_end.working(segment))
        self._note(failure, "background bundle adjustment failed")
        yield

    def _searching(self, index: int) -> Steps[Closure | None]:
        closure = yield from self.loops.searching(index)
        self.loops.add(index)
        return closure


__all__ = ["KeyframeWork"]
