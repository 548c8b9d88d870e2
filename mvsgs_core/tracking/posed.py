"""A tracker whose poses are given: it chooses keyframes and frames between them, and triangulates depths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import Between, exposure_from, spared
from mvsgs_core.tracking.config import PosedConfig
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, reproject
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig, Step
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage, tracking_size
from mvsgs_core.tracking.keyframe_choice import HELD_OUT, KeyframeChoice, Tail
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.matching.flow import Matches, make_flow
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.photometer import FrameLight, Photometer, observed

FIRST_RATIO = 0.1  # of the depth: how far the first two keyframes are taken to be apart where no match says it
PARALLAX = 1.0  # pixels by which a depth explains the matches better than none: less may be errors of the given poses
STAYED = 0.003  # of the depth, or radians: as far as a camera that stands may be from where it was, about a pixel
DEPTHS = 0.3  # of a keyframe's textured points: so many triangulated, and depths are known


@dataclass(frozen=True)
class _Waiting:
    """A frame that may train the map."""

    image: TrackingImage
    light: FrameLight
    world_from_cam: np.ndarray  # (4, 4) as it was given


class PosedTracker:
    """Keyframes come one keyframe late: their depths are triangulated with one that follows.

    The given poses' unit may be anything. Inside, the median depth of the first keyframe is the unit, as everywhere in
    the tracker; what goes out is in the given one.
    """

    def __init__(self, config: PosedConfig, size: tuple[int, int], intrinsics: np.ndarray) -> None:
        """size (height, width), intrinsics (4,): of the frames as they come."""
        self.config = config
        self.stats = Stats()
        self.size = tracking_size(*size, config.area)
        self.graph = KeyframeGraph(scale_intrinsics(intrinsics, size, self.size))
        self.graph.readout_time, self.graph.reads_columns = config.readout_time, config.reads_columns
        self.threads = config.threads or 1
        self.flow = make_flow(config.flow)
        matcher = Matcher(self.flow)
        self.choice = KeyframeChoice(config.keyframe_choice)
        self.front_end = FrontEnd(
            self.graph, matcher, FrontEndConfig(still_flow=0.0).at(self.size, config.area), self.threads
        )
        self.local_map = LocalMap(self.graph, matcher, config.local_map, self.threads)
        self.photometer = Photometer(self.graph, self.stats)
        self._lights: list[FrameLight] = []  # of all frames
        self.unit = 1.0  # of the given poses' units, one of the graph's
        self._undecided = True  # about the unit: no two keyframes have given a depth yet
        self._complete: list[int] = []  # keyframes not given out yet
        self._tail = Tail()
        self._poses: dict[int, np.ndarray] = {}  # (4, 4) of these, in the graph's unit
        self._between: dict[int, dict[int, _Waiting]] = {}  # by the keyframe that they were followed from

    def add(
        self, index: int, timestamp: float, image: np.ndarray, world_from_cam: np.ndarray, exposure: float = 0.0,
        mask: np.ndarray | None = None,
    ) -> list[int]:  # fmt: skip
        """The next frame with its pose (4, 4), its exposure, 0 where it is not known, and its mask, as in `msgs.Frame`.

        Returns the keyframes, by index, that are complete now.
        """
        frame = TrackingImage.of(index, timestamp, image, self.size, self.flow.needs_color, exposure, mask)
        self.stats.count("frames")
        self._lights.append(FrameLight(index))
        pose = geometry.inverse(world_from_cam)
        pose[:3, 3] /= self.unit
        if self.front_end.reference is None:
            return self._first(frame, pose)
        with self.stats.time("front end"):
            step = self.front_end.follow(frame, with_pose=False)
        if self.front_end.is_lost(step):
            return self._insert(frame, pose, {}) if self._shows_another_place(frame, pose) else []
        self._lights[-1] = FrameLight(index, observed(self.graph, step.reference, frame, step.matches))
        if is_held_out(index) or not self._moved(step, frame, pose):
            only = len(self.graph.keyframes) == 1
            if only and is_held_out(step.reference) and not is_held_out(index):  # this one is as good
                self.graph.remove(step.reference)
                return self._first(frame, pose)
            self._tail.add(frame, step)
            self._poses = {i: p for i, p in self._poses.items() if i in self._tail.indices} | {index: pose}
            self._wait(step.reference, _Waiting(frame.bare(), self._lights[-1], world_from_cam))
            return []
        return self._insert(frame, pose, {step.reference: step.matches})

    @property
    def pending(self) -> set[int]:
        """Frames that may still be given out, as keyframes or between them."""
        return set(self._complete).union(self._tail.indices, *self._between.values())

    def between(self, keyframe: int) -> list[Between]:
        """Frames that were followed from this keyframe, once it is complete, in the unit of the given poses. Held-out
        frames never are; at most `frames_between`, spread evenly over the time."""
        found = []
        for index, waiting in sorted(self._between.pop(keyframe, {}).items()):
            pose = self.keyframe(keyframe).cam_from_world @ waiting.world_from_cam
            exposure = exposure_from(self.photometer, waiting.light, keyframe)
            found.append(Between(index, keyframe, pose, exposure, None))
        return found

    def finish(self) -> list[int]:
        """The stream has ended: the last keyframes, one of them of the last frames if they show something new."""
        complete: list[int] = []
        if last := self._tail.last(self.choice):
            frame, step = last
            complete = self._insert(frame, self._poses[frame.index], {step.reference: step.matches})
        self.photometer.update(at_the_end=True)
        self.stats.count(HELD_OUT, sum(is_held_out(index) for index in self.graph.keyframes))
        complete, self._complete, self._tail = complete + self._complete, [], Tail()
        return complete

    def keyframe(self, index: int) -> Keyframe:
        """A keyframe in the unit of the given poses."""
        keyframe = self.graph.keyframes[index]
        return replace(
            keyframe,
            cam_from_world=geometry.scaled(keyframe.cam_from_world, self.unit),
            inverse_depth=keyframe.inverse_depth / self.unit,
            information=keyframe.information * self.unit**2,
        )

    def exposures(self) -> dict[int, np.ndarray]:
        """Color affines (3, 4) float32 of the frames that have one, after `finish`; none where light is steady."""
        known = self.photometer.of_frames(self._lights, np.ones(len(self._lights), bool))
        if known is None:
            return {}
        return {light.index: affine for light, affine in zip(self._lights, known) if np.isfinite(affine).all()}

    def _shows_another_place(self, frame: TrackingImage, pose: np.ndarray) -> bool:
        """Whether a frame that can't be followed is worth a keyframe: not in the dark, nor where the last one was, and
        not one that is held out, as the next one is as good."""
        assert self.front_end.reference is not None
        if is_held_out(frame.index) or frame.cells.textured.mean() < self.config.min_texture:
            return False
        last = self.front_end.reference.index
        if self._undecided:  # how far anything is
            return not np.array_equal(pose, self.graph.keyframes[last].cam_from_world)
        return bool(np.abs(pose @ self.graph.world_from_cam(last) - np.eye(4)).max() > STAYED)

    def _moved(self, step: Step, frame: TrackingImage, pose: np.ndarray) -> bool:
        """Whether the image has changed enough since the reference, or would have without the camera's turning, which
        may keep what it circles in the middle."""
        limit, side = self.config.keyframe_choice.max_flow, frame.longer_side
        if self.choice.moved(step, side, limit):
            return True
        reference, found = self.graph.keyframes[step.reference], step.matches
        return bool(found.alive.any()) and self._error(reference, pose, found, 0.0) > limit * side

    def _wait(self, reference: int, frame: _Waiting) -> None:
        if self.config.frames_between == 0 or is_held_out(frame.image.index):
            return
        waiting = self._between.setdefault(reference, {})
        waiting[frame.image.index] = frame
        if len(waiting) > self.config.frames_between:
            del waiting[spared({index: each.image for index, each in waiting.items()})]

    def _insert(self, frame: TrackingImage, pose: np.ndarray, matches: dict[int, Matches]) -> list[int]:
        """A frame becomes a keyframe; returns those that are complete now. matches: of the reference's points."""
        for waiting in self._between.values():
            waiting.pop(frame.index, None)
        if self._undecided:
            pose = self._decide_unit(pose, matches)
        with self.stats.time("triangulation"):
            self.local_map.insert(frame, pose, 0, matches)
            members = self.local_map.members(0)
            recent = set(members[-self.config.local_map.window :])
            around = {n for i in recent for n in self.graph.neighbors(i)}
            solver = Solver(steps=self.config.local_map.steps, threads=self.threads)
            solution = self.graph.optimize(recent | around, set(), recent, solver)
        if solution.failure:
            self.stats.warn(f"triangulation failed: {solution.failure}")
        self.photometer.update()
        self.local_map.release_images(0)
        self.front_end.refer_to(frame)
        self.stats.count("keyframes")
        if self._undecided:
            known = self.graph.keyframes[frame.index].triangulated
            self._undecided = bool(known.mean() <= DEPTHS * frame.cells.textured.mean())
        complete, self._complete, self._tail, self._poses = self._complete, [frame.index], Tail(), {}
        return complete

    def _first(self, frame: TrackingImage, pose: np.ndarray) -> list[int]:
        ones = np.ones(len(frame.cells.points))
        self.graph.add(Keyframe(frame, pose, ones, 0.0 * ones, 0))
        self.front_end.refer_to(frame)
        self.stats.counts["keyframes"] = 1
        self._complete = [frame.index]
        return []

    def _decide_unit(self, pose: np.ndarray, matches: dict[int, Matches]) -> np.ndarray:
        """From two keyframes that are apart: the depth that explains the flow between them is the unit.

        pose (4, 4): of the second; returned in the unit as it is then. Without matches that is a guess for a start.
        While the camera only turns no depth explains anything, and the next two are asked.
        """
        assert self.front_end.reference is not None
        first = self.graph.keyframes[self.front_end.reference.index]
        baseline = float(np.linalg.norm((pose @ self.graph.world_from_cam(first.index))[:3, 3]))
        if baseline <= 0.0:
            return pose
        ratio = FIRST_RATIO
        for found in matches.values():
            ratios = [0.0, *np.geomspace(1e-3, 3.0, 40).tolist()]  # the first one: infinitely far
            errors = [self._error(first, pose, found, each / baseline) for each in ratios]
            best = int(np.argmin(errors))
            if errors[best] > errors[0] - PARALLAX:
                return pose
            ratio, self._undecided = ratios[best], False
        scale = baseline / ratio
        self.unit *= scale
        for keyframe in self.graph.keyframes.values():
            keyframe.cam_from_world = _scaled(keyframe.cam_from_world, scale)
            keyframe.inverse_depth = np.ones_like(keyframe.inverse_depth)  # none was known
            keyframe.information = np.zeros_like(keyframe.information)
        return _scaled(pose, scale)

    def _error(self, first: Keyframe, pose: np.ndarray, found: Matches, inverse_depth: float) -> float:
        """Pixels, median, by which matches miss a camera at this pose (4, 4), had all points this inverse depth."""
        pixels, _ = reproject(
            np.stack([first.cam_from_world, pose]),
            np.full_like(first.inverse_depth, inverse_depth)[None],
            first.points.T[None].astype(np.float64),
            self.graph.intrinsics,
            np.array([0]),
            np.array([1]),
        )
        return float(np.median(np.linalg.norm(pixels[0].T - found.target, axis=1)[found.alive]))


def _scaled(pose: np.ndarray, unit: float) -> np.ndarray:
    """A pose (4, 4) in another unit."""
    scaled = pose.copy()
    scaled[:3, 3] /= unit
    return scaled


__all__ = ["PosedTracker"]
