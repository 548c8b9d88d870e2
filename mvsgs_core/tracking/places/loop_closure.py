"""Loops: an old keyframe seen again moves the map, by a Sim(3) pose graph, or joins two segments."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.setting_ranges import at_least
from mvsgs_core.tracking.estimation.pose_graph import SimilarityEdges, scale_of
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.local_map import LocalMap
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch, relative_scale, verifying_place
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.places.thinning import UNMATCHED, joining, solve_thinned
from mvsgs_core.tracking.steps import Steps


@dataclass(frozen=True)
class LoopConfig:
    max_candidates: int = 2  # keyframes that are looked at, for each new one
    min_gap: int = 10  # keyframes: nearer ones are no loop
    max_disagreement: float = 0.03  # of depth, radians, half of the scale: below, the map only gains an edge
    criteria: PoseCriteria = field(default_factory=PoseCriteria)

    def __post_init__(self) -> None:
        at_least(self, max_candidates=0, min_gap=0, max_disagreement=0)


@dataclass(frozen=True)
class Closure:
    """A verified loop. `moved`: the map was changed by more than a bundle adjustment would."""

    source: int
    to: int
    moved: bool
    joined: int | None = None  # segment that is no more
    failure: str = ""


@dataclass
class LoopCloser:
    graph: KeyframeGraph
    local_map: LocalMap
    retrieval: Retrieval
    config: LoopConfig

    def add(self, index: int) -> None:
        """A keyframe that may be found again."""
        self.retrieval.add(index, self.graph.keyframes[index].image.features()[1])

    def searching(self, index: int) -> Steps[Closure | None]:
        """Looks for old keyframes in the image of this one, a part of a candidate's verification a step; the first that
        verifies is used.

        What is near, in time or by at most two edges, is no loop.
        """
        keyframe = self.graph.keyframes[index]
        order = self.local_map.members(keyframe.segment)
        place = order.index(index)
        near = set(order[max(0, place - self.config.min_gap) :]) | self.graph.neighbors(index) | {index}
        near |= {m for n in self.graph.neighbors(index) for m in self.graph.neighbors(n)}
        descriptors = keyframe.image.features()[1]
        yield
        usual = set(order[max(0, place - 2) : place])
        candidates = self.retrieval.query(descriptors, self.config.max_candidates, near, usual)
        yield
        for candidate in candidates:
            found = yield from verifying_place(
                self.graph, self.local_map.matcher, candidate, keyframe.image, self.config.criteria
            )
            yield
            if found is None:
                continue
            scale = relative_scale(self.graph, found, index)
            if scale is not None:
                return self.close(found, index, scale)
        return None

    def close(self, found: PlaceMatch, index: int, scale: float) -> Closure:
        """Moves the map so that the place match holds.

        scale: unit of keyframe `index` over that of the keyframe found.
        """
        old, new = self.graph.keyframes[found.index], self.graph.keyframes[index]
        if old.segment != new.segment:
            joined, moved = self._join(found, index, scale), True
        else:
            joined, moved = None, not self._disagreement(found, index, scale) < self.config.max_disagreement
        if joined is None and moved:
            failure = self._spread_correction(found, index, scale)
            if failure:
                return Closure(found.index, index, False, failure=failure)
        self.graph.connect(found.index, index, found.matches, self.config.criteria.min_fraction)
        self.local_map.match_edge(index, found.index)
        return Closure(found.index, index, moved, joined)

    def _disagreement(self, found: PlaceMatch, index: int, scale: float) -> float:
        difference = found.localization.cam_from_world @ self.graph.world_from_cam(index)
        shift = float(np.linalg.norm(difference[:3, 3])) / self.graph.keyframes[index].median_depth
        turn = float(np.linalg.norm(geometry.so3_log(difference[:3, :3])))
        return max(shift, turn, 0.5 * abs(float(np.log(scale))))

    def _measured(self, found: PlaceMatch, index: int, scale: float) -> np.ndarray:
        """Similarity (4, 4): camera `index`, in its own unit, from the camera of the keyframe found."""
        relative = found.localization.cam_from_world @ self.graph.world_from_cam(found.index)
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = scale * relative[:3, :3], scale * relative[:3, 3]
        return result

    def _spread_correction(self, found: PlaceMatch, index: int, scale: float) -> str:
        """The loop's error is spread over its segment by a pose graph; returns why that failed, or nothing."""
        order = self.local_map.members(self.graph.keyframes[index].segment)
        number = {k: n for n, k in enumerate(order)}
        poses = np.stack([self.graph.keyframes[k].cam_from_world for k in order])
        unit = float(np.median([self.graph.keyframes[k].median_depth for k in order]))
        tied = self.graph.edges.of(order)
        matched = {(number[min(a, b)], number[max(a, b)]) for a, b in tied if a in number and b in number}
        unmatched = joining(len(order), matched)
        pairs = sorted(matched | unmatched)
        source, to = np.array(pairs).T
        sigma = np.tile([0.01 * unit, 0.005, 0.01], (len(pairs) + 1, 1))
        sigma[[n for n, pair in enumerate(pairs) if pair in unmatched]] *= UNMATCHED
        edges = SimilarityEdges(
            source=np.append(source, number[found.index]),
            to=np.append(to, number[index]),
            relative=np.concatenate(
                [poses[to] @ geometry.inverse(poses[source]), [self._measured(found, index, scale)]]
            ),
            sigma=sigma,
        )
        solution = solve_thinned(poses, edges)
        if solution.failure or not np.isfinite(solution.similarities).all():
            return solution.failure or "the pose graph's solution is not finite"
        self._apply(order, solution.similarities)
        return ""

    def _join(self, found: PlaceMatch, index: int, scale: float) -> int:
        """Brings the newer of the two segments into the frame and unit of the older one; returns which is no more.

        Keyframes of a map that is gone on with have negative indices: it stays where it is.
        """
        old, new = self.graph.keyframes[found.index].segment, self.graph.keyframes[index].segment
        measured = self._measured(found, index, scale) @ self.graph.keyframes[found.index].cam_from_world
        other_from_target = self.graph.world_from_cam(index) @ measured
        target, joined = old, new
        if self.local_map.members(new)[0] < self.local_map.members(old)[0]:
            target, joined, other_from_target = new, old, np.linalg.inv(other_from_target)
        members = self.local_map.members(joined)
        self._apply(members, self.graph.keyframes.poses(members) @ other_from_target)
        for k in members:
            self.graph.keyframes[k].segment = target
        return joined

    def _apply(self, indices: list[int], similarities: np.ndarray) -> None:
        """Makes similarities (K, 4, 4) poses: the keyframes' units become the world's.

        Each loop is made of the poses that the one before left, which triples what rounding took from their rotations:
        after 26 it would be 1e-3, and scale drifts where the camera turns.
        """
        scales = scale_of(similarities)
        poses = np.tile(np.eye(4), (len(indices), 1, 1))
        poses[:, :3, :3] = geometry.nearest_rotation(similarities[:, :3, :3])
        poses[:, :3, 3] = similarities[:, :3, 3] / scales[:, None]
        for index, pose, scale in zip(indices, poses, scales.tolist()):
            keyframe = self.graph.keyframes[index]
            keyframe.cam_from_world = pose.copy()  # a view would keep all of them
            keyframe.inverse_depth = keyframe.inverse_depth * scale
            keyframe.information = keyframe.information / scale**2


__all__ = ["Closure", "LoopCloser", "LoopConfig"]
