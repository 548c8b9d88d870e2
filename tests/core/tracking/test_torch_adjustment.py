"""Bundle adjustment in PyTorch gives what the C++ kernel gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.tracking.estimation import torch_adjustment
from mvsgs_core.tracking.estimation.bundle_adjustment import DROID_LOCAL, Graph, Solution, Solver, adjust
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig
from tests.support.gpu import GPU
from tests.support.keyframe_graphs import noisy
from tests.support.sequences import synthetic


def both(graph: Graph, solver: Solver) -> tuple[Solution, Solution]:
    return adjust(graph, solver), adjust(graph, replace(solver, device="torch"))


def assert_equal(graph: Graph, solver: Solver) -> None:
    kernel, other = both(graph, solver)
    assert (other.failure, other.steps) == (kernel.failure, kernel.steps)
    assert kernel.steps > 0
    np.testing.assert_allclose(other.cam_from_world, kernel.cam_from_world, atol=1e-8)
    np.testing.assert_allclose(other.inverse_depth, kernel.inverse_depth, atol=1e-8)
    np.testing.assert_allclose(other.information, kernel.information, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(other.focal_factor, kernel.focal_factor, atol=1e-9)
    np.testing.assert_allclose((other.initial_cost, other.cost), (kernel.initial_cost, kernel.cost), rtol=1e-9)
    np.testing.assert_allclose(other.smallest_pivot, kernel.smallest_pivot, rtol=1e-5)


@pytest.mark.parametrize("robust", ["none", "cauchy"])
@pytest.mark.parametrize("focal", [False, True])
def test_it_equals_the_kernel(robust: str, focal: bool) -> None:
    # a sixth step without robust weights has nothing left to gain but rounding, which decides whether it is taken
    assert_equal(replace(noisy(), free_focal=focal), Solver(steps=5, robust=robust, robust_scale=1.5, tolerance=0.0))


def test_plain_gauss_newton_with_a_prior_and_diagonal_information() -> None:
    graph = noisy()
    random = np.random.default_rng(3)
    weight = random.uniform(0.0, 5.0, graph.inverse_depth.shape) * (random.random(graph.inverse_depth.shape) < 0.5)
    graph = replace(
        graph,
        information=np.ascontiguousarray(graph.information[:, [0, 2]]),
        damping=random.uniform(0.01, 0.1, graph.inverse_depth.shape),
        prior=np.ones_like(graph.inverse_depth),
        prior_weight=weight,
    )
    assert_equal(graph, replace(DROID_LOCAL, steps=3))


def test_some_poses_and_depths_held_some_keyframes_without_edges_some_edges_twice() -> None:
    graph = noisy(k=6)
    keep = (graph.source != 4) & (graph.to != 5) & (graph.source != 5)
    order = np.concatenate([np.flatnonzero(keep), np.flatnonzero(keep)[::3]])
    graph = replace(
        graph,
        source=graph.source[order],
        to=graph.to[order],
        target=graph.target[order],
        information=graph.information[order],
        free_pose=np.array([False, True, False, True, True, True]),
        free_depth=np.array([True, True, False, True, True, True]),
    )
    assert_equal(graph, Solver(steps=5, tolerance=0.0))


@pytest.mark.slow
def test_poses_only_and_structure_only() -> None:
    graph = noisy()
    assert_equal(replace(graph, free_depth=np.zeros(5, bool)), Solver(steps=5))
    assert_equal(replace(graph, free_pose=np.zeros(5, bool)), Solver(steps=5))


@pytest.mark.slow
def test_a_large_graph_is_taken_in_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = noisy(k=7)
    monkeypatch.setattr(torch_adjustment, "_DENSE", 2 * 6 * 6 * 61 + 1)  # two keyframes at a time
    assert_equal(graph, Solver(steps=4, tolerance=0.0))


def test_a_singular_system_is_reported_and_changes_nothing() -> None:
    graph = noisy()
    nothing = replace(graph, information=np.zeros_like(graph.information))
    kernel, other = both(nothing, Solver(lm=0.0, ep=0.0, adaptive=False))
    assert other.failure == kernel.failure != ""
    np.testing.assert_array_equal(other.cam_from_world, graph.cam_from_world)
    np.testing.assert_array_equal(other.inverse_depth, graph.inverse_depth)


def test_a_missing_gpu_is_an_error_that_says_so() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(ValueError, match="no CUDA device"):
        adjust(noisy(), Solver(device="cuda"))
    with pytest.raises(ValueError, match="no CUDA device"):
        Tracker(TrackerConfig(device="cuda:0"))


@pytest.mark.slow
def test_a_tracker_on_torch_finds_the_same_path() -> None:
    paths = []
    for device in ("cpu", "torch"):
        tracker = Tracker(TrackerConfig(area=160 * 120, device=device))
        for item in synthetic(frames=80)[:30]:
            tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        assert tracker.phase is Phase.TRACKING
        list(tracker.finish())
        paths.append(tracker.trajectory().world_from_cam)
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-5)


@pytest.mark.parametrize("device", [GPU])
def test_a_gpu_gives_the_same_twice_and_what_the_cpu_gives(device: str) -> None:
    graph = noisy()
    solver = Solver(steps=6, tolerance=0.0)
    kernel, first, second = (adjust(graph, replace(solver, device=d)) for d in ("cpu", device, device))
    np.testing.assert_array_equal(first.cam_from_world, second.cam_from_world)
    np.testing.assert_allclose(first.cam_from_world, kernel.cam_from_world, atol=1e-8)
    np.testing.assert_allclose(first.inverse_depth, kernel.inverse_depth, atol=1e-8)
