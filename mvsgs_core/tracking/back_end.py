"""The whole map at once: edges between keyframes that see the same, matched again, and global bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.setting_ranges import at_least
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.bundle_adjustment import Solution, Solver
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import RecentImages
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.steps import Steps


@dataclass(frozen=True)
class BackEndConfig:
    max_edges: int = 6  # by proximity, from each keyframe
    max_error: float = 1.0  # pixels: edges that the map contradicts by more are matched again
    steps: int = 10  # of each global bundle adjustment
    robust_scales: tuple[float, ...] = (4.0, 1.0, 0.5)  # pixels, one bundle adjustment each
    max_keyframes: int = 300  # that are adjusted at once: a larger map is in blocks, its neighbors held

    def __post_init__(self) -> None:
        at_least(self, max_edges=0, max_error=0, steps=0, max_keyframes=2)
        if not all(scale > 0 for scale in self.robust_scales):
            raise ValueError(f"robust_scales={self.robust_scales}: each must be above 0")


class BackEnd:
    def __init__(self, graph: KeyframeGraph, local_map: LocalMap, config: BackEndConfig, threads: int) -> None:
        self.graph = graph
        self.local_map = local_map
        self.config = config
        self.threads = threads
        self.pending = 0  # steps of background bundle adjustment that are still to do

    def working(self, segment: int) -> Steps[str]:
        """A portion of the background work, if there is any: one step for each new keyframe.

        What is to be solved is set up in one step and solved in the other. Gives why it failed, if it did: then the
        rest of it is given up.
        """
        if self.pending == 0 or len(self.local_map.members(segment)) < 3:
            return ""
        solution = yield from self._adjusting(segment)
        self.pending = 0 if solution.failure else self.pending - 1
        return solution.failure

    def extend_edges(self, index: int, segment: int) -> int:
        """Adds edges from one keyframe to those that see the same; returns how many were matched."""
        others = [i for i in self.local_map.members(segment) if i != index]
        matched = 0
        for other in self.local_map.nearby(index, others, self.config.max_edges, apart=1):
            if (index, other) not in self.graph.edges:
                matched += 1
                self.local_map.match_edge(index, other)
        return matched

    def rematch_edges(self, index: int) -> int:
        """Matches again the edges from one keyframe that its poses and depths no longer agree with."""
        matched = 0
        for source, to in [pair for pair in self.graph.edges.of([index]) if pair[0] == index]:
            edge = self.graph.edges[source, to]
            expected, inside = self.graph.predict(source, to)
            seen = edge.found & inside
            if seen.sum() and np.median(np.linalg.norm(expected - edge.target.T, axis=1)[seen]) < self.config.max_error:
                continue
            matched += 1
            self.local_map.match_edge(source, to)
        return matched

    def put_right(self, segment: int, stats: Stats) -> None:
        """At the end of the stream: edges matched again, found by proximity, then global bundle adjustment."""
        members = self.local_map.members(segment)
        if len(members) < 3:
            return
        images = RecentImages()
        for index in members:
            stats.count("edges matched again", self.rematch_edges(index))
            stats.count("edges by proximity", self.extend_edges(index, segment))
            for near in sorted(self.graph.edges.reached([index])):
                images.use(self.graph.keyframes[near].image)
        for solution in self.adjust(segment):
            if solution.failure:
                stats.warn(f"global bundle adjustment failed: {solution.failure}")

    def adjust(self, segment: int) -> list[Solution]:
        """Global bundle adjustment; the median depth of the segment is kept."""
        members = self.local_map.members(segment)
        if len(members) < 3:
            return []
        before = self._median_inverse_depth(members)
        solutions = []
        for scale in self.config.robust_scales:
            solver = Solver(steps=self.config.steps, robust_scale=scale, lm=1e-5, threads=self.threads)
            for block in self._blocks(members):
                around = self.graph.edges.reached(block) & set(members)
                solutions.append(self.graph.optimize(around, set(block) - {members[0]}, set(block), solver))
        self.graph.rescale(members, self._median_inverse_depth(members) / before)
        return solutions

    def _adjusting(self, segment: int) -> Steps[Solution]:
        """One step of global bundle adjustment, of a large map around its newest keyframe."""
        members = self.local_map.members(segment)
        if len(members) > self.config.max_keyframes:
            return (yield from self._adjusting_around(members))
        before = self._median_inverse_depth(members)
        solver = Solver(steps=1, robust_scale=1.0, lm=1e-5, threads=self.threads)
        solution = yield from self.graph.optimizing(members, set(members[1:]), set(members), solver)
        self.graph.rescale(members, self._median_inverse_depth(members) / before)
        return solution

    def _adjusting_around(self, members: list[int]) -> Steps[Solution]:
        """One step of the keyframes that the fewest edges lead to from the newest; those around them are held."""
        block, among = {members[-1]}, set(members)
        while True:
            around = self.graph.edges.reached(block) & among
            if len(around) > self.config.max_keyframes or around == block:
                break
            block = around
        solver = Solver(steps=1, robust_scale=1.0, lm=1e-5, threads=self.threads)
        return (yield from self.graph.optimizing(around, block - {members[0]}, block, solver))

    def _blocks(self, members: list[int]) -> list[list[int]]:
        """All at once, or of a large map so many after another, each with half of those of the one before."""
        size = self.config.max_keyframes
        if len(members) <= size:
            return [members]
        starts = range(0, len(members) - size // 2, size // 2)
        return [members[start : start + size] for start in starts]

    def _median_inverse_depth(self, members: list[int]) -> float:
        return float(np.median([1.0 / self.graph.keyframes[index].median_depth for index in members]))


__all__ = ["BackEnd", "BackEndConfig"]
