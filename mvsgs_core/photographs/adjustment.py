"""Sparse bundle adjustment of photographs and points (Triggs et al. 2000), in float64.

Points are eliminated by the Schur complement; Levenberg-Marquardt takes a step only where the robust cost falls. The
focal factor and the distortion, which all photographs share, are three more columns. The sums over observations are
made in mvsgs_core/csrc/tracking/sparse_adjustment.cpp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mvsgs_core import geometry, native
from mvsgs_core.photographs.lens import SharedLens

MIN_Z = 1e-6
DISTORTION_SIGMA = 0.3  # of k1 and k2 before any match is seen
FOCAL_SIGMA = 0.1  # of the logarithm of the focal factor: what few views of a plane leave free stays where it was
MAX_REJECTED = 5


@dataclass(frozen=True)
class SparseProblem:
    """Observations (N) of points (M) in photographs (P), sorted by point. All poses and points are in one frame."""

    cam_from_world: np.ndarray  # (P, 4, 4)
    points: np.ndarray  # (M, 3)
    lens: SharedLens
    photograph: np.ndarray  # (N,) int64
    point: np.ndarray  # (N,) int64, ascending
    pixels: np.ndarray  # (N, 2)
    free_pose: np.ndarray  # (P,) bool
    free_points: bool = True
    free_focal: bool = False
    free_distortion: bool = False
    known_factor: float = 1.0  # on the focal lengths, as it was known before

    @property
    def focal_drift(self) -> float:
        return float(np.log(self.lens.factor / self.known_factor))

    def check(self) -> None:
        """Raises ValueError where points are not in order or an input is not finite."""
        if np.any(np.diff(self.point) < 0):
            raise ValueError("observations must be sorted by point")
        for name in ("cam_from_world", "points", "pixels"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"bundle adjustment of photographs: {name} is not finite")


@dataclass(frozen=True)
class SparseSolution:
    cam_from_world: np.ndarray
    points: np.ndarray
    lens: SharedLens
    cost: float  # robust, of all observations
    steps: int
    failure: str = ""  # why no step could be taken


def adjust_sparse(problem: SparseProblem, steps: int, robust_scale: float, tolerance: float = 1e-5) -> SparseSolution:
    """robust_scale: pixels, of the Cauchy loss. Ends early where the cost falls by less than `tolerance` of it."""
    problem.check()
    cost, damping, rejected, taken, failure = _cost(problem, robust_scale), 1e-4, 0, 0, ""
    while taken < steps and len(problem.point):
        normal = _Normal(problem, robust_scale)
        while True:
            candidate = normal.step(damping)
            better = np.inf if candidate is None else _cost(candidate, robust_scale)
            if candidate is not None and better <= cost:
                break
            rejected, damping = rejected + 1, damping * 10.0
            if rejected > MAX_REJECTED:
                failure = "" if taken else "no step lowers the cost"
                return SparseSolution(problem.cam_from_world, problem.points, problem.lens, cost, taken, failure)
        rejected, damping = 0, max(damping / 5.0, 1e-9)
        gain, problem, cost, taken = cost - better, candidate, better, taken + 1
        if gain <= tolerance * cost:
            break
    return SparseSolution(problem.cam_from_world, problem.points, problem.lens, cost, taken, failure)


def reprojection(problem: SparseProblem) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2) in pixels, observed less predicted, and depths (N,); residuals are 0 where depth is not > 0."""
    residual, depth = native.load("tracking").sparse_residuals(**_observations(problem))
    return residual, depth


def _cost(problem: SparseProblem, scale: float) -> float:
    residual, z = reprojection(problem)
    squared = np.sum(residual**2, axis=1)
    if np.any(z <= MIN_Z) or not np.isfinite(squared).all():
        return np.inf  # no step may take a point through a camera
    prior = (problem.lens.k1**2 + problem.lens.k2**2) / DISTORTION_SIGMA**2 if problem.free_distortion else 0.0
    prior += (problem.focal_drift / FOCAL_SIGMA) ** 2 if problem.free_focal else 0.0
    return float(scale**2 * np.log1p(squared / scale**2).sum()) + prior


class _Normal:
    """The normal equations at one state; `step` reduces them to poses and lens and solves these, with a damping."""

    def __init__(self, problem: SparseProblem, scale: float) -> None:
        self.problem = problem
        self._shared = ([0] if problem.free_focal else []) + ([1, 2] if problem.free_distortion else [])
        self._free = np.flatnonzero(problem.free_pose)
        column = np.full(len(problem.free_pose), -1, np.int64)
        column[self._free] = np.arange(len(self._free))
        sums = native.load("tracking").sparse_normal(
            **_observations(problem), column=column, free_poses=len(self._free), shared=self._shared, scale=scale
        )
        others, lens = sums["others"], len(self._shared)
        if problem.free_focal:
            others[0, 0] += 1.0 / FOCAL_SIGMA**2
            others[0, lens] -= problem.focal_drift / FOCAL_SIGMA**2
        if problem.free_distortion:
            at = lens - 2
            others[at:, at:lens] += np.eye(2) / DISTORTION_SIGMA**2
            others[at:, lens] -= np.array([problem.lens.k1, problem.lens.k2]) / DISTORTION_SIGMA**2
        self._sums = sums | {"point": _int64(problem.point), "column": column[problem.photograph]}

    def step(self, damping: float) -> SparseProblem | None:
        """The problem after one step; None where the equations are not positive definite."""
        problem, kernels = self.problem, native.load("tracking")
        full, rhs, inverse = kernels.sparse_reduce(**self._sums, damping=damping, free_points=problem.free_points)
        full[np.diag_indices(len(full))] += damping * np.maximum(np.diag(full), 0.0) + 1e-9
        try:
            np.linalg.cholesky(full)
            moved = np.linalg.solve(full, rhs)
        except np.linalg.LinAlgError:
            return None
        twists, of_lens = moved[: 6 * len(self._free)].reshape(-1, 6), moved[6 * len(self._free) :]
        shift = kernels.sparse_shift(**self._sums, inverse=inverse, twists=twists, change=of_lens)
        if not (np.isfinite(moved).all() and np.isfinite(shift).all()):
            return None
        cam_from_world = problem.cam_from_world.copy()
        cam_from_world[self._free] = geometry.se3_exp(twists) @ cam_from_world[self._free]
        change = dict(zip(self._shared, of_lens))
        before = problem.lens
        after = replace(
            before,
            factor=float(before.factor * np.exp(np.clip(change.get(0, 0.0), -0.5, 0.5))),
            k1=float(before.k1 + change.get(1, 0.0)),
            k2=float(before.k2 + change.get(2, 0.0)),
        )
        return replace(problem, cam_from_world=cam_from_world, points=problem.points + shift, lens=after)


def _observations(problem: SparseProblem) -> dict[str, Any]:
    """As the kernels take them."""
    lens = problem.lens
    return {
        "poses": np.ascontiguousarray(problem.cam_from_world, np.float64),
        "points": np.ascontiguousarray(problem.points, np.float64),
        "lenses": np.ascontiguousarray(lens.intrinsics * [lens.factor, lens.factor, 1.0, 1.0]),
        "k1": lens.k1,
        "k2": lens.k2,
        "photograph": _int64(problem.photograph),
        "point": _int64(problem.point),
        "pixels": np.ascontiguousarray(problem.pixels, np.float64),
        "min_z": MIN_Z,
    }


def _int64(indices: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(indices, np.int64)


__all__ = ["SparseProblem", "SparseSolution", "adjust_sparse", "reprojection"]
