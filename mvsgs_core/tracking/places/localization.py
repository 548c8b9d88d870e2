"""The pose of one frame against keyframes whose depths are known: motion-only bundle adjustment."""

from __future__ import annotations

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
    count: int  # matches with known depth
    error: float  # pixels, median over those matches
    failure: str = ""


INLIER = 2.0  # pixels: a match that is further from where the pose puts it does not agree with it


def localize(
    graph: KeyframeGraph,
    matches: dict[int, Matches],
    start: np.ndarray,
    solver: Solver,
) -> Localization:
    """The pose (4, 4) that explains where the points of keyframes (by index) were found, from a start near it.

    Points that were never triangulated are left out: in a pure rotation their depths would invent a translation.
    """
    order = sorted(matches)
    frames = [graph.keyframes[index] for index in order]
    k = len(order)
    cells = len(frames[0].inverse_depth)
    weights = np.stack([np.where(f.triangulated, matches[i].weight, 0.0) for i, f in zip(order, frames)])
    if (weights > 0).sum() < 20:  # nothing triangulated yet, or a camera that only turned: every depth will do
        weights = np.stack([matches[i].weight for i in order])
    target = np.stack([np.nan_to_num(_rectified(matches[i], graph.readout_time).T) for i in order])
    information = np.stack([f.image.cells.information.T for f in frames]) * weights[:, None]
    problem = Graph(
        cam_from_world=np.stack([*(f.cam_from_world for f in frames), start]),
        inverse_depth=np.stack([*(f.inverse_depth for f in frames), np.ones(cells)]),
        pixels=np.stack([*(graph.pixels(i) for i in order), np.zeros((2, cells))]),
        intrinsics=graph.intrinsics,
        source=np.arange(k, dtype=np.int32),
        to=np.full(k, k, np.int32),
        target=target,
        information=information,
        free_pose=np.arange(k + 1) == k,
        free_depth=np.zeros(k + 1, bool),
    )
    solution = adjust(problem, solver)
    pose = solution.cam_from_world[k]
    pixels, z = reproject(
        solution.cam_from_world, problem.inverse_depth, problem.pixels, graph.intrinsics, problem.source, problem.to
    )
    used = weights > 0
    error = np.where(z > 0, np.linalg.norm(pixels - target, axis=1), np.inf)[used]
    if len(error) == 0:
        return Localization(start, 0.0, 0, np.inf, "no match has a known depth")
    return Localization(pose, float(np.mean(error < INLIER)), len(error), float(np.median(error)), solution.failure)


def located(
    graph: KeyframeGraph, index: int, matches: Matches, cam_from_world: np.ndarray, at_infinity: bool = False
) -> np.ndarray:
    """Which points of keyframe `index` were found where a camera (4, 4) should see them: (M,) bool.

    at_infinity: as if they all were that far away, so that the camera's rotation alone counts.
    """
    expected, _ = graph.predict_pose(index, cam_from_world, at_infinity)
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(expected - _rectified(matches, graph.readout_time), axis=1)
    return np.asarray(matches.alive & (apart < INLIER))


def _rectified(matches: Matches, readout_time: float) -> np.ndarray:
    """Targets (M, 2) as a global shutter would have seen them."""
    return matches.target if matches.shift is None else matches.target - readout_time * matches.shift


__all__ = ["INLIER", "Localization", "localize", "located"]
