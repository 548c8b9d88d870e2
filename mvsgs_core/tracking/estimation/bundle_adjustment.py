"""Dense bundle adjustment: the poses and per-cell inverse depths of a keyframe graph (DROID-SLAM, Teed & Deng 2021).

The data is in problem.py. Inverse depths are eliminated by the Schur complement, all in float64; the kernel is
mvsgs_core/csrc/tracking/bundle_adjustment.cpp, torch_adjustment.py does the same on a GPU.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core import native
from mvsgs_core.tracking.estimation.problem import DROID_GLOBAL, DROID_LOCAL, Graph, Solution, Solver

ROBUST = {"none": 0, "cauchy": 1}  # of the kernel


def adjust(graph: Graph, solver: Solver) -> Solution:
    """Optimizes the free poses and inverse depths. Pose-only and structure-only are graphs with nothing else free.

    Raises ValueError where shapes disagree, an edge leads nowhere or back to itself, or an input is not finite, and
    where there is no such device.
    """
    graph.check()
    if solver.device != "cpu":
        from mvsgs_core.tracking.estimation.torch_adjustment import adjust_with_torch  # torch takes a second to load

        return adjust_with_torch(graph, solver, solver.device)
    damping = np.full(graph.inverse_depth.shape, 1e-6) if graph.damping is None else graph.damping
    result = native.load("tracking").bundle_adjust(
        poses=_f64(graph.cam_from_world),
        inverse_depth=_f64(graph.inverse_depth),
        pixels=_f64(graph.pixels),
        intrinsics=_f64(graph.intrinsics),
        source=np.ascontiguousarray(graph.source, dtype=np.int32),
        to=np.ascontiguousarray(graph.to, dtype=np.int32),
        target=_f64(graph.target),
        information=_f64(graph.weighed),
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
    return Solution(cam_from_world=result.pop("poses"), **result)


def check_device(device: str) -> None:
    """Raises ValueError where `Solver.device` is none that is here."""
    if device != "cpu":
        from mvsgs_core.tracking.estimation.torch_adjustment import find_device  # torch takes a second to load

        find_device(device)


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


__all__ = [
    "DROID_GLOBAL",
    "DROID_LOCAL",
    "Graph",
    "Solution",
    "Solver",
    "adjust",
    "check_device",
    "reproject",
]
