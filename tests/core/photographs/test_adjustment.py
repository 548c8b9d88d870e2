"""Sparse bundle adjustment: its derivatives, its steps against a dense solver, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry, native
from mvsgs_core.photographs.adjustment import (
    DISTORTION_SIGMA,
    FOCAL_SIGMA,
    SparseProblem,
    _cost,
    _Normal,
    _observations,
    adjust_sparse,
    reprojection,
)
from tests.support.photograph_ring import position_error, ring


def problem(count: int = 4, points: int = 60, noise: float = 0.2, moved: float = 0.02) -> SparseProblem:
    """A ring whose poses and points were moved away from the truth; the first pose is fixed."""
    true, random = ring(count, points, noise=noise, k1=-0.05, k2=0.02), np.random.default_rng(1)
    point, photograph = np.nonzero(np.isfinite(true.pixels[..., 0]).T)
    poses = geometry.se3_exp(moved * random.standard_normal((count, 6))) @ true.cam_from_world
    poses[0] = true.cam_from_world[0]
    world = true.world + moved * random.standard_normal(true.world.shape)
    lens = replace(true.lens, factor=1.03, k1=0.0, k2=0.0)
    free = np.arange(count) > 0
    return SparseProblem(poses, world, lens, photograph, point, true.pixels[photograph, point], free)


def moved(start: SparseProblem, change: np.ndarray) -> SparseProblem:
    """By twists of all poses, points, and (log factor, k1, k2)."""
    poses, points = len(start.cam_from_world), len(start.points)
    twists, rest = change[: 6 * poses].reshape(poses, 6), change[6 * poses :]
    lens = start.lens
    return replace(
        start,
        cam_from_world=geometry.se3_exp(twists) @ start.cam_from_world,
        points=start.points + rest[: 3 * points].reshape(points, 3),
        lens=replace(lens, factor=lens.factor * np.exp(rest[-3]), k1=lens.k1 + rest[-2], k2=lens.k2 + rest[-1]),
    )


def dense_jacobian(start: SparseProblem) -> np.ndarray:
    """(2N, 6P + 3M + 3) of the projection, by central differences."""
    size = 6 * len(start.cam_from_world) + 3 * len(start.points) + 3
    columns = []
    for n in range(size):
        step = np.zeros(size)
        step[n] = 1e-6
        ahead, back = (reprojection(moved(start, sign * step))[0] for sign in (1.0, -1.0))
        columns.append((back - ahead).ravel() / 2e-6)
    return np.stack(columns, axis=1)


def test_derivatives_are_those_of_the_projection() -> None:
    start = problem(3, 8)
    start = replace(start, lens=replace(start.lens, k1=-0.1, k2=0.05))
    of_pose, of_point, of_lens = native.load("tracking").sparse_derivatives(**_observations(start))
    dense = dense_jacobian(start).reshape(len(start.point), 2, -1)
    poses = 6 * len(start.cam_from_world)
    for n, (photograph, point) in enumerate(zip(start.photograph, start.point)):
        np.testing.assert_allclose(of_pose[n], dense[n][:, 6 * photograph : 6 * photograph + 6], rtol=1e-5, atol=1e-4)
        at = poses + 3 * point
        np.testing.assert_allclose(of_point[n], dense[n][:, at : at + 3], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(of_lens[n], dense[n][:, -3:], rtol=1e-5, atol=1e-4)


def test_a_step_is_that_of_the_whole_normal_equations() -> None:
    """Eliminating the points changes nothing: the same step as of one dense system with all unknowns."""
    start = replace(problem(4, 20), free_focal=True, free_distortion=True, known_factor=1.0)
    scale, damping = 2.0, 1e-3
    residual, _ = reprojection(start)
    weight = np.repeat(1.0 / (1.0 + np.sum(residual**2, axis=1) / scale**2), 2)
    jacobian = dense_jacobian(start)
    hessian, gradient = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * residual.ravel())
    hessian[-3:, -3:] += np.diag([1.0 / FOCAL_SIGMA**2, *[1.0 / DISTORTION_SIGMA**2] * 2])
    gradient[-3] -= np.log(start.lens.factor) / FOCAL_SIGMA**2
    free = np.arange(len(gradient)) >= 6  # the first pose is fixed
    # damping acts on points before they are eliminated and on the reduced diagonal after: none here but the points'
    points = slice(6 * len(start.cam_from_world), -3)
    block = hessian[points, points]
    block[np.diag_indices(len(block))] *= 1.0 + damping
    reduced_index = np.r_[np.arange(6, 6 * len(start.cam_from_world)), np.arange(len(gradient) - 3, len(gradient))]
    cross = hessian[reduced_index][:, points]
    reduced = hessian[np.ix_(reduced_index, reduced_index)] - cross @ np.linalg.solve(block, cross.T)
    added = np.zeros_like(hessian)
    added[reduced_index, reduced_index] = damping * np.diag(reduced)
    wanted = np.zeros(len(gradient))
    wanted[free] = np.linalg.solve((hessian + added)[np.ix_(free, free)], gradient[free])
    found = _Normal(start, scale).step(damping)
    assert found is not None
    expected = moved(start, wanted)
    np.testing.assert_allclose(found.cam_from_world, expected.cam_from_world, atol=2e-4)
    np.testing.assert_allclose(found.points, expected.points, atol=2e-4)
    np.testing.assert_allclose(
        [found.lens.factor, found.lens.k1, found.lens.k2],
        [expected.lens.factor, expected.lens.k1, expected.lens.k2],
        atol=2e-4,
    )


def test_poses_points_and_lens_are_found() -> None:
    true, start = ring(6, 300, noise=0.3, k1=-0.05, k2=0.02), problem(6, 300, noise=0.3)
    found = adjust_sparse(replace(start, free_focal=True, free_distortion=True), 30, 1.0)
    assert not found.failure
    assert position_error(start.cam_from_world, true.cam_from_world) > 0.004
    assert position_error(found.cam_from_world, true.cam_from_world) < 0.001
    assert abs(found.lens.factor - 1.0) < 0.005
    assert abs(found.lens.k1 + 0.05) < 0.01
    error, _ = reprojection(replace(start, cam_from_world=found.cam_from_world, points=found.points, lens=found.lens))
    assert np.median(np.linalg.norm(error, axis=1)) < 0.5


def test_wrong_observations_do_not_bend_it() -> None:
    start = problem(6, 300)
    pixels, random = start.pixels.copy(), np.random.default_rng(2)
    wrong = random.random(len(pixels)) < 0.05
    pixels[wrong] += random.uniform(-100, 100, (int(wrong.sum()), 2))
    found = adjust_sparse(replace(start, pixels=pixels, free_focal=True, free_distortion=True), 40, 1.0)
    assert position_error(found.cam_from_world, ring(6, 300).cam_from_world) < 0.0015


def test_what_is_fixed_stays() -> None:
    start = problem()
    found = adjust_sparse(start, 10, 1.0)
    np.testing.assert_array_equal(found.cam_from_world[0], start.cam_from_world[0])
    np.testing.assert_equal(vars(found.lens), vars(start.lens))
    alone = adjust_sparse(replace(start, free_points=False), 10, 1.0)
    np.testing.assert_array_equal(alone.points, start.points)
    assert alone.cost < _cost(start, 1.0)


def test_the_cost_never_rises() -> None:
    start, cost = problem(moved=0.1), np.inf
    for steps in range(6):
        now = adjust_sparse(start, steps, 1.0, tolerance=0.0).cost
        assert now <= cost
        cost = now


def test_a_point_that_no_photograph_sees_stays_where_it_is() -> None:
    start = problem()
    unseen = replace(start, points=np.concatenate([start.points, [[7.0, 8.0, 9.0]]]))
    found = adjust_sparse(unseen, 5, 1.0)
    np.testing.assert_array_equal(found.points[-1], [7.0, 8.0, 9.0])
    np.testing.assert_array_equal(found.points[:-1], adjust_sparse(start, 5, 1.0).points)


def test_bad_input_is_refused() -> None:
    start = problem()
    with pytest.raises(ValueError, match="photographs and points that are there"):
        adjust_sparse(replace(start, point=start.point + 1), 1, 1.0)
    with pytest.raises(ValueError, match="photographs and points that are there"):
        adjust_sparse(replace(start, photograph=start.photograph - 1), 1, 1.0)
    with pytest.raises(ValueError, match="do not belong together"):
        adjust_sparse(replace(start, pixels=start.pixels[1:]), 1, 1.0)
    with pytest.raises(ValueError, match="sorted by point"):
        adjust_sparse(replace(start, point=start.point[::-1]), 1, 1.0)
    with pytest.raises(ValueError, match="points is not finite"):
        adjust_sparse(replace(start, points=np.full_like(start.points, np.nan)), 1, 1.0)
