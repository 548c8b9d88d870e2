"""Follows the camera from frame to frame against a reference keyframe, mostly the newest."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np

from mvsgs_core import geometry
from mvsgs_core.setting_ranges import UNBOUNDED, at_least, within
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.graph import KeyframeGraph, Solved
from mvsgs_core.tracking.image import CELL, TrackingImage
from mvsgs_core.tracking.matching.flow import DenseInverseSearch, Matches, propagate, sample_field
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.places.localization import Localization, localize

FASTEST = 65504.0  # pixels a second: faster, of a timestamp that is wrong, is no number of an edge
SAME = 6.0  # gray levels by which two images of the same view differ, in the mean
BESIDE = 4.0  # of the flow of a frame that did not move: as much is seen beside what changes where it is masked
SURELY = 2.0  # times as many points as of a frame that is lost: the camera is not lost in the next one
AROUND = (3, 3)  # pixels of half size about a point: no masked one is among them, see MASK_MARGIN


@dataclass(frozen=True)
class FrontEndConfig:
    # of the longer side: median flow below which a frame did not move, but for noise
    still_flow: Annotated[float, UNBOUNDED] = 0.00025
    feature_fraction: float = 0.5  # of the textured points: fewer found, and features are tried
    lost_fraction: float = 0.2  # fewer found: the frame is lost
    lost_inliers: float = 0.5  # of the matches, within 2 pixels of one pose: fewer, and the frame is lost

    def __post_init__(self) -> None:
        at_least(self, still_flow=0)
        within(self, feature_fraction=(0, 1), lost_fraction=(0, 1), lost_inliers=(0, 1))

    def at(self, size: tuple[int, int], area: int) -> FrontEndConfig:
        """For images of a size (height, width), where these are meant for `area` pixels: of the more points that a
        larger one has fewer are enough."""
        return replace(self, lost_fraction=self.lost_fraction * min(1.0, area / (size[0] * size[1])))


@dataclass(frozen=True)
class Step:
    """One frame against the reference keyframe."""

    reference: int
    matches: Matches  # of the reference's points
    fraction: float  # of the textured points that were found
    flow: float  # pixels, median since the reference
    still: bool  # nothing moved since the last frame: nothing was done
    localization: Localization | None  # None where no pose was asked for
    then: Solved | None = None  # the reference when the pose was found against it

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) cam_from_world, where one was asked for."""
        assert self.localization is not None
        return self.localization.cam_from_world

    def pose_in(self, graph: KeyframeGraph) -> np.ndarray:
        """The same in the map as it is: a pose moves with its reference, and is in its unit."""
        now = graph.keyframes[self.reference]
        if self.then is None or (self.then[0] is now.cam_from_world and self.then[1] is now.inverse_depth):
            return self.pose
        cam_from_world, inverse_depth = self.then[:2]
        known = now.triangulated if now.triangulated.any() else np.ones(len(inverse_depth), bool)
        unit = float(np.median((inverse_depth / now.inverse_depth)[known]))
        return geometry.scaled(self.pose @ geometry.inverse(cam_from_world), unit) @ now.cam_from_world


