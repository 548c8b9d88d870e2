"""A new keyframe becomes part of the map: coarse depth, edges to its neighbors, bundle adjustment of the window."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from mvsgs_core import native
from mvsgs_core.setting_ranges import above, at_least, within
from mvsgs_core.tracking.estimation.bundle_adjustment import Solution, Solver
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import CELL, TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.steps import Steps, whole

FEW = 256  # keyframes of which the flow to each is computed; of more, to those within reach
MUST_STAND = 0.8  # of the matches: if more are left out because their points move, the map is what is wrong
REACH = 5.0  # median depths of the scene


@dataclass(frozen=True)
class LocalMapConfig:
    recent: int = 3  # keyframes before, matched both ways
    proximity: int = 3  # older keyframes that see the same, matched both ways
    proximity_flow: float = 0.25  # of the longer side: largest mean flow to such a keyframe
    window: int = 12  # keyframes in the local bundle adjustment; the two oldest poses are held
    steps: int = 5  # of the local bundle adjustment
    robust_scale: float = 1.0  # pixels
    tolerance: float = (
        0.01  # fraction of the cost: a step that gains less is the last (0.001 costs more and gains nothing)
    )
    # of the textured points that an edge must have found: the few that a car still sees two keyframes later hold the
    # scale (with .25 each is tied to its neighbors alone), and below .15 they are worse ones
    min_fraction: float = 0.15

    def __post_init__(self) -> None:
        at_least(self, recent=1, proximity=0, proximity_flow=0, window=2, steps=0, tolerance=0)
        above(self, robust_scale=0)
        within(self, min_fraction=(0, 1))


class LocalMap:
    """Grows the graph by one keyframe at a time."""

    def __init__(self, graph: KeyframeGraph, matcher: Matcher, config: LocalMapConfig, threads: int) -> None:
        self.graph = graph
        self.matcher = matcher
        self.config = config
        self.threads = threads

    def insert(
        self, image: TrackingImage, cam_from_world: np.ndarray, segment: int, matches: dict[int, Matches]
    ) -> Keyframe:
        """Adds a keyframe with its pose; `matches`: points of older keyframes, by index, found in it."""
        return whole(self.inserting(image, cam_from_world, segment, matches))

    def inserting(
        self, image: TrackingImage, cam_from_world: np.ndarray, segment: int, matches: dict[int, Matches]
    ) -> Steps[Keyframe]:
        """`insert`, an edge a step."""
        inverse_depth = self._propagate_depth(image, cam_from_world, matches)
        keyframe = Keyframe(image, cam_from_world, inverse_depth, np.zeros(len(inverse_depth)), segment)
        keyframe.static = self._propagate_static(image, matches)
        earlier = self.members(segment)
        self.graph.add(keyframe)
        yield
        recent, proximity = earlier[-self.config.recent :], self.config.proximity
        if not set(matches) <= set(recent):  # the camera was followed from an old keyframe: the newest are elsewhere
            recent, proximity = sorted(matches), proximity + self.config.recent - len(matches)
        for index in recent:
            if index in matches:
                self.graph.connect(index, image.index, matches[index], self.config.min_fraction)
            else:
                self.match_edge(index, image.index)
                yield
            self.match_edge(image.index, index)
            yield
        near = set(recent)
        for index in self.nearby(image.index, [i for i in earlier if i not in near], proximity):
            self.match_edge(image.index, index)
            yield
            self.match_edge(index, image.index)
            yield
        return keyframe

    def members(self, segment: int) -> list[int]:
        return self.graph.keyframes.members(segment)

    def largest(self) -> list[int]:
        """Members of the segment that most keyframes of this stream are in; none where it has no keyframe."""
        own = [keyframe.segment for index, keyframe in self.graph.keyframes.items() if index >= 0]
        return self.members(max(sorted(set(own)), key=own.count)) if own else []

    def window(self, segment: int) -> list[int]:
        """The newest keyframes, which the local bundle adjustment changes."""
        return self.members(segment)[-self.config.window :]

    def release_images(self, segment: int) -> None:
        """Forgets what was computed of keyframes that were matched since the last time and are not in the window."""
        self.release_images_but(set(self.window(segment)))

    def release_images_but(self, kept: Set[int]) -> None:
        """Forgets what was computed of all other keyframes that were matched since the last time: of thousands few."""
        for index in set(self.matcher.used) - kept:
            if index in self.graph.keyframes:
                self.graph.keyframes[index].image.release()
                del self.matcher.used[index]

    def match_edge(self, source: int, to: int) -> bool:
        """Matches an edge from where the map says the points should be; not one that too few can be seen along.

        Features could only find what contradicts the map: they are for a pose that is not known.
        """
        guess, inside = self.graph.predict(source, to)
        textured = self.graph.keyframes[source].image.cells.textured
        if (inside & textured).sum() < self.config.min_fraction * textured.sum():
            return False
        a, b = self.graph.keyframes[source].image, self.graph.keyframes[to].image
        matches, _ = self.matcher.match(a, b, guess, 0.0)
        return self.graph.connect(source, to, matches, self.config.min_fraction)

    def nearby(self, index: int, candidates: list[int], count: int, apart: int = 2) -> list[int]:
        """Keyframes that see the same from close by: smallest mean flow first, no two next to each other in time."""
        places = self._within_reach(index, candidates)
        flows = self.graph_flow(index, [candidates[n] for n in places])
        limit = self.config.proximity_flow * self.graph.keyframes[index].image.longer_side
        order = {candidates[n]: n for n in places}
        chosen: list[int] = []
        for candidate in sorted(flows, key=lambda c: flows[c]):
            if flows[candidate] > limit or len(chosen) == count:
                break
            if all(abs(order[candidate] - order[c]) >= apart for c in chosen):
                chosen.append(candidate)
        return chosen

    def _within_reach(self, index: int, candidates: list[int]) -> list[int]:
        """Places in the list: of many keyframes those whose flow may be small at all, not far away nor turned away."""
        if len(candidates) <= FEW:
            return list(range(len(candidates)))
        poses = self.graph.keyframes.poses(candidates)
        keyframe = self.graph.keyframes[index]
        apart = poses[:, :3, :3] @ self.graph.world_from_cam(index)[:3, 3] + poses[:, :3, 3]
        near = np.linalg.norm(apart, axis=1) < REACH * keyframe.median_depth
        turned = poses[:, 2, :3] @ keyframe.cam_from_world[2, :3]
        return list(np.flatnonzero(near & (turned > 0.5)).tolist())

    def graph_flow(self, index: int, candidates: list[int], min_overlap: float = 0.5) -> dict[int, float]:
        """Mean flow in pixels from keyframe `index` to each candidate, where enough of it would be seen there."""
        if not candidates:
            return {}
        keyframe = self.graph.keyframes[index]
        some = np.flatnonzero(keyframe.image.cells.textured)[::4]
        if len(some) == 0:
            return {}
        fx, fy, cx, cy = self.graph.intrinsics
        u, v = keyframe.points[some].astype(np.float64).T
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
        poses = np.stack([self.graph.keyframes[c].cam_from_world for c in candidates])
        relative = poses @ self.graph.world_from_cam(index)
        points = relative[:, :3, :3] @ rays + relative[:, :3, 3:] * keyframe.inverse_depth[some]
        z = np.where(points[:, 2] > 0.05, points[:, 2], np.inf)
        to_u, to_v = fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy
        height, width = keyframe.image.size
        inside = np.isfinite(z) & (to_u >= 0) & (to_v >= 0) & (to_u < width) & (to_v < height)
        seen = inside.sum(axis=1)
        flow = np.where(inside, np.hypot(to_u - u, to_v - v), 0.0).sum(axis=1) / np.maximum(seen, 1)
        return {c: float(f) for c, f, n in zip(candidates, flow, seen) if n > min_overlap * len(some)}

    def from_pose(self, pose: np.ndarray, candidates: list[int], limit: float) -> list[int]:
        """Those whose points would move less than `limit` pixels to a camera at this pose (4, 4), nearest first."""
        flows = {}
        for index in candidates:
            keyframe = self.graph.keyframes[index]
            # A cheap bound first: the optical axes must nearly agree.
            if float(keyframe.cam_from_world[2, :3] @ pose[2, :3]) < 0.9:
                continue
            at, inside = self.graph.predict_pose(index, pose)
            seen = inside & keyframe.triangulated
            if seen.sum() > 0.7 * keyframe.triangulated.sum():
                flows[index] = float(np.mean(np.linalg.norm(at - keyframe.points, axis=1)[seen]))
        return sorted((index for index in flows if flows[index] < limit), key=lambda index: flows[index])

    def agreement(self, index: int, pixels: float = 2.0) -> float:
        """Fraction of the matches to and from a keyframe that its pose and the depths explain."""
        good, total, every = 0, 0.0, 0
        for source, to in self.graph.edges.of([index]):
            edge = self.graph.edges[source, to]
            expected, _ = self.graph.predict(source, to)
            found, still = edge.found, self.graph.keyframes[source].still
            seen = found & still
            with np.errstate(invalid="ignore"):
                good += int((np.linalg.norm(expected - edge.target.T, axis=1)[seen] < pixels).sum())
            total += int(seen.sum())
            every += int(found.sum())
        total = max(total, MUST_STAND * every)
        return good / total if total else 0.0

    def adjust_window(self, newest: int) -> Solution:
        """Bundle adjustment of the newest keyframes; older neighbors take part, held."""
        members = self.members(self.graph.keyframes[newest].segment)
        window = members[-self.config.window :]
        young = len(members) <= len(window)  # nothing older holds the scale: it is put back afterwards
        held = {window[0]} if young else set(window[:2])
        around = {n for index in window for n in self.graph.neighbors(index)} & set(members)
        solver = Solver(
            steps=self.config.steps,
            robust_scale=self.config.robust_scale,
            tolerance=self.config.tolerance,
            threads=self.threads,
        )
        before = [self.graph.keyframes[index].inverse_depth for index in window]
        solution = self.graph.optimize(set(window) | around, set(window) - held, set(window), solver)
        if young:
            now = [self.graph.keyframes[index] for index in window]
            ratios = [
                np.median((k.inverse_depth / old)[k.triangulated])
                for k, old in zip(now, before)
                if k.triangulated.any()
            ]
            self.graph.rescale(window, float(np.median(ratios)) if ratios else 1.0)
        return solution

    def _propagate_depth(self, image: TrackingImage, pose: np.ndarray, matches: dict[int, Matches]) -> np.ndarray:
        """Inverse depths (M,): the median of the five nearest points of other keyframes found or expected here."""
        at, depths = [], []
        for index, found in matches.items():
            keyframe = self.graph.keyframes[index]
            expected, inside = self.graph.predict_pose(index, pose)
            seen = found.alive | inside
            relative = pose @ self.graph.world_from_cam(index)
            fx, fy, cx, cy = self.graph.intrinsics
            u, v = keyframe.points.T.astype(np.float64)
            row = relative[2]
            z = row[0] * (u - cx) / fx + row[1] * (v - cy) / fy + row[2] + row[3] * keyframe.inverse_depth
            seen &= z > 0.05
            if (seen & keyframe.triangulated).sum() > 50:
                seen &= keyframe.triangulated
            at.append(np.where(found.alive[:, None], found.target, expected)[seen])
            depths.append((keyframe.inverse_depth / np.where(z > 0.05, z, 1.0))[seen])
        points = np.concatenate(at) if at else np.zeros((0, 2))
        if len(points) == 0:
            return np.ones(len(image.cells.points))
        values = np.concatenate(depths)
        near = native.load("tracking").median_of_nearest(
            points, values, image.cells.points.astype(np.float64), 5, float(image.longer_side)
        )
        return np.where(np.isfinite(near), near, np.median(values))

    def _propagate_static(self, image: TrackingImage, matches: dict[int, Matches]) -> np.ndarray:
        """Weights (M,): the median of the five nearest points of others that were found here; 1 where none was."""
        at = [found.target[found.alive] for found in matches.values()]
        weights = [self.graph.keyframes[index].static[found.alive] for index, found in matches.items()]
        if not any(len(some) for some in at):
            return np.ones(len(image.cells.points))
        near = native.load("tracking").median_of_nearest(
            np.concatenate(at), np.concatenate(weights), image.cells.points.astype(np.float64), 5, 2.0 * CELL
        )
        return np.where(np.isfinite(near), near, 1.0)


__all__ = ["LocalMap", "LocalMapConfig"]
