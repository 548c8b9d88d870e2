"""Sim(3) pose graph: closes a loop whose scale has drifted (Strasdat et al. 2010), Gauss-Newton in float64.

A similarity is a 4x4 matrix [sR t; 0 1]. Tangents are (translation, rotation, log scale); updates are on the left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core import geometry, native


@dataclass(frozen=True)
class SimilarityEdges:
    """E measurements: S_to = relative S_source."""

    source: np.ndarray  # (E,) int
    to: np.ndarray  # (E,) int
    relative: np.ndarray  # (E, 4, 4)
    sigma: np.ndarray  # (E, 3): of translations in map units, of rotations in radians, of log scales


@dataclass(frozen=True)
class PoseGraphSolution:
    similarities: np.ndarray  # (K, 4, 4)
    initial_cost: float
    cost: float
    steps: int
    failure: str = ""


def scale_of(similarity: np.ndarray) -> np.ndarray:
    """Scales (...) of similarities (..., 4, 4)."""
    return np.asarray(np.cbrt(np.linalg.det(similarity[..., :3, :3])))


def inverse_similarity(similarity: np.ndarray) -> np.ndarray:
    """Inverses of similarities (..., 4, 4)."""
    result = np.zeros_like(similarity)
    block = np.swapaxes(similarity[..., :3, :3], -1, -2) / scale_of(similarity)[..., None, None] ** 2
    result[..., :3, :3] = block
    result[..., :3, 3] = -(block @ similarity[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def solve_pose_graph(
    similarities: np.ndarray, edges: SimilarityEdges, fixed: set[int], steps: int = 20, tolerance: float = 1e-6
) -> PoseGraphSolution:
    """Similarities (K, 4, 4), camera from world, that agree best with the edges; those in `fixed` stay.

    Every connected part needs a fixed node: else the failure says that a part is free.
    """
    current = similarities.astype(np.float64).copy()
    if not _all_held(len(current), edges, fixed):
        cost = _cost(current, edges)
        return PoseGraphSolution(current, cost, cost, 0, "a part of the pose graph has no fixed node")
    column = np.full(len(current), -1)
    free = [k for k in range(len(current)) if k not in fixed]
    column[free] = np.arange(len(free))
    initial = cost = _cost(current, edges)
    lm, taken = 1e-8, 0
    for _ in range(steps):
        hessian, gradient = _normal_equations(current, edges, column)
        for _ in range(8):
            damped = hessian + np.diag(lm * np.diag(hessian))
            step, pivot = native.load("tracking").solve_positive_definite(damped, -gradient)
            if pivot <= 1e-12:
                return PoseGraphSolution(
                    current, initial, cost, taken, "the normal equations are not positive definite"
                )
            moved = current.copy()
            moved[free] = _retract(step.reshape(-1, 7), current[free])
            better = _cost(moved, edges)
            if better <= cost:
                break
            lm *= 10.0
        else:
            break
        taken += 1
        gain, current, cost, lm = cost - better, moved, better, max(lm / 10.0, 1e-12)
        if gain <= tolerance * max(cost, 1e-12):
            break
    return PoseGraphSolution(current, initial, cost, taken)


def residuals(similarities: np.ndarray, edges: SimilarityEdges) -> tuple[np.ndarray, np.ndarray]:
    """(E, 7) difference between what the edges say and what is, and the similarities (E, 4, 4) it is taken from."""
    error = inverse_similarity(edges.relative) @ similarities[edges.to] @ inverse_similarity(similarities[edges.source])
    scale = scale_of(error)
    rotation = geometry.so3_log(error[:, :3, :3] / scale[:, None, None])
    return np.concatenate([error[:, :3, 3], rotation, np.log(scale)[:, None]], axis=1), error


def adjoint(similarity: np.ndarray) -> np.ndarray:
    """(..., 7, 7): S exp(x) S^-1 = exp(adjoint(S) x)."""
    result = np.zeros((*similarity.shape[:-2], 7, 7))
    rotation = similarity[..., :3, :3] / scale_of(similarity)[..., None, None]
    result[..., :3, :3] = similarity[..., :3, :3]
    result[..., :3, 3:6] = geometry.skew(similarity[..., :3, 3]) @ rotation
    result[..., :3, 6] = -similarity[..., :3, 3]
    result[..., 3:6, 3:6] = rotation
    result[..., 6, 6] = 1.0
    return result


def jacobians(similarities: np.ndarray, edges: SimilarityEdges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (E, 7) and their derivatives (E, 7, 7) by left updates of `source` and of `to`."""
    r, error = residuals(similarities, edges)
    omega = r[:, 3:6]
    angle = np.linalg.norm(omega, axis=1)[:, None, None]
    safe = np.where(angle < 1e-4, 1.0, angle)
    c = np.where(angle < 1e-4, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    k = geometry.skew(omega)
    by_error = np.tile(np.eye(7), (len(r), 1, 1))
    by_error[:, :3, 3:6] = -geometry.skew(error[:, :3, 3])
    by_error[:, :3, 6] = error[:, :3, 3]
    by_error[:, 3:6, 3:6] = np.eye(3) - 0.5 * k + c * (k @ k)
    return r, -by_error @ adjoint(error), by_error @ adjoint(inverse_similarity(edges.relative))


def _all_held(count: int, edges: SimilarityEdges, fixed: set[int]) -> bool:
    """Whether a path of edges leads from every node to a fixed one."""
    held = np.isin(np.arange(count), list(fixed))
    for _ in range(count):
        reached = held.copy()
        reached[edges.to[held[edges.source]]] = True
        reached[edges.source[held[edges.to]]] = True
        if np.array_equal(reached, held):
            break
        held = reached
    return bool(held.all())


def _weights(edges: SimilarityEdges) -> np.ndarray:
    return np.asarray(1.0 / np.square(np.repeat(edges.sigma, (3, 3, 1), axis=1)))


def _cost(similarities: np.ndarray, edges: SimilarityEdges) -> float:
    return float(np.sum(_weights(edges) * np.square(residuals(similarities, edges)[0])))


def _normal_equations(
    similarities: np.ndarray, edges: SimilarityEdges, column: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (7F, 7F) and gradient (7F,) over the F free similarities, by their column (K,), -1 where fixed."""
    n = int(column.max()) + 1
    hessian, gradient = np.zeros((n, n, 7, 7)), np.zeros((n, 7))
    r, by_source, by_to = jacobians(similarities, edges)
    weights = _weights(edges)
    ends = [(column[edges.source], by_source), (column[edges.to], by_to)]
    for at, j in ends:
        weighted = np.swapaxes(j, 1, 2) * weights[:, None]
        used = at >= 0
        np.add.at(gradient, at[used], (weighted @ r[:, :, None])[used, :, 0])
        for other, q in ends:
            both = used & (other >= 0)
            np.add.at(hessian, (at[both], other[both]), (weighted @ q)[both])
    return np.ascontiguousarray(hessian.transpose(0, 2, 1, 3)).reshape(7 * n, 7 * n), gradient.ravel()


def _retract(x: np.ndarray, similarities: np.ndarray) -> np.ndarray:
    """Left updates by x (N, 7)."""
    step = np.tile(np.eye(4), (len(x), 1, 1))
    step[:, :3, :3] = np.exp(x[:, 6])[:, None, None] * geometry.so3_exp(x[:, 3:6])
    step[:, :3, 3] = x[:, :3]
    return np.asarray(step @ similarities)


__all__ = [
    "PoseGraphSolution",
    "SimilarityEdges",
    "adjoint",
    "inverse_similarity",
    "jacobians",
    "residuals",
    "scale_of",
    "solve_pose_graph",
]
