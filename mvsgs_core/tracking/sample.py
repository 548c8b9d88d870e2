"""A few of a frame's matches that speak for all of them: what is kept of each frame until the end of the stream.

The points are those nearest to the middles of a coarse grid over the image, among the matches that agree with the
frame's pose. A few of many points would give another pose than all of them, by their noise; so their targets are moved
by what their own pose is off, and the pose that they give is that of all matches. What the map learns later about its
depths moves the few as it would have moved the many.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import BORDER
from mvsgs_core.tracking.keyframes import Keyframe
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import localize, located

GRID = (6, 8)  # rows and columns of the image: one point each
MOST = 65_535  # that two bytes hold


def sample(graph: KeyframeGraph, index: int, matches: Matches, cam_from_world: np.ndarray) -> bytes:
    """At most 48 of the matches of keyframe `index` that agree with the frame's pose (4, 4): 10 bytes each."""
    keyframe = graph.keyframes[index]
    use = located(graph, index, matches, cam_from_world)
    stands = keyframe.triangulated & keyframe.still
    if (use & stands).sum() >= 20:  # as in `localize`: the others say nothing then
        use &= stands
    chosen = _thinned(matches.target, np.flatnonzero(use), keyframe.image.size)
    few = np.zeros(len(use))
    few[chosen] = 1.0
    alone = localize(graph, index, Matches(matches.target, few, matches.velocity), cam_from_world, Solver(steps=4))
    target = matches.target[chosen]
    if not alone.failure and len(chosen):
        all_say, few_say = (
            graph.predict_pose(index, pose)[0][chosen] for pose in (cam_from_world, alone.cam_from_world)
        )
        target = target + np.nan_to_num(all_say - few_say)
    return _packed(chosen, target, None if matches.velocity is None else matches.velocity[chosen], keyframe)


def _packed(chosen: np.ndarray, target: np.ndarray, velocity: np.ndarray | None, keyframe: Keyframe) -> bytes:
    points = np.zeros(len(chosen), _point(len(keyframe.inverse_depth)))
    points["cell"] = chosen
    points["target"] = np.clip(np.rint((target + BORDER) / _step(keyframe.image.size)), 0, MOST)
    if velocity is not None:
        points["velocity"] = velocity
    return points.tobytes()


def restored(points: bytes, keyframe: Keyframe) -> Matches:
    """The matches that were kept, among all cells of their keyframe."""
    cells = len(keyframe.inverse_depth)
    kept = np.frombuffer(points, _point(cells))
    target, weight, velocity = np.full((cells, 2), np.nan), np.zeros(cells), np.zeros((cells, 2))
    target[kept["cell"]] = kept["target"] * _step(keyframe.image.size) - BORDER
    weight[kept["cell"]], velocity[kept["cell"]] = 1.0, kept["velocity"]
    return Matches(target, weight, velocity)


def _point(cells: int) -> np.dtype:
    """What is kept of a match with one of so many cells."""
    cell = "<u2" if cells <= MOST + 1 else "<u4"
    return np.dtype([("cell", cell), ("target", "<u2", 2), ("velocity", "<f2", 2)])


def _step(size: tuple[int, int]) -> float:
    """Pixels by which targets, in an image or just beside it, are told apart: 1/128 where it is up to 463 wide."""
    return float(2.0 ** np.ceil(np.log2((max(size) + 2 * BORDER) / MOST)))


def _thinned(target: np.ndarray, candidates: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The candidate nearest to the middle of each box of the grid, where there is one."""
    at = target[candidates] / [size[1], size[0]] * [GRID[1], GRID[0]]
    box = np.clip(at.astype(int), 0, [GRID[1] - 1, GRID[0] - 1])
    off = np.abs(at - box - 0.5).max(axis=1)
    order = np.lexsort((off, box[:, 0], box[:, 1]))
    _, first = np.unique(box[order] @ [1, GRID[1]], return_index=True)
    return np.asarray(np.sort(candidates[order[first]]))


__all__ = ["restored", "sample"]
