"""The Sim(3) pose graph: derivatives, a loop with drifting scale, and a free gauge."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.pose_graph import (
    SimilarityEdges,
    inverse_similarity,
    jacobians,
    residuals,
    scale_of,
    solve_pose_graph,
)


def similarity(random: np.random.Generator, size: float, n: int) -> np.ndarray:
    poses = geometry.se3_exp(random.normal(0.0, size, (n, 6)))
    poses[:, :3, :3] *= np.exp(random.normal(0.0, size, n))[:, None, None]
    return poses


def test_inverse() -> None:
    s = similarity(np.random.default_rng(0), 0.7, 6)
    np.testing.assert_allclose(inverse_similarity(s) @ s, np.tile(np.eye(4), (6, 1, 1)), atol=1e-12)


def test_jacobians_agree_with_differences() -> None:
    random = np.random.default_rng(1)
    nodes = similarity(random, 0.5, 2)
    measured = similarity(random, 0.05, 1) @ nodes[1:] @ inverse_similarity(nodes[:1])
    edges = SimilarityEdges(np.array([0]), np.array([1]), measured, np.ones((1, 3)))
    _, *analytic = jacobians(nodes, edges)
    h = 1e-6
    for node, derivative in enumerate(analytic):
        for axis in range(7):
            values = []
            for sign in (1.0, -1.0):
                step = np.zeros(7)
                step[axis] = sign * h
                moved = nodes.copy()
                update = geometry.se3_exp(step[:6])
                update[:3, :3] *= np.exp(step[6])
                moved[node] = update @ moved[node]
                values.append(residuals(moved, edges)[0][0])
            np.testing.assert_allclose((values[0] - values[1]) / (2 * h), derivative[0, :, axis], atol=1e-6)


def ring(n: int = 40, drift: float = 0.99) -> tuple[np.ndarray, np.ndarray, SimilarityEdges]:
    """True cameras on a circle, the same as an odometer with drifting scale sees them, and its edges with one loop."""
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    world = np.tile(np.eye(4), (n, 1, 1))
    world[:, :3, :3] = geometry.so3_exp(np.stack([0 * angle, angle, 0 * angle], axis=1))
    world[:, :3, 3] = np.stack([3.0 * np.sin(angle), 0.1 * np.sin(3 * angle), 3.0 * np.cos(angle)], axis=1)
    truth = geometry.inverse(world)
    relative = truth[1:] @ geometry.inverse(truth[:-1])
    relative[:, :3, :3] *= drift
    drifted = [truth[0]]
    for step in relative:
        drifted.append(step @ drifted[-1])
    closing = truth[:1] @ geometry.inverse(truth[-1:])
    edges = SimilarityEdges(
        source=np.arange(n),
        to=np.append(np.arange(1, n), 0),
        relative=np.concatenate([relative, closing]),
        sigma=np.tile([0.01, 0.005, 0.01], (n, 1)),
    )
    return truth, np.stack(drifted), edges


def error(similarities: np.ndarray, truth: np.ndarray) -> float:
    found = inverse_similarity(similarities)[:, :3, 3]
    wanted = geometry.inverse(truth)[:, :3, 3]
    aligned = geometry.umeyama(found, wanted).apply(found)
    return float(np.sqrt(np.mean(np.sum(np.square(aligned - wanted), axis=1))))


def test_a_loop_takes_the_drift_of_scale_away() -> None:
    truth, drifted, edges = ring()
    exact_loop = edges.relative[-1]
    assert np.allclose(scale_of(exact_loop), 1.0)
    closed = solve_pose_graph(drifted, edges, {0})
    assert not closed.failure
    # The loop says how the last camera stands to the first, in the unit of the last: scale included.
    assert closed.cost < 0.01 * closed.initial_cost
    assert error(closed.similarities, truth) < error(drifted, truth) / 3.0


def test_a_free_gauge_is_reported() -> None:
    _, drifted, edges = ring(8)
    assert "no fixed node" in solve_pose_graph(drifted, edges, set()).failure
