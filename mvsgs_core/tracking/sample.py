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
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import localize, located

GRID = (6, 8)  # rows and columns of the image: one point each

_POINT = np.dtype([("cell", "<u4"), ("target", "<f4", 2), ("velocity", "<f2", 2)])


def sample(graph: KeyframeGraph, index: int, matches: Matches, cam_from_world: np.ndarray) -> bytes:
    """At most 48 of the matches of keyframe `index` that agree with the frame's pose (4, 4): 16 bytes each."""
    keyframe = graph.keyframes[index]
    use = located(graph, index, matches, cam_from_world)
    stands = keyframe.triangulated & keyframe.still
    if (use & stands).sum() >= 20:  # as in `localize`: the others say nothing then
        use &= stands
    chosen = _thinned(matches.target, np.flatnonzero(use), keyframe.image.size)
    few = np.zeros(len(use))
    few[chosen] = 1.0
    alone = localize(graph, index, Matches(matches.target, few, matches.velocity), cam_from_world, Solver(steps=4))
    points = np.zeros(len(chosen), _POINT)
    points["cell"] = chosen
    points["target"] = matches.target[chosen]
    if not alone.failure and len(chosen):
        all_say, few_say = (
            graph.predict_pose(index, pose)[0][chosen] for pose in (cam_from_world, alone.cam_from_world)
        )
        points["target"] += np.nan_to_num(all_say - few_say)
    if matches.velocity is not None:
        points["velocity"] = matches.velocity[chosen]
    return points.tobytes()


def restored(points: bytes, cells: int) -> Matches:
    """The matches that were kept, among all `cells` of the keyframe."""
    kept = np.frombuffer(points, _POINT)
    target, weight, velocity = np.full((cells, 2), np.nan), np.zeros(cells), np.zeros((cells, 2))
    target[kept["cell"]], weight[kept["cell"]], velocity[kept["cell"]] = kept["target"], 1.0, kept["velocity"]
    return Matches(target, weight, velocity)


def _thinned(target: np.ndarray, candidates: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The candidate nearest to the middle of each box of the grid, where there is one."""
    at = target[candidates] / [size[1], size[0]] * [GRID[1], GRID[0]]
    box = np.clip(at.astype(int), 0, [GRID[1] - 1, GRID[0] - 1])
    off = np.abs(at - box - 0.5).max(axis=1)
    order = np.lexsort((off, box[:, 0], box[:, 1]))
    _, first = np.unique(box[order] @ [1, GRID[1]], return_index=True)
    return np.asarray(np.sort(candidates[order[first]]))


__all__ = ["restored", "sample"]
