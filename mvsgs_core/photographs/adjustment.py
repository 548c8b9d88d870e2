"""Sparse bundle adjustment of photographs and points (Triggs et al. 2000), in float64.

Points are eliminated by the Schur complement; Levenberg-Marquardt takes a step only where the robust cost falls. The
focal factor and the distortion, which all photographs share, are three more columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import geometry
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


@dataclass
class _Structure:
    """Which blocks of the reduced equations each observation adds to: the same in every step."""

    points: np.ndarray  # (K,) those that are seen
    starts: np.ndarray  # (K,) their first observations
    of: np.ndarray  # (N,) which of the K an observation is of
    column: np.ndarray  # (N,) which free pose it is in, -1 for a fixed one
    by_pose: list[np.ndarray]  # the observations in each free pose
    first: np.ndarray  # (Q,) pairs of observations of one point in free poses, sorted by pair of poses
    second: np.ndarray  # (Q,)
    blocks: list[tuple[int, int, int, int]]  # row <= column of a pair of poses, and which of the Q are in it, from to


def adjust_sparse(problem: SparseProblem, steps: int, robust_scale: float, tolerance: float = 1e-5) -> SparseSolution:
    """robust_scale: pixels, of the Cauchy loss. Ends early where the cost falls by less than `tolerance` of it."""
    problem.check()
    structure = _structure(problem)
    cost, damping, rejected, taken, failure = _cost(problem, robust_scale), 1e-4, 0, 0, ""
    while taken < steps and len(problem.point):
        normal = _Normal(problem, structure, robust_scale)
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
    pose = problem.cam_from_world[problem.photograph]
    seen = (pose[:, :3, :3] @ problem.points[problem.point][..., None])[..., 0] + pose[:, :3, 3]
    front = seen[:, 2] > MIN_Z
    safe = np.where(front[:, None], seen, [0.0, 0.0, 1.0])
    residual = problem.pixels - problem.lens.project(problem.photograph, safe)
    return np.where(front[:, None], residual, 0.0), seen[:, 2]


def _cost(problem: SparseProblem, scale: float) -> float:
    residual, z = reprojection(problem)
    squared = np.sum(residual**2, axis=1)
    if np.any(z <= MIN_Z) or not np.isfinite(squared).all():
        return np.inf  # no step may take a point through a camera
    prior = (problem.lens.k1**2 + problem.lens.k2**2) / DISTORTION_SIGMA**2 if problem.free_distortion else 0.0
    prior += (problem.focal_drift / FOCAL_SIGMA) ** 2 if problem.free_focal else 0.0
    return float(scale**2 * np.log1p(squared / scale**2).sum()) + prior


def _structure(problem: SparseProblem) -> _Structure:
    points, starts, of = np.unique(problem.point, return_index=True, return_inverse=True)
    free = np.flatnonzero(problem.free_pose)
    column = np.full(len(problem.free_pose), -1)
    column[free] = np.arange(len(free))
    column = column[problem.photograph]
    # all pairs of observations of one point: each with itself and those that follow it, in the order of poses
    lengths = np.diff(starts, append=len(of))
    remaining = np.repeat(starts + lengths, lengths) - np.arange(len(of))
    first = np.repeat(np.arange(len(of)), remaining)
    second = np.arange(len(first)) - np.repeat(np.cumsum(remaining) - remaining, remaining) + first
    both = (column[first] >= 0) & (column[second] >= 0)
    first, second = first[both], second[both]
    swap = column[first] > column[second]
    first, second = np.where(swap, second, first), np.where(swap, first, second)
    key = column[first] * max(len(free), 1) + column[second]
    order = np.argsort(key, kind="stable")
    first, second, key = first[order], second[order], key[order]
    begin = np.flatnonzero(np.diff(key, prepend=-1))
    rows, columns, end = column[first[begin]], column[second[begin]], np.append(begin[1:], len(key))
    blocks = list(zip(rows.tolist(), columns.tolist(), begin.tolist(), end[: len(begin)].tolist()))
    in_order = np.argsort(column, kind="stable")
    bounds = np.searchsorted(column[in_order], np.arange(len(free) + 1))
    by_pose = [in_order[bounds[n] : bounds[n + 1]] for n in range(len(free))]
    return _Structure(points, starts, of, column, by_pose, first, second, blocks)


class _Normal:
    """The normal equations at one state, reduced to poses and lens; `step` solves them with a damping."""

    def __init__(self, problem: SparseProblem, structure: _Structure, scale: float) -> None:
        self.problem, self.structure = problem, structure
        residual, _ = reprojection(problem)
        weight = 1.0 / (1.0 + np.sum(residual**2, axis=1) / scale**2)
        self._shared = ([0] if problem.free_focal else []) + ([1, 2] if problem.free_distortion else [])
        of_pose, of_point, of_lens = _jacobians(problem)
        root = np.sqrt(weight)[:, None, None]
        of_pose, of_point = root * of_pose, root * of_point
        others = root * np.concatenate([of_lens[..., self._shared], residual[..., None]], axis=2)  # (N, 2, L + 1)
        add, lens = np.add.reduceat, len(self._shared)
        self.point_pose = _outer(of_point, of_pose)  # (N, 3, 6)
        self.point_point = add(_outer(of_point, of_point), structure.starts)  # (K, 3, 3)
        self.point_others = add(_outer(of_point, others), structure.starts)  # (K, 3, L + 1): the last is the gradient
        self.pose_pose = np.zeros((len(structure.by_pose), 6, 6))
        self.pose_others = np.zeros((len(structure.by_pose), 6, lens + 1))
        for n, seen in enumerate(structure.by_pose):
            rows = of_pose[seen].reshape(-1, 6)
            self.pose_pose[n] = rows.T @ rows
            self.pose_others[n] = rows.T @ others[seen].reshape(-1, lens + 1)
        flat = others.reshape(-1, lens + 1)
        self.others = flat.T[:lens] @ flat  # (L, L + 1)
        if problem.free_focal:
            self.others[0, 0] += 1.0 / FOCAL_SIGMA**2
            self.others[0, lens] -= problem.focal_drift / FOCAL_SIGMA**2
        if problem.free_distortion:
            at = lens - 2
            self.others[at:, at:lens] += np.eye(2) / DISTORTION_SIGMA**2
            self.others[at:, lens] -= np.array([problem.lens.k1, problem.lens.k2]) / DISTORTION_SIGMA**2

    def step(self, damping: float) -> SparseProblem | None:
        """The problem after one step; None where the equations are not positive definite."""
        problem, s = self.problem, self.structure
        poses, lens = int(problem.free_pose.sum()), len(self._shared)
        diagonal = np.einsum("kii->ki", self.point_point)
        damped = self.point_point + np.einsum("ki,ij->kij", damping * diagonal + 1e-12, np.eye(3))
        inverse = np.linalg.inv(damped) if problem.free_points else np.zeros_like(damped)
        coupled = inverse[s.of] @ self.point_pose  # (N, 3, 6)
        size, at = 6 * poses + lens, 6 * poses
        full, rhs = np.zeros((size, size)), np.zeros(size)
        first, second = coupled[s.first].reshape(-1, 6), self.point_pose[s.second].reshape(-1, 6)
        for row, column, begin, end in s.blocks:
            block = first[3 * begin : 3 * end].T @ second[3 * begin : 3 * end]
            full[6 * row : 6 * row + 6, 6 * column : 6 * column + 6] = -block
        through = self.pose_others.copy()
        for n, seen in enumerate(s.by_pose):
            full[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] += self.pose_pose[n]
            through[n] -= coupled[seen].reshape(-1, 6).T @ self.point_others[s.of[seen]].reshape(-1, lens + 1)
        of_others = np.einsum("kia,kib->ab", self.point_others[..., :lens], inverse @ self.point_others)
        full[:at, at:], rhs[:at] = through[..., :lens].reshape(at, lens), through[..., lens].ravel()
        full[at:, at:], rhs[at:] = (self.others - of_others)[:, :lens], (self.others - of_others)[:, lens]
        full = np.triu(full) + np.triu(full, 1).T
        full[np.diag_indices(size)] += damping * np.maximum(np.diag(full), 0.0) + 1e-9
        try:
            np.linalg.cholesky(full)
            moved = np.linalg.solve(full, rhs)
        except np.linalg.LinAlgError:
            return None
        twists, of_lens = moved[:at].reshape(poses, 6), moved[at:]
        pull = self.point_others[..., lens] - self.point_others[..., :lens] @ of_lens
        if poses:
            seen = np.where((s.column >= 0)[:, None], twists[s.column], 0.0)
            pull = pull - np.add.reduceat(np.einsum("nij,nj->ni", self.point_pose, seen), s.starts)
        shift = (inverse @ pull[..., None])[..., 0]
        if not (np.isfinite(moved).all() and np.isfinite(shift).all()):
            return None
        cam_from_world, points = problem.cam_from_world.copy(), problem.points.copy()
        free = np.flatnonzero(problem.free_pose)
        cam_from_world[free] = geometry.se3_exp(twists) @ cam_from_world[free]
        points[s.points] += shift
        change = dict(zip(self._shared, of_lens))
        before = problem.lens
        after = replace(
            before,
            factor=float(before.factor * np.exp(np.clip(change.get(0, 0.0), -0.5, 0.5))),
            k1=float(before.k1 + change.get(1, 0.0)),
            k2=float(before.k2 + change.get(2, 0.0)),
        )
        return replace(problem, cam_from_world=cam_from_world, points=points, lens=after)


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a' b (N, i, j) of a (N, 2, i) and b (N, 2, j)."""
    return np.asarray(a[:, 0, :, None] * b[:, 0, None, :] + a[:, 1, :, None] * b[:, 1, None, :])


