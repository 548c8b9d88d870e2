"""Dense bundle adjustment: the poses and per-cell inverse depths of a keyframe graph (DROID-SLAM, Teed & Deng 2021).

An edge i -> j says where each cell of keyframe i was found in keyframe j (`target`) and how well (`information`). The
residual of a cell is r = target - project(T_ij [x, y, 1, d]), T_ij = T_j T_i^-1, its cost rho(r' W r). Inverse depths
are eliminated by the Schur complement, all in float64; the kernel is mvsgs_core/csrc/tracking/bundle_adjustment.cpp,
torch_adjustment.py does the same on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvsgs_core import native

ROBUST = {"none": 0, "huber": 1, "cauchy": 2}


@dataclass(frozen=True)
class Solver:
    """How a graph is optimized. The defaults are for this project's own tracker: weights of about 1 per pixel²."""

    steps: int = 5  # accepted steps at most
    adaptive: bool = True  # Levenberg-Marquardt; False: plain Gauss-Newton, every step taken
    lm: float = 1e-4  # fraction of the diagonal added to it, after the Schur complement
    ep: float = 1e-6  # added to the diagonal, after the Schur complement
    robust: str = "cauchy"  # none, huber, cauchy
    robust_scale: float = 1.0  # whitened pixels
    min_z: float = 0.05  # scaled depth in the target keyframe below which a cell has no weight
    min_inverse_depth: float = 1e-3  # per unit of the map
    tolerance: float = 1e-3  # adaptive: ends where the cost falls by less than this fraction
    threads: int = 1  # of the C++ kernel
    device: str = "cpu"  # cpu: the C++ kernel; cuda or cuda:<number>, torch: PyTorch there, or on the CPU


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
    ill_conditioned: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ill_conditioned", bool(self.smallest_pivot < 1e-7))


def adjust(graph: Graph, solver: Solver) -> Solution:
    """Optimizes the free poses and inverse depths. Pose-only and structure-only are graphs with nothing else free.

    Raises ValueError where shapes disagree, an edge leads nowhere or back to itself, or an input is not finite, and
    where there is no such device.
    """
    k, m = graph.inverse_depth.shape
    edges = len(graph.source)
    _check(graph, k, m, edges)
    if solver.device != "cpu":
        from mvsgs_core.tracking.estimation.torch_adjustment import adjust_with_torch  # torch takes a second to load

        return adjust_with_torch(graph, solver, solver.device)
    damping = np.full((k, m), 1e-6) if graph.damping is None else graph.damping
    result = native.load("tracking").bundle_adjust(
        poses=_f64(graph.cam_from_world),
        inverse_depth=_f64(graph.inverse_depth),
        pixels=_f64(graph.pixels),
        intrinsics=_f64(graph.intrinsics),
        source=np.ascontiguousarray(graph.source, dtype=np.int32),
        to=np.ascontiguousarray(graph.to, dtype=np.int32),
        target=_f64(graph.target),
        information=_f64(graph.information),
        free_pose=np.ascontiguousarray(graph.free_pose, dtype=np.uint8),
        free_depth=np.ascontiguousarray(graph.free_depth, dtype=np.uint8),
        damping=_f64(damping),
        prior=None if graph.prior is None else _f64(graph.prior),
        prior_weight=None if graph.prior_weight is None else _f64(graph.prior_weight),
        free_focal=graph.free_focal,
        robust=ROBUST[solver.robust],
        robust_scale=solver.robust_scale,
        min_z=solver.min_z,
        min_inverse_depth=solver.min_inverse_depth,
        steps=solver.steps,
        adaptive=solver.adaptive,
        lm=solver.lm,
        ep=solver.ep,
        tolerance=solver.tolerance,
        threads=solver.threads,
    )
    return Solution(
        cam_from_world=result["poses"],
        inverse_depth=result["inverse_depth"],
        information=result["information"],
        focal_factor=result["focal_factor"],
        initial_cost=result["initial_cost"],
        cost=result["cost"],
        steps=result["steps"],
        smallest_pivot=result["smallest_pivot"],
        failure=result["failure"],
    )


def reproject(
    cam_from_world: np.ndarray,
    inverse_depth: np.ndarray,
    pixels: np.ndarray,
    intrinsics: np.ndarray,
    source: np.ndarray,
    to: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the cells of each edge's source fall in its target: pixels (E, 2, M), and scaled depth Z (E, M).

    Z is depth in the target over depth in the source; where it is not positive the pixels mean nothing.
    """
    fx, fy, cx, cy = intrinsics
    relative = cam_from_world[to] @ np.linalg.inv(cam_from_world[source])
    u, v = pixels[source, 0], pixels[source, 1]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=1)
    points = relative[:, :3, :3] @ rays + relative[:, :3, 3:] * inverse_depth[source][:, None]
    z = points[:, 2]
    safe = np.where(z > 1e-6, z, 1.0)
    return np.stack([fx * points[:, 0] / safe + cx, fy * points[:, 1] / safe + cy], axis=1), z


def _f64(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


def _check(graph: Graph, k: int, m: int, edges: int) -> None:
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
    }
    for name, shape in shapes.items():
        values = getattr(graph, name)
        if values is not None and values.shape != shape:
            raise ValueError(f"Graph.{name} is {values.shape}, must be {shape}")
    if graph.information.shape not in ((edges, 2, m), (edges, 3, m)):
        raise ValueError(f"Graph.information is {graph.information.shape}, must be {(edges, 2, m)} or {(edges, 3, m)}")
    if (graph.prior is None) != (graph.prior_weight is None):
        raise ValueError("Graph.prior and Graph.prior_weight go together")
    if edges:
        ends = np.concatenate([graph.source, graph.to])
        if ends.min() < 0 or ends.max() >= k or np.any(graph.source == graph.to):
            raise ValueError(f"an edge must join two different keyframes of 0 to {k - 1}")
    for name in ("cam_from_world", "inverse_depth", "information"):
        if not np.isfinite(getattr(graph, name)).all():
            raise ValueError(f"Graph.{name} has values that are not finite")


__all__ = ["DROID_GLOBAL", "DROID_LOCAL", "ROBUST", "Graph", "Solution", "Solver", "adjust", "reproject"]
