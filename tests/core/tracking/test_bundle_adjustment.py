"""Dense bundle adjustment against the published equations (golden), finite differences, and known scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import DROID_GLOBAL, DROID_LOCAL, Graph, Solver, adjust, reproject
from tests.support.keyframe_graphs import moved, scene
from tests.support.shared_data import shared

CASES = {
    # first free pose, solver, poses only, depth prior
    "a": ("A", 1, replace(DROID_LOCAL, steps=1), False, False),
    "b": ("A", 1, DROID_LOCAL, False, False),
    "c": ("A", 2, DROID_LOCAL, False, False),
    "d": ("A", 1, DROID_GLOBAL, False, False),
    "e": ("A", 1, DROID_LOCAL, True, False),
    "f": ("A", 1, DROID_LOCAL, False, True),
    "g": ("B", 1, DROID_LOCAL, False, False),
}


def matrices(poses: np.ndarray) -> np.ndarray:
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    quaternions = poses[:, [6, 3, 4, 5]].astype(np.float64)
    result[:, :3, :3] = geometry.rotation_from_quaternion(quaternions)
    result[:, :3, 3] = poses[:, :3]
    return result


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_agrees_with_droid_slams_equations(case: str) -> None:
    golden = np.load(shared("golden/droid") / "ba.npz")
    scene, first_free, solver, poses_only, with_prior = CASES[case]
    disps = golden[f"{scene}_disps"].astype(np.float64)
    k, h, w = disps.shape
    m = h * w
    v, u = np.mgrid[:h, :w].astype(np.float64)
    eta = golden[f"{scene}_eta"].astype(np.float64).reshape(k, m)
    sensed = golden[f"{scene}_disps_sens"].astype(np.float64).reshape(k, m)
    has_prior = with_prior & (sensed > 0)
    graph = Graph(
        cam_from_world=matrices(golden[f"{scene}_poses"]),
        inverse_depth=disps.reshape(k, m),
        pixels=np.tile(np.stack([u.ravel(), v.ravel()]), (k, 1, 1)),
        intrinsics=golden[f"{scene}_intrinsics"].astype(np.float64),
        source=golden[f"{scene}_ii"],
        to=golden[f"{scene}_jj"],
        target=golden[f"{scene}_target"].reshape(-1, 2, m).astype(np.float64),
        information=0.001 * golden[f"{scene}_weight"].reshape(-1, 2, m).astype(np.float64),
        free_pose=np.arange(k) >= first_free,
        free_depth=np.full(k, not poses_only),
        damping=np.where(has_prior, 0.0, eta) if with_prior else eta,
        prior=sensed if with_prior else None,
        prior_weight=np.where(has_prior, 0.05, 0.0) if with_prior else None,
    )
    solution = adjust(graph, solver)
    assert not solution.failure
    poses, disparities = (f"{case}_poses", None) if poses_only else (f"{case}_full_poses", f"{case}_full_disps")
    np.testing.assert_allclose(solution.cam_from_world, matrices(golden[poses]), atol=1e-8)
    if disparities:
        np.testing.assert_allclose(solution.inverse_depth.reshape(k, h, w), golden[disparities], atol=1e-8)


@pytest.mark.parametrize("focal", [False, True])
def test_a_step_is_the_one_of_numerical_jacobians(focal: bool) -> None:
    """One undamped step from a dense least-squares problem whose Jacobian is taken by central differences."""
    exact, *_ = scene(k=3, m=11, noise=0.5)  # 11: not a multiple of the vector width
    graph = replace(moved(exact, 1, 0.01, 0.05), free_pose=np.array([False, False, True]), free_focal=focal)
    k, m = graph.inverse_depth.shape
    a, b, c = graph.information[:, 0], graph.information[:, 1], graph.information[:, 2]
    root = np.linalg.cholesky(
        np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2) + 1e-12 * np.eye(2)
    )  # W = L L'

    def whitened(x: np.ndarray) -> np.ndarray:
        poses = graph.cam_from_world.copy()
        poses[2] = geometry.se3_exp(x[:6]) @ poses[2]
        intrinsics = graph.intrinsics * np.exp([x[6], x[6], 0.0, 0.0])
        depths = graph.inverse_depth + x[7:].reshape(k, m)
        pixels, _ = reproject(poses, depths, graph.pixels, intrinsics, graph.source, graph.to)
        return np.einsum("emji,ejm->emi", root, graph.target - pixels).ravel()

    n = 7 + k * m
    h = 1e-6
    jacobian = np.stack([(whitened(h * e) - whitened(-h * e)) / (2 * h) for e in np.eye(n)], axis=1)
    used = np.arange(n) if focal else np.delete(np.arange(n), 6)
    expected = np.zeros(n)
    expected[used] = np.linalg.lstsq(jacobian[:, used], -whitened(np.zeros(n)), rcond=None)[0]
    solver = Solver(steps=1, adaptive=False, lm=0.0, ep=0.0, robust="none", min_z=0.3)
    graph = replace(graph, damping=np.full((k, m), 1e-12))
    solution = adjust(graph, solver)
    assert not solution.failure
    pose = solution.cam_from_world[2] @ geometry.inverse(graph.cam_from_world[2])
    np.testing.assert_allclose(geometry.se3_log(pose), expected[:6], atol=2e-6)
    np.testing.assert_allclose(solution.inverse_depth - graph.inverse_depth, expected[7:].reshape(k, m), atol=2e-5)
    np.testing.assert_allclose(np.log(solution.focal_factor), expected[6], atol=2e-6)


@pytest.mark.parametrize("robust", ["none", "cauchy"])
def test_finds_the_true_scene(robust: str) -> None:
    graph, poses, inverse_depth = scene(k=5, m=80)
    start = replace(moved(graph, 2, 0.01, 0.05), free_pose=np.arange(5) > 1)  # two poses: the gauge with its scale
    start = replace(start, cam_from_world=np.concatenate([poses[:2], start.cam_from_world[2:]]))
    solution = adjust(start, Solver(steps=40, robust=robust, robust_scale=3.0, tolerance=0.0, min_z=0.3))
    assert solution.cost < 1e-12 * solution.initial_cost
    np.testing.assert_allclose(solution.cam_from_world, poses, atol=1e-6)
    seen = solution.information > 1.0
    np.testing.assert_allclose(solution.inverse_depth[seen], inverse_depth[seen], atol=1e-5)


def test_outliers_do_not_move_a_robust_solution() -> None:
    graph, poses, _ = scene(k=4, m=100)
    random = np.random.default_rng(5)
    wrong = random.random(graph.target[:, 0].shape) < 0.2
    graph = replace(graph, target=graph.target + 40.0 * wrong[:, None], free_depth=np.zeros(4, bool))
    graph = replace(graph, free_pose=np.arange(4) == 3)
    start = replace(graph, cam_from_world=moved(graph, 3, 0.01, 0.0).cam_from_world)
    errors = {
        robust: float(np.abs(adjust(start, Solver(steps=30, robust=robust)).cam_from_world - poses).max())
        for robust in ("none", "cauchy")
    }
    assert errors["cauchy"] < 0.01 * errors["none"]


def test_pose_only_and_structure_only_leave_the_rest_alone() -> None:
    graph, poses, inverse_depth = scene()
    start = moved(graph, 4, 0.01, 0.05)
    pose_only = replace(start, inverse_depth=inverse_depth, free_depth=np.zeros(4, bool))
    solution = adjust(pose_only, Solver(steps=20, tolerance=0.0, min_z=0.3))
    np.testing.assert_array_equal(solution.inverse_depth, inverse_depth)
    np.testing.assert_allclose(solution.cam_from_world, poses, atol=1e-7)
    structure_only = replace(start, cam_from_world=poses, free_pose=np.zeros(4, bool))
    solution = adjust(structure_only, Solver(steps=30, tolerance=0.0, min_z=0.3, robust="none"))
    np.testing.assert_array_equal(solution.cam_from_world, poses)
    seen = solution.information > 10.0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(solution.inverse_depth[seen], inverse_depth[seen], atol=1e-4)


def test_a_singular_system_is_reported_and_changes_nothing() -> None:
    graph, *_ = scene()
    nothing = replace(graph, information=np.zeros_like(graph.information))
    solution = adjust(nothing, Solver(lm=0.0, ep=0.0, adaptive=False))
    assert "positive definite" in solution.failure
    assert solution.steps == 0
    np.testing.assert_array_equal(solution.cam_from_world, graph.cam_from_world)


def test_a_free_scale_is_ill_conditioned() -> None:
    graph, *_ = scene(k=3)
    free = adjust(graph, Solver(steps=1, adaptive=False, lm=0.0, ep=0.0, robust="none"))
    held = adjust(
        replace(graph, free_pose=np.arange(3) > 1), Solver(steps=1, adaptive=False, lm=0.0, ep=0.0, robust="none")
    )
    assert free.smallest_pivot < 1e-7 or free.failure
    assert held.smallest_pivot > 1e-7


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_do_not_change_the_result(threads: int) -> None:
    graph, *_ = scene(noise=1.0)
    one = adjust(graph, Solver(threads=1))
    other = adjust(graph, Solver(threads=threads))
    np.testing.assert_array_equal(one.cam_from_world, other.cam_from_world)
    np.testing.assert_array_equal(one.inverse_depth, other.inverse_depth)


def test_bad_graphs_are_refused() -> None:
    graph, *_ = scene()
    with pytest.raises(ValueError, match=r"Graph\.target"):
        adjust(replace(graph, target=graph.target[:-1]), Solver())
    with pytest.raises(ValueError, match="two different keyframes"):
        adjust(replace(graph, to=graph.source), Solver())
    with pytest.raises(ValueError, match="not finite"):
        adjust(replace(graph, information=np.full_like(graph.information, np.nan)), Solver())
