"""Covisible keyframe reuse: where an old keyframe sees what the camera sees, it is followed and none is added.

So a camera that stays in a room stops to grow the graph: keyframes fill the space of views once, then only gaps in it.
Nothing is removed afterwards, so every keyframe that was ever published keeps its corrections.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mvsgs_core.setting_ranges import at_least, within
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.places.localization import localize


@dataclass(frozen=True)
class CovisibilityConfig:
    min_keyframes: int = 64  # of a map: smaller ones take every view, each makes them more accurate; 0: from the start
    max_flow: float = 0.13  # of the longer side: old keyframes nearer to a view than this are covisible; 0: none is
    min_age: int = 12  # references since a keyframe was made, before it is old: the local window, and its baselines
    max_candidates: int = 2  # old keyframes that are tried, the nearest first
    min_fraction: float = 0.6  # of the old keyframe's textured points: fewer found, and too much in the image is new
    min_inliers: float = 0.8  # fraction of its matches, within 2 pixels of one pose
    max_error: float = 2.0  # pixels, median between where the map says its points are and where they are: more is drift

    def __post_init__(self) -> None:
        at_least(self, min_keyframes=0, max_flow=0, min_age=0, max_candidates=0, max_error=0)
        within(self, min_fraction=(0, 1), min_inliers=(0, 1))


class CovisibleKeyframes:
    def __init__(self, graph: KeyframeGraph, local_map: LocalMap, config: CovisibilityConfig, threads: int) -> None:
        self.graph = graph
        self.local_map = local_map
        self.config = config
        self.solver = Solver(steps=8, robust_scale=1.0, threads=threads)
        self.followed: int | None = None  # the old keyframe that is the reference now
        self._references = 0  # how many keyframes were the reference, one after the other
        self._made: dict[int, int] = {}  # by keyframe: the value of `_references` then

    def made(self, index: int) -> None:
        """A keyframe was made and is the reference now."""
        self._made[index] = self._references
        self._refer(None)

    def known(self, keyframes: Iterable[int]) -> None:
        """Keyframes that were there before the stream: old ones."""
        self._made |= dict.fromkeys(keyframes, -self.config.min_age)

    def limit(self, reference: int, usual: float) -> float:
        """Median flow, as a fraction of the longer side, that makes another keyframe; usual: that of a young one."""
        return max(usual, self.config.max_flow) if reference == self.followed else usual

    def find(self, frame: TrackingImage, pose: np.ndarray, reference: int) -> PlaceMatch | None:
        """The old keyframe to follow from this frame on, whose pose (4, 4) was found against the reference.

        None where the view is new, or where the map contradicts itself: then a keyframe has to tie the two parts.
        """
        segment = self.graph.keyframes[reference].segment
        if self.config.max_flow == 0 or len(self.local_map.members(segment)) < self.config.min_keyframes:
            return None
        old = [index for index in sorted(self._tied_to(reference)) if self._is_old(index, segment)]
        near = self.local_map.from_pose(pose, old, self.config.max_flow * frame.longer_side)
        for index in near[: self.config.max_candidates]:
            found = self._verify(frame, pose, index)
            if found is not None:
                self._refer(index)
                return found
            self._release(index)
        return None

    def _verify(self, frame: TrackingImage, pose: np.ndarray, index: int) -> PlaceMatch | None:
        expected, _ = self.graph.predict_pose(index, pose)
        keyframe = self.graph.keyframes[index]
        matches, fraction = self.local_map.matcher.match(keyframe.image, frame, expected, 0.0)
        seen = matches.alive & keyframe.triangulated
        if fraction < self.config.min_fraction or not seen.any():
            return None
        apart = np.linalg.norm(self.graph.as_read(expected, frame) - matches.target, axis=1)[seen]
        if not np.median(apart) < self.config.max_error:
            return None
        found = localize(self.graph, index, matches, pose, self.solver)
        if found.failure or found.inliers < self.config.min_inliers:
            return None
        return PlaceMatch(index, matches, found)

    def _is_old(self, index: int, segment: int) -> bool:
        return (
            self.graph.keyframes[index].segment == segment
            and self._references - self._made.get(index, 0) >= self.config.min_age
        )

    def _tied_to(self, reference: int) -> set[int]:
        """Keyframes at most two edges away, the reference left out: what is not tied to it may have drifted."""
        edges = self.graph.edges
        return edges.reached(edges.reached([reference])) - {reference}

    def _refer(self, index: int | None) -> None:
        if self.followed is not None:
            self._release(self.followed)
        self.followed = index
        self._references += 1

    def _release(self, index: int) -> None:
        """Forgets the pyramid of an old image again; what still needs it computes it anew."""
        if index in self.graph.keyframes:
            self.graph.keyframes[index].image.release()


__all__ = ["CovisibilityConfig", "CovisibleKeyframes"]
