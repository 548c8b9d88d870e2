"""What dense bundle adjustment works on and gives: the graph, how it is solved, and its solution.

An edge i -> j says where each cell of keyframe i was found in keyframe j (`target`) and how well (`information`). The
residual of a cell is r = target - project(T_ij [x, y, 1, d]), T_ij = T_j T_i^-1, its cost rho(r' W r).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Solver:
    """How a graph is optimized. The defaults are for this project's own tracker: weights of about 1 per pixel²."""

    steps: int = 5  # accepted steps at most
    adaptive: bool = True  # Levenberg-Marquardt; False: plain Gauss-Newton, every step taken
    lm: float = 1e-4  # fraction of the diagonal added to it, after the Schur complement
    ep: float = 1e-6  # added to the diagonal, after the Schur complement
    robust: Literal["none", "cauchy"] = "cauchy"
    robust_scale: float = 1.0  # whitened pixels
    min_z: float = 0.05  # scaled depth in the target keyframe below which a cell has no weight
    min_inverse_depth: float = 1e-3  # per unit of the map
    tolerance: float = 1e-3  # adaptive: ends where the cost falls by less than this fraction
    threads: int = 1  # of the C++ kernel
    device: str = "cpu"  # cpu: the C++ kernel; cuda or cuda:<number>, torch: PyTorch there, or on the CPU

    def reaching(self, graph: Graph) -> Solver:
        """For a graph whose points may lie far beyond the map's unit.

        The ground below a drone that takes off sets it; soon all may be a hundred times as far.
        """
        return replace(self, min_inverse_depth=self.min_inverse_depth * min(1.0, float(np.median(graph.inverse_depth))))


DROID_LOCAL = Solver(steps=2, adaptive=False, lm=1e-4, ep=0.1, robust="none", min_z=0.25)
DROID_GLOBAL = Solver(steps=2, adaptive=False, lm=1e-5, ep=0.01, robust="none", min_z=0.25)


@dataclass
class Graph:
    """K keyframes of M cells each and E directed edges; all float64, contiguous."""

    cam_from_world: np.ndarray  # (K, 4, 4)
    inverse_depth: np.ndarray  # (K, M)
    pixels: np.ndarray  # (K, 2, M) u and v of each cell
    intrinsics: np.ndarray  # (4,)
    source: np.ndarray  # (E,) int: keyframe i of each edge
    to: np.ndarray  # (E,) int: keyframe j
    target: np.ndarray  # (E, 2, M) u and v in keyframe j
    information: np.ndarray  # (E, 2, M) xx, yy or (E, 3, M) xx, xy, yy; 0: no match
    free_pose: np.ndarray  # (K,) bool
    free_depth: np.ndarray  # (K,) bool
    damping: np.ndarray | None = None  # (K, M) added to each inverse depth's information; None: 1e-6
    prior: np.ndarray | None = None  # (K, M) inverse depth drawn to ...
    prior_weight: np.ndarray | None = None  # (K, M) ... with this information
    free_focal: bool = False  # one factor on fx and fy is unknown too
    static: np.ndarray | None = None  # (K, M) factor on the information of all matches of a cell; None: 1

    @property
    def weighed(self) -> np.ndarray:
        """The information with `static` in it."""
        return self.information if self.static is None else self.information * self.static[self.source][:, None]

    def check(self) -> None:
        """Raises ValueError where shapes disagree, an edge leads nowhere or to itself, or an input is not finite."""
        k, m = self.inverse_depth.shape
        edges = len(self.source)
        shapes = {
            "cam_from_world": (k, 4, 4),
            "pixels": (k, 2, m),
            "intrinsics": (4,),
            "to": (edges,),
            "target": (edges, 2, m),
            "free_pose": (k,),
            "free_depth": (k,),
            "damping": (k, m),
            "prior": (k, m),
            "prior_weight": (k, m),
            "static": (k, m),
        }
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ValueError(f"Graph.{name} is {values.shape}, must be {shape}")
        if self.information.shape not in ((edges, 2, m), (edges, 3, m)):
            raise ValueError(
                f"Graph.information is {self.information.shape}, must be {(edges, 2, m)} or {(edges, 3, m)}"
            )
        if (self.prior is None) != (self.prior_weight is None):
            raise ValueError("Graph.prior and Graph.prior_weight go together")
        if edges:
            ends = np.concatenate([self.source, self.to])
            if ends.min() < 0 or ends.max() >= k or np.any(self.source == self.to):
                raise ValueError(f"an edge must join two different keyframes of 0 to {k - 1}")
        for name in ("cam_from_world", "inverse_depth", "information"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"Graph.{name} has values that are not finite")


@dataclass(frozen=True)
class Solution:
    """The optimized graph. `failure` is empty, or why no (further) step could be taken: the state is then the last
    good one, at worst the input."""

    cam_from_world: np.ndarray  # (K, 4, 4)
    inverse_depth: np.ndarray  # (K, M)
    information: np.ndarray  # (K, M) of the inverse depths, poses held; 0 where not free
    focal_factor: float
    initial_cost: float
    cost: float
    steps: int  # accepted
    smallest_pivot: float  # of the last factorization, relative: near 0 is ill-conditioned
    failure: str = ""


__all__ = ["DROID_GLOBAL", "DROID_LOCAL", "Graph", "Solution", "Solver"]