def _jacobians(problem: SparseProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the projection: by the pose's left twist (N, 2, 6), the point (N, 2, 3), (log factor, k1, k2) (N, 2, 3)."""
    pose, lens = problem.cam_from_world[problem.photograph], problem.lens
    rotation = pose[:, :3, :3]
    seen = (rotation @ problem.points[problem.point][..., None])[..., 0] + pose[:, :3, 3]
    q = 1.0 / seen[:, 2]
    a, b = seen[:, 0] * q, seen[:, 1] * q
    fx, fy = (lens.factor * lens.intrinsics[problem.photograph, n] for n in (0, 1))
    r2 = a * a + b * b
    bend, slope = 1.0 + r2 * (lens.k1 + r2 * lens.k2), 2.0 * (lens.k1 + 2.0 * r2 * lens.k2)  # d bend / d r2 doubled
    zero = np.zeros_like(a)
    onto = np.stack([np.stack([q, zero, -a * q], -1), np.stack([zero, q, -b * q], -1)], 1)  # (N, 2, 3)
    bent = np.stack(
        [
            np.stack([fx * (bend + slope * a * a), fx * slope * a * b], -1),
            np.stack([fy * slope * a * b, fy * (bend + slope * b * b)], -1),
        ],
        1,
    )
    by_seen = bent @ onto
    by_turn = -by_seen @ geometry.skew(seen)
    u, v = fx * bend * a, fy * bend * b
    by_lens = np.stack(
        [np.stack([u, fx * a * r2, fx * a * r2 * r2], -1), np.stack([v, fy * b * r2, fy * b * r2 * r2], -1)], 1
    )
    return np.concatenate([by_seen, by_turn], axis=2), by_seen @ rotation, by_lens


__all__ = ["SparseProblem", "SparseSolution", "adjust_sparse", "reprojection"]
