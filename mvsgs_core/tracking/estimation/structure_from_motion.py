"""Structure from motion: poses and depths of the first keyframes from nothing but their matches.

Two starts from pairs of views and one from identity poses are bundle adjusted; the lowest cost wins, if the cameras
moved enough against the depths for it to mean anything. Where the calibration is known, what moves is then told from
what stands: things that move may have bent what all points together gave.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.setting_ranges import at_least
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solution, Solver, adjust, reproject
from mvsgs_core.tracking.estimation.static_points import STILL, static_weights
from mvsgs_core.tracking.estimation.two_view_starts import two_view_poses, widest_pairs
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.steps import Steps

PAIRS = 4  # of keyframes that poses are taken from ...
EPIPOLAR = (0.3, 1.0)  # ... by the matches that are so many pixels from their epipolar lines
TRIED = 2  # of those poses, the ones in which the most stands still
WEIGHINGS = 4  # rounds in which a start's points are weighed by how still they stand


@dataclass(frozen=True)
class ReconstructionCriteria:
    """When a reconstruction counts as one. Pixels at the tracker's size."""

    certain_cost: float = 0.2  # below, no other start is tried
    max_cost: float = 0.7  # robust cost (Cauchy, 1 pixel) a match
    min_turn_error: float = 0.8  # pixels by which the best rotations must miss the matches, median of the worst pair
    min_parallax: float = 2.0  # pixels, median over the matches of the longest pair: what a rotation can't explain
    min_still: float = 0.5  # of the points, that do not seem to move
    min_baseline: float = 0.03  # largest distance of two cameras over the median depth

    def __post_init__(self) -> None:
        at_least(self, certain_cost=0, max_cost=0, min_turn_error=0, min_parallax=0, min_still=0, min_baseline=0)


@dataclass(frozen=True)
class Reconstruction:
    """`failure` is empty where it may be used, else the kind of reason, a colon, the figures."""

    cam_from_world: np.ndarray  # (K, 4, 4)
    inverse_depth: np.ndarray  # (K, M), median 1
    information: np.ndarray  # (K, M)
    static: np.ndarray  # (K, M) weight of each point, see `static_points`
    cost: float  # a match
    failure: str
    focal_factor: float = 1.0  # on the graph's focal length, where it was free


