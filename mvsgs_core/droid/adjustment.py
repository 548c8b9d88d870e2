"""The factor graph as a dense bundle adjustment (DROID-SLAM, eq. 5 to 8), with the damping of the published system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from mvsgs_core.droid.video import Video
from mvsgs_core.tracking.estimation.bundle_adjustment import DROID_GLOBAL, DROID_LOCAL, Graph, Solution, Solver, adjust

LOCAL, GLOBAL = DROID_LOCAL, DROID_GLOBAL
_WEIGHT = 1e-3  # information per cell² at full confidence
_DAMPING, _MIN_DAMPING = 0.2, 1e-7  # fraction of the network's damping that counts, and what is added
_NO_DAMPING = 1e-6  # of a keyframe that no update has seen


class Factor(Protocol):
    """An edge as far as bundle adjustment sees it."""

    source: int
    to: int
    target: np.ndarray  # (h, w, 2)
    weight: np.ndarray  # (h, w, 2)


def solve(
    video: Video, edges: Sequence[Factor], first_free: int, solver: Solver, *, motion_only: bool, threads: int
) -> Solution:
    """Optimizes the poses from `first_free` on and, unless `motion_only`, the inverse depths of all sources; in place.

    A failed solve changes nothing and says so in the solution.
    """
    ends = np.array([(edge.source, edge.to) for edge in edges])
    positions, numbers = np.unique(ends, return_inverse=True)
    source, to = numbers.reshape(ends.shape).T
    frames = [video.frames[n] for n in positions]
    h, w = frames[0].inverse_depth.shape
    v, u = np.mgrid[:h, :w].astype(np.float64)
    is_source = np.isin(np.arange(len(frames)), source)
    damping = np.stack([np.full((h, w), _NO_DAMPING) if f.damping is None else f.damping for f in frames])
    graph = Graph(
        cam_from_world=np.stack([f.cam_from_world for f in frames]),
        inverse_depth=np.stack([f.inverse_depth.ravel() for f in frames]),
        pixels=np.tile(np.stack([u.ravel(), v.ravel()]), (len(frames), 1, 1)),
        intrinsics=video.intrinsics,
        source=source,
        to=to,
        target=np.stack([e.target.reshape(-1, 2).T for e in edges]).astype(np.float64),
        information=_WEIGHT * np.stack([e.weight.reshape(-1, 2).T for e in edges]).astype(np.float64),
        free_pose=positions >= first_free,
        free_depth=is_source & (not motion_only),
        damping=(_DAMPING * damping + _MIN_DAMPING).reshape(len(frames), -1),
    )
    solution = adjust(graph, replace(solver, threads=threads))
    for n, frame in enumerate(frames):
        if graph.free_pose[n]:
            frame.cam_from_world = solution.cam_from_world[n]
        if graph.free_depth[n]:
            frame.inverse_depth = solution.inverse_depth[n].reshape(h, w)
    return solution


__all__ = ["GLOBAL", "LOCAL", "Factor", "solve"]
