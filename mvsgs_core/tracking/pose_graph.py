"""Sim(3) pose graph: closes a loop whose scale has drifted (Strasdat et al. 2010), dense Gauss-Newton in float64.

A similarity is a 4x4 matrix [sR t; 0 1]. Tangents are (translation, rotation, log scale); updates are on the left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core import geometry


@dataclass(frozen=True)
class SimilarityEdge:
    """What node `to` should be, seen from node `source`: S_to = relative S_source."""

    source: int
    to: int
    relative: np.ndarray  # (4, 4)
    sigma: tuple[float, float, float] = (0.01, 0.005, 0.01)  # map units, radians, log scale


@dataclass(frozen=True)
class PoseGraphSolution:
    similarities: np.ndarray  # (K, 4, 4)
    initial_cost: float
    cost: float
    steps: int
    failure: str = ""


def scale_of(similarity: np.ndarray) -> np.ndarray:
    """Scales (...) of similarities (..., 4, 4)."""
    return np.cbrt(np.linalg.det(similarity[..., :3, :3]))


def inverse_similarity(similarity: np.ndarray) -> np.ndarray:
    """Inverses of similarities (..., 4, 4)."""
    result = np.zeros_like(similarity)
    block = np.swapaxes(similarity[..., :3, :3], -1, -2) / scale_of(similarity)[..., None, None] ** 2
    result[..., :3, :3] = block
    result[..., :3, 3] = -(block @ similarity[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def solve_pose_graph(
    similarities: np.ndarray, edges: list[SimilarityEdge], fixed: set[int], steps: int = 20, tolerance: float = 1e-6
) -> PoseGraphSolution:
    """Similarities (K, 4, 4), camera from world, that agree best with the edges; those in `fixed` stay.

    Every connected part needs a fixed node: else the failure says that the graph has a free gauge.
    """
    current = similarities.astype(np.float64).copy()
    free = [k for k in range(len(current)) if k not in fixed]
    column = {k: 7 * n for n, k in enumerate(free)}
    initial = cost = _cost(current, edges)
    lm, taken = 1e-6, 0
    for _ in range(steps):
        hessian, gradient = _normal_equations(current, edges, column)
        step: np.ndarray | None = None
        better = cost
        for _ in range(8):
            damped = hessian + np.diag(lm * np.diag(hessian))
            try:
                np.linalg.cholesky(damped)
            except np.linalg.LinAlgError:
                return PoseGraphSolution(current, initial, cost, taken, "a part of the pose graph has no fixed node")
            step = np.linalg.solve(damped, -gradient)
            moved = current.copy()
            for k, at in column.items():
                moved[k] = _retract(step[at : at + 7], current[k])
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


def residual(edge: SimilarityEdge, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(7,) difference between what an edge says and what is, and the similarity E (4, 4) that it is taken from."""
    error = inverse_similarity(edge.relative) @ similarities[edge.to] @ inverse_similarity(similarities[edge.source])
    scale = float(scale_of(error))
    return np.concatenate([error[:3, 3], geometry.so3_log(error[:3, :3] / scale), [np.log(scale)]]), error


def adjoint(similarity: np.ndarray) -> np.ndarray:
    """(7, 7): S exp(x) S^-1 = exp(adjoint(S) x)."""
    result = np.zeros((7, 7))
    scale = scale_of(similarity)
    rotation, translation = similarity[:3, :3] / scale, similarity[:3, 3]
    result[:3, :3] = similarity[:3, :3]
    result[:3, 3:6] = geometry.skew(translation) @ rotation
    result[:3, 6] = -translation
    result[3:6, 3:6] = rotation
    result[6, 6] = 1.0
    return result


def jacobians(edge: SimilarityEdge, similarities: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """residual (7,) and its derivatives (7, 7) by left updates of `source` and of `to`."""
    r, error = residual(edge, similarities)
    by_error = np.eye(7)
    by_error[:3, 3:6] = -geometry.skew(error[:3, 3])
    by_error[:3, 6] = error[:3, 3]
    omega = r[3:6]
    angle = float(np.linalg.norm(omega))
    k = geometry.skew(omega)
    c = 1.0 / 12.0 if angle < 1e-4 else (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    by_error[3:6, 3:6] = np.eye(3) - 0.5 * k + c * (k @ k)
    return r, -by_error @ adjoint(error), by_error @ adjoint(inverse_similarity(edge.relative))


def _weights(edge: SimilarityEdge) -> np.ndarray:
    return 1.0 / np.square(np.repeat(edge.sigma, (3, 3, 1)))


def _cost(similarities: np.ndarray, edges: list[SimilarityEdge]) -> float:
    return float(sum(np.sum(_weights(e) * np.square(residual(e, similarities)[0])) for e in edges))


def _normal_equations(
    similarities: np.ndarray, edges: list[SimilarityEdge], column: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    n = 7 * len(column)
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    for edge in edges:
        r, by_source, by_to = jacobians(edge, similarities)
        weights = _weights(edge)
        ends = [(column[k], j) for k, j in ((edge.source, by_source), (edge.to, by_to)) if k in column]
        for at, j in ends:
            gradient[at : at + 7] += j.T @ (weights * r)
            for other, q in ends:
                hessian[at : at + 7, other : other + 7] += j.T @ (weights[:, None] * q)
    return hessian, gradient


def _retract(x: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    step = np.eye(4)
    step[:3, :3] = np.exp(x[6]) * geometry.so3_exp(x[3:6])
    step[:3, 3] = x[:3]
    return step @ similarity


__all__ = [
    "PoseGraphSolution",
    "SimilarityEdge",
    "adjoint",
    "inverse_similarity",
    "jacobians",
    "residual",
    "scale_of",
    "solve_pose_graph",
]