def reconstructing(
    graph: KeyframeGraph, order: list[int], criteria: ReconstructionCriteria, threads: int, free_focal: bool = False
) -> Steps[Reconstruction]:
    """Solves keyframes `order` of the graph, without changing it, a bundle adjustment a step.

    free_focal: the focal length is unknown too.
    """
    everything = set(order)
    problem = graph.problem(order, everything - {order[0]}, everything)
    k, m = problem.inverse_depth.shape
    none = Reconstruction(problem.cam_from_world, np.ones((k, m)), np.zeros((k, m)), np.ones((k, m)), np.inf, "")
    turned = yield from _rotation_error(problem, threads, free_focal)
    if turned < criteria.min_turn_error:
        reason = (
            f"no parallax: a camera that only turned explains the matches to {turned:.1f} pixels, "
            f"{criteria.min_turn_error:.1f} or more are parallax"
        )
        return replace(none, failure=reason)
    views = [two_view_poses(graph, order, pair) for pair in widest_pairs(graph, order, 2)]
    starts = [np.tile(np.eye(4), (k, 1, 1)), *(poses for poses in views if poses is not None)]
    matched = float(np.sum(_matched(problem)))
    yield
    best = yield from _best_of(problem, starts, criteria.certain_cost * matched, threads, free_focal)
    if best is None:
        return replace(none, failure="no start could be solved: every bundle adjustment failed")
    static = np.ones((k, m))
    if graph.weighing:
        best, static = yield from _stillest(problem, best, graph, order, threads)
    poses, depths = best.cam_from_world, best.inverse_depth
    known = best.information * depths**2 > 10.0
    scale = float(np.median(depths[known])) if known.sum() > 50 else float(np.median(depths))
    poses = geometry.scaled(poses, scale)
    depths = depths / scale
    centers = geometry.inverse(poses)[:, :3, 3]
    baseline = float(np.max(np.linalg.norm(centers[:, None] - centers[None], axis=-1)))
    intrinsics = graph.intrinsics * [best.focal_factor, best.focal_factor, 1.0, 1.0]
    parallax = _parallax(replace(problem, cam_from_world=poses, inverse_depth=depths, intrinsics=intrinsics))
    cost = best.cost / max(float(np.sum(_standing(problem, static))), 1.0)
    failure = ""
    if not np.isfinite(cost) or cost > criteria.max_cost:
        failure = f"the matches do not agree: cost {cost:.2f} a match, {criteria.max_cost:.2f} at most"
    elif (still := float(np.mean(static > STILL))) < criteria.min_still:
        failure = (
            f"the matches do not agree: {100 * still:.0f} % of the points stand still, "
            f"{100 * criteria.min_still:.0f} % needed"
        )
    elif parallax < criteria.min_parallax or baseline < criteria.min_baseline:
        failure = (
            f"too little parallax: {parallax:.1f} pixels of {criteria.min_parallax:.1f} needed, cameras {baseline:.3f} "
            f"of the depth apart, {criteria.min_baseline:.3f} needed"
        )
    elif known.sum() < 0.3 * np.mean(_matched(problem)) * k * m:
        failure = f"too few points could be triangulated: {known.sum()} of {k * m}"
    return Reconstruction(poses, depths, best.information * scale**2, static, cost, failure, best.focal_factor)


def _best_of(
    problem: Graph, starts: list[np.ndarray], certain_cost: float, threads: int, free_focal: bool
) -> Steps[Solution | None]:
    """The solution of lowest cost from several poses (K, 4, 4) and unit depths; the first that is certain ends it."""
    best: Solution | None = None
    ones = np.ones_like(problem.inverse_depth)
    for poses in starts:
        current = replace(problem, cam_from_world=poses, inverse_depth=ones, prior=ones)
        for scale, steps in ((8.0, 12), (3.0, 8), (1.0, 12)):
            held = np.full_like(ones, 0.05 if scale > 1.0 else 0.0)  # keeps depths from running away at first
            last = free_focal and scale == 1.0
            solver = Solver(steps=2 * steps if last else steps, robust_scale=scale, lm=1e-3, threads=threads)
            attempt = adjust(replace(current, prior_weight=held, free_focal=last), solver)
            yield
            if attempt.failure:
                break
            current = replace(current, cam_from_world=attempt.cam_from_world, inverse_depth=attempt.inverse_depth)
        if not attempt.failure and (best is None or attempt.cost < best.cost):
            best = attempt
            if best.cost < certain_cost:
                break
    return best


def _stillest(
    problem: Graph, found: Solution, graph: KeyframeGraph, order: list[int], threads: int
) -> Steps[tuple[Solution, np.ndarray]]:
    """What the most matches stand still in, and the weights of its points (K, M): that solution with them weighed, or
    one that has them weighed from the start on. Things that move may have bent the first."""
    best, static = yield from _weighed(problem, found, threads)
    tried = []
    for pair, epipolar in itertools.product(widest_pairs(graph, order, PAIRS), EPIPOLAR):
        poses = two_view_poses(graph, order, pair, epipolar)
        yield
        if poses is None:
            continue
        held = replace(problem, cam_from_world=poses, inverse_depth=np.ones_like(problem.inverse_depth))
        depths = yield from _depths(held, threads)
        if depths is not None:
            weights = _weights(replace(held, inverse_depth=depths.inverse_depth))
            tried.append((float(np.sum(_standing(problem, weights))), depths))
    for _, depths in sorted(tried, key=lambda each: -each[0])[:TRIED]:
        attempt, weights = yield from _weighed(problem, depths, threads)
        if np.sum(_standing(problem, weights)) > np.sum(_standing(problem, static)):
            best, static = attempt, weights
    return best, static