class FrontEnd:
    """Holds the reference keyframe's points as they are propagated from frame to frame."""

    def __init__(self, graph: KeyframeGraph, matcher: Matcher, config: FrontEndConfig, threads: int) -> None:
        self.graph = graph
        self.matcher = matcher
        self.config = config
        self.between = DenseInverseSearch()
        self.solver = Solver(steps=8, robust_scale=1.0, threads=threads)
        self.reference: TrackingImage | None = None
        self.last: TrackingImage | None = None
        self.propagated = np.zeros((0, 2))  # (M, 2) where the reference's points were, or should have been, last
        self.pose: np.ndarray | None = None  # (4, 4) cam_from_world of the last frame
        self.step: Step | None = None

    def refer_to(self, image: TrackingImage) -> None:
        """Starts over from a new reference keyframe, which is also the last frame."""
        self.reference = self.last = image
        self.propagated = image.cells.points.astype(np.float64)
        itself = Matches(self.propagated, image.cells.textured.astype(np.float64))
        self.step = Step(image.index, itself, 1.0, 0.0, False, None)

    def resume(self, reference: TrackingImage, image: TrackingImage, matches: Matches, pose: np.ndarray | None) -> None:
        """Goes on from a frame whose matches with another keyframe, and pose (4, 4), are known."""
        self.refer_to(reference)
        alive = matches.alive
        near = propagate(
            reference.cells.points[alive], (matches.target - reference.cells.points)[alive], reference.cells.points
        )
        self.propagated = np.where(alive[:, None], matches.target, near)
        self.last, self.pose = image, pose
        self.step = Step(reference.index, matches, 1.0, 0.0, False, None)

    def found(self, place: PlaceMatch) -> Step:
        """Of a frame in which a keyframe was found."""
        textured = self.graph.keyframes[place.index].image.cells.textured.sum()
        fraction = float(place.matches.alive.sum() / max(1, textured))
        return Step(place.index, place.matches, fraction, np.inf, False, place.localization)

    def move_to(self, reference: TrackingImage, pose: np.ndarray) -> Step | None:
        """The last frame is followed from another keyframe from here on, whose pose (4, 4) is near its own.

        None, and the keyframe is the last frame, where it can't be. The images alone say where points are looked for:
        the depths of many are hardly known, and a wrong match would be followed on.
        """
        image = self.last
        assert image is not None
        self.refer_to(reference)
        self.pose = pose
        self.follow(image, with_pose=True)
        return self.step

    def follow(self, image: TrackingImage, with_pose: bool) -> Step:
        """Finds the reference's points in the next frame, and its pose where there is a map."""
        assert self.reference is not None
        assert self.last is not None
        field = self.between.field(self.last, image)
        moves = sample_field(field, self.propagated)
        if self.step is not None and self._rests(self.step.matches.alive, moves, image):
            return replace(self.step, still=True, localization=self.step.localization if with_pose else None)
        velocity = self.last.velocity
        self._set_velocity(image, field)
        guess = self.propagated + moves
        matches, fraction = self.matcher.match(self.reference, image, guess, self.config.feature_fraction)
        alive = matches.alive
        flow = np.inf
        if alive.any():
            flow = float(np.median(np.linalg.norm(matches.target[alive] - self.reference.cells.points[alive], axis=1)))
        found: Localization | None = None
        then: Solved | None = None
        if with_pose:
            then = self.graph.solved([self.reference.index])[self.reference.index]
            start = self.pose if self.pose is not None else self.graph.keyframes[self.reference.index].cam_from_world
            found = localize(self.graph, self.reference.index, matches, start, self.solver)
            guess, _ = self.graph.predict_pose(self.reference.index, found.cam_from_world)
        step = Step(self.reference.index, matches, fraction, flow, False, found, then)
        if self.is_lost(step):
            image.velocity, self.last.velocity = None, velocity
            self.last.__dict__.pop("cell_velocity", None)
        else:
            self.propagated = np.where(alive[:, None], matches.target, np.nan_to_num(guess, nan=-1e3))
            self.last = image
            self.pose = found.cam_from_world if found else None
            self.step = step
        return step

    def follows(self, image: TrackingImage, other: TrackingImage) -> bool:
        """Whether a camera could be followed from one image to another, whatever is followed now."""
        trial = copy(self)
        trial.refer_to(image)
        return not trial.is_lost(trial.follow(other, with_pose=False))

    def would_follow(self, image: TrackingImage, with_pose: bool) -> bool:
        """Whether `follow` would find enough of the next image for the one after it to be followed, too."""
        trial, last = copy(self), self.last
        assert last is not None
        velocity = last.velocity
        step = trial.follow(image, with_pose)
        if last.velocity is not velocity:  # it is for the next one to say
            last.velocity = velocity
            last.__dict__.pop("cell_velocity", None)
        return not trial.is_lost(step) and step.fraction >= SURELY * self.config.lost_fraction

    def is_lost(self, step: Step) -> bool:
        """Too few points found, or no pose that they agree on."""
        if step.fraction < self.config.lost_fraction or step.matches.alive.sum() < 30:
            return True
        found = step.localization
        return found is not None and (bool(found.failure) or found.inliers < self.config.lost_inliers)

    def _set_velocity(self, image: TrackingImage, field: np.ndarray) -> None:
        """Image velocity from the flow since the last frame, for the rolling shutter."""
        assert self.last is not None
        seconds = image.timestamp - self.last.timestamp
        if not 0.0 < abs(seconds) < 0.25:
            return
        height, width = image.size
        cells = cv2.resize(field, (width // CELL, height // CELL), interpolation=cv2.INTER_AREA)
        velocity = np.clip(cells / seconds, -FASTEST, FASTEST).astype(np.float32)
        for frame in (image, self.last):
            if frame.velocity is None:
                frame.velocity = velocity
                frame.__dict__.pop("cell_velocity", None)

    def _rests(self, seen: np.ndarray, moves: np.ndarray, image: TrackingImage) -> bool:
        """Whether the image shows what the last one does where the reference's points are.

        What is flat or masked has no flow, however the camera moves; nor has a lens that was covered, which changes.
        seen: (M,) bool, points found in the last image. moves: (M, 2) their flow since.
        """
        assert self.last is not None
        if not seen.any():
            return False
        limit, flow = self.config.still_flow * image.longer_side, _median_norm(moves[seen])
        if image.mask is not None and limit <= flow < BESIDE * limit:
            unchanged = replace(image, gray=np.where(image.mask, image.gray, self.last.gray))
            flow = _median_norm(sample_field(self.between.field(self.last, unchanged), self.propagated[seen]))
        if flow >= limit:
            return False
        change = cv2.blur(cv2.absdiff(self.last.half, image.half), AROUND)
        height, width = change.shape
        u, v = np.clip(0.5 * self.propagated[seen], 0, [width - 1, height - 1]).astype(int).T
        return float(np.mean(change[v, u])) < SAME


def _median_norm(vectors: np.ndarray) -> float:
    """Of (N, 2), at least one."""
    return float(np.median(np.linalg.norm(vectors, axis=1)))


__all__ = ["FrontEnd", "FrontEndConfig", "Step"]
