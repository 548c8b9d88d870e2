"""The pose of one frame against keyframes whose depths are known: motion-only bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solver, adjust, reproject
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.matching.flow import Matches


@dataclass(frozen=True)
class Localization:
    """A pose and how well the matches support it."""

    cam_from_world: np.ndarray  # (4, 4)
    inliers: float  # fraction of the matches with known depth that agree with the pose
    failure: str = ""


INLIER = 2.0  # pixels: a match that is further from where the pose puts it does not agree with it


def localize(graph: KeyframeGraph, index: int, matches: Matches, start: np.ndarray, solver: Solver) -> Localization:
    """`localize_by` the points of keyframe `index` alone."""
    return localize_by(graph, {index: matches}, start, solver)


def localize_by(
    graph: KeyframeGraph, matches: Mapping[int, Matches], start: np.ndarray, solver: Solver
) -> Localization:
    """The pose (4, 4) that explains where the points of keyframes, by index, were found, from a start near it.

    Points that were never triangulated are left out: in a pure rotation their depths would invent a translation. So are
    those that move.
    """
    keyframes, count = [graph.keyframes[index] for index in matches], len(matches)
    weight = np.stack(
        [np.where(k.triangulated & k.still, m.weight * k.static, 0.0) for k, m in zip(keyframes, matches.values())]
    )
    if (weight > 0).sum() < 20:  # nothing triangulated yet, or a camera that only turned: every depth will do
        weight = np.stack([m.weight for m in matches.values()])
    cells = max(1, int((weight > 0).sum(axis=1).max()))  # the others say nothing
    chosen = [np.argsort(w <= 0, kind="stable")[:cells] for w in weight]
    weight = np.stack([w[c] for w, c in zip(weight, chosen)])
    target = np.stack([np.nan_to_num(_rectified(graph, k, m)[c].T) for (k, m), c in zip(matches.items(), chosen)])
    problem = Graph(
        cam_from_world=np.stack([*(k.cam_from_world for k in keyframes), start]),
        inverse_depth=np.stack([*(k.inverse_depth[c] for k, c in zip(keyframes, chosen)), np.ones(cells)]),
        pixels=np.stack([*(graph.pixels(index)[:, c] for index, c in zip(matches, chosen)), np.zeros((2, cells))]),
        intrinsics=graph.intrinsics,
        source=np.arange(count, dtype=np.int32),
        to=np.full(count, count, np.int32),
        target=target,
        information=np.stack([k.image.cells.information[c].T * w for k, c, w in zip(keyframes, chosen, weight)]),
        free_pose=np.arange(count + 1) == count,
        free_depth=np.zeros(count + 1, bool),
    )
    solution = adjust(problem, solver)
    pixels, z = reproject(
        solution.cam_from_world, problem.inverse_depth, problem.pixels, graph.intrinsics, problem.source, problem.to
    )
    error = np.where(z > 0, np.linalg.norm(pixels - target, axis=1), np.inf)[weight > 0]
    if len(error) == 0:
        return Localization(start, 0.0, "no match has a known depth")
    return Localization(solution.cam_from_world[count], float(np.mean(error < INLIER)), solution.failure)


def located(
    graph: KeyframeGraph, index: int, matches: Matches, cam_from_world: np.ndarray, at_infinity: bool = False
) -> np.ndarray:
    """Which points of keyframe `index` were found where a camera (4, 4) should see them: (M,) bool.

    at_infinity: as if they all were that far away, so that the camera's rotation alone counts.
    """
    expected, _ = graph.predict_pose(index, cam_from_world, at_infinity)
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(expected - _rectified(graph, index, matches), axis=1)
    return np.asarray(matches.alive & (apart < INLIER))


def confirmed(graph: KeyframeGraph, index: int, matches: Matches, cam_from_world: np.ndarray) -> float:
    """How much of the map speaks for a camera (4, 4): of the textured points of keyframe `index` that are in its image,
    the fraction that was found where it should see them."""
    cells = graph.keyframes[index].image.cells
    _, inside = graph.predict_pose(index, cam_from_world)
    expected = inside & cells.textured
    found = expected & located(graph, index, matches, cam_from_world)
    return float(found.sum() / max(1, expected.sum()))


def _rectified(graph: KeyframeGraph, index: int, matches: Matches) -> np.ndarray:
    """Targets (M, 2), of the points of keyframe `index`, as a global shutter would have seen them."""
    if matches.velocity is None:
        return matches.target
    return graph.rectified(matches.target, matches.velocity, graph.keyframes[index].image.size)


__all__ = ["INLIER", "Localization", "confirmed", "localize", "localize_by", "located"]