def _depths(problem: Graph, threads: int) -> Steps[Solution | None]:
    """Depths for poses that are held."""
    problem = replace(problem, free_pose=np.zeros_like(problem.free_pose))
    for scale in (8.0, 3.0, 1.0):
        solution = adjust(problem, Solver(steps=10, robust_scale=scale, threads=threads))
        yield
        if solution.failure:
            return None
        problem = replace(problem, inverse_depth=solution.inverse_depth)
    return solution


def _weighed(problem: Graph, found: Solution, threads: int) -> Steps[tuple[Solution, np.ndarray]]:
    """The solution again, of points weighed by how still they stand, and their weights (K, M)."""
    for _ in range(WEIGHINGS):
        problem = replace(problem, cam_from_world=found.cam_from_world, inverse_depth=found.inverse_depth)
        problem = replace(problem, static=_weights(problem))
        again = adjust(problem, Solver(steps=12, lm=1e-3, threads=threads))
        yield
        if again.failure:
            break
        found = again
    assert problem.static is not None
    return found, problem.static


def _weights(problem: Graph) -> np.ndarray:
    """(K, M): `static_weights`, 1 of what was not seen again."""
    weights = static_weights(problem)
    return np.where(np.isnan(weights), 1.0, weights)


def _rotation_error(problem: Graph, threads: int, free_focal: bool) -> Steps[float]:
    """Pixels by which the best rotations miss the matches: the largest median over the edges."""
    k, m = problem.inverse_depth.shape
    far = replace(
        problem,
        cam_from_world=np.tile(np.eye(4), (k, 1, 1)),
        inverse_depth=np.full((k, m), 1e-9),
        free_depth=np.zeros(k, bool),
        free_focal=free_focal,
    )
    for scale in (8.0, 2.0):
        solution = adjust(far, Solver(steps=10, ep=1e-3, robust_scale=scale, threads=threads))
        if solution.failure:
            return np.inf
        intrinsics = far.intrinsics * [solution.focal_factor, solution.focal_factor, 1.0, 1.0]
        far = replace(far, cam_from_world=solution.cam_from_world, intrinsics=intrinsics)
        yield
    pixels, z = reproject(far.cam_from_world, far.inverse_depth, far.pixels, far.intrinsics, far.source, far.to)
    return _largest_median(np.linalg.norm(pixels - far.target, axis=1), _matched(far) & (z > 0.05))


def _parallax(problem: Graph) -> float:
    """Largest median, over the edges, of the distance between a point's projection and that at infinity."""
    at_infinity = replace(problem, inverse_depth=np.zeros_like(problem.inverse_depth))
    (full, z), (far, z_far) = (
        reproject(p.cam_from_world, p.inverse_depth, p.pixels, p.intrinsics, p.source, p.to)
        for p in (problem, at_infinity)
    )
    return _largest_median(np.linalg.norm(full - far, axis=1), _matched(problem) & (z > 0.05) & (z_far > 0.05))


def _matched(problem: Graph) -> np.ndarray:
    """(E, M) bool: points that were found."""
    return problem.information[:, 0] > 0


def _standing(problem: Graph, static: np.ndarray) -> np.ndarray:
    """(E, M) weight of each match whose point has a weight (K, M)."""
    return np.asarray(_matched(problem) * static[problem.source])


def _largest_median(distance: np.ndarray, seen: np.ndarray) -> float:
    """Of distances (E, M), over the edges that see enough of them."""
    return max((float(np.median(d[s])) for d, s in zip(distance, seen) if s.sum() > 30), default=0.0)


__all__ = ["Reconstruction", "ReconstructionCriteria", "reconstructing"]
