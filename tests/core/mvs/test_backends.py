"""The C++ kernels against their PyTorch twins and against brute force."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.cascade import Cascade
from mvsgs_core.mvs.interface import TILE, Backend, ChooseOptions, MatchingImages, SmoothingConfig, SurfaceEstimate
from mvsgs_core.mvs.learned import LearnedStereoConfig
from mvsgs_core.mvs.matching_cost import COSTS, CostConfig
from mvsgs_core.mvs.torch_backend import TorchBackend
from mvsgs_core.native import load
from tests.support.stereo_problems import SIZE, Problem, problem

COST = CostConfig(top_k=2)
SMOOTH = SmoothingConfig()


def test_the_plane_sweep_stays_with_the_kernels_beside_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert isinstance(Cascade()._backend, NativeBackend)
    assert LearnedStereoConfig().device == "auto"  # of networks a GPU takes a fraction of the time


def swept(
    backend: Backend, p: Problem, count: int, cost: CostConfig = COST, radius: int = 2, needed: np.ndarray | None = None
) -> np.ndarray:
    return backend.cost_volume(p.images, p.first, p.step, count, radius, cost, needed)


def smoothed(
    backend: Backend, cost: np.ndarray, p: Problem, p1: float = 0.3, p2: float = 2.0, options: SmoothingConfig = SMOOTH
) -> SurfaceEstimate:
    return backend.semi_global(cost, p.images.reference, p.first, p.step, p1, p2, options)


@pytest.mark.slow
@pytest.mark.parametrize("name", COSTS)
@pytest.mark.parametrize("radius", [1, 2, 3])
def test_cost_volumes_of_both_backends_agree(name: Any, radius: int) -> None:
    p, config = problem(), replace(COST, name=name)
    native, twin = (swept(b, p, 9, config, radius=radius) for b in (NativeBackend(1), TorchBackend("cpu")))
    assert native.shape == (SIZE[0], 9, SIZE[1])
    assert native.min() >= 0
    assert native.max() <= 1
    # Rounding decides on which side of the border a sample falls: a few pixels may differ by more.
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    assert native.std() > 0.05


def test_a_part_of_the_cost_is_the_difference_of_gray_level() -> None:
    p = problem()
    options = replace(COST, intensity_weight=0.4, intensity_range=15.0)
    native, twin = (swept(b, p, 9, options) for b in (NativeBackend(1), TorchBackend("cpu")))
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    assert native.min() >= 0
    assert native.max() <= 1
    # Against itself at no motion, ten gray levels brighter: ZNCC sees nothing, that costs 0.4 * 10 / 15.
    stays = np.concatenate([np.eye(3).ravel(), np.zeros(3)])[None].astype(np.float32)
    own = replace(p, images=MatchingImages(p.images.reference, p.images.reference[None] + 10.0, stays))
    cost = swept(NativeBackend(1), own, 1, replace(options, top_k=1, noise=1e-3))
    np.testing.assert_allclose(cost[:, 0], 0.4 * 10.0 / 15.0, atol=2e-3)
    for backend in (NativeBackend(1), TorchBackend("cpu")):
        with pytest.raises(ValueError, match="intensity_weight"):
            swept(backend, p, 1, replace(COST, intensity_weight=1.5))


@pytest.mark.parametrize("noise", [0.0, -1.0, 1e-20, np.inf, np.nan])
def test_a_noise_under_which_flat_windows_have_no_correlation_is_refused(noise: float) -> None:
    with pytest.raises(ValueError, match="noise"):
        replace(COST, noise=noise)
    given = SimpleNamespace(**{**vars(COST), "noise": noise})
    p = problem()
    with pytest.raises(ValueError, match="noise"):
        swept(NativeBackend(1), p, 1, cast(CostConfig, given))
    with pytest.raises(ValueError, match="noise"):
        NativeBackend(1).view_correlation(p.images, p.first, 2, cast(CostConfig, given))


def test_flat_windows_of_least_noise_have_a_cost() -> None:
    flat = np.full(SIZE, 100.0, np.float32)
    p = problem()
    p = replace(p, images=replace(p.images, reference=flat, neighbors=np.stack([flat] * 3)))
    for backend in (NativeBackend(1), TorchBackend("cpu")):
        assert np.isfinite(swept(backend, p, 3, replace(COST, noise=1e-6))).all()


def test_a_cost_of_no_hypothesis_is_refused() -> None:
    p = problem()
    with pytest.raises(ValueError, match="H, D, W"):
        smoothed(NativeBackend(1), np.zeros((SIZE[0], 0, SIZE[1]), np.float32), p)


def test_the_mean_may_be_of_more_than_eight_views() -> None:
    p = problem()
    neighbors, warps = (np.repeat(each, 6, axis=0) for each in (p.images.neighbors, p.images.warps))
    many = replace(p.images, neighbors=neighbors, warps=warps)
    assert len(many.neighbors) > 10
    options = replace(COST, top_k=len(many.neighbors))
    native, twin = (swept(b, replace(p, images=many), 9, options) for b in (NativeBackend(1), TorchBackend("cpu")))
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3


def test_a_cost_that_there_is_not_is_refused_with_those_that_there_are() -> None:
    for backend in (NativeBackend(1), TorchBackend("cpu")):
        with pytest.raises(ValueError, match=r"no matching cost 'ncc'; there are: .*zncc"):
            swept(backend, problem(), 1, replace(COST, name="ncc"))  # type: ignore[arg-type]


def test_tiles_that_are_not_needed_cost_one_and_the_others_stay() -> None:
    p = problem()
    rows, columns = (-(-size // tile) for size, tile in zip(SIZE, TILE, strict=True))
    needed = (np.random.default_rng(3).random((rows, 9, columns)) < 0.5).astype(np.uint8)
    whole = swept(NativeBackend(1), p, 9)
    part = swept(NativeBackend(1), p, 9, needed=needed)
    twin = swept(TorchBackend("cpu"), p, 9, needed=needed)
    inside = needed.repeat(TILE[0], 0).repeat(TILE[1], 2)[: SIZE[0], :, : SIZE[1]] > 0
    np.testing.assert_allclose(part[inside], whole[inside], atol=1e-5)
    assert np.all(part[~inside] == 1)
    assert np.mean(np.abs(part - twin) > 1e-3) < 2e-3
    with pytest.raises(ValueError, match="tile rows"):
        swept(NativeBackend(1), p, 9, needed=needed[:, :8].copy())


def test_the_tile_is_the_kernels() -> None:
    assert load("mvs").TILE == TILE


def test_correlations_agree_and_mark_what_is_not_seen() -> None:
    p = problem()
    arguments = (p.images, np.full(SIZE, 0.22, np.float32), 2, COST)
    native, twin = NativeBackend(1).view_correlation(*arguments), TorchBackend("cpu").view_correlation(*arguments)
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    assert (native == -2).any()
    assert native.max() <= 1.001


@pytest.mark.parametrize("paths", [4, 8])
def test_smoothing_of_both_backends_agrees(paths: int) -> None:
    p = problem()
    p.first[:, 30:] += 0.5  # a jump that must end the paths
    cost = np.random.default_rng(1).random((SIZE[0], 7, SIZE[1]), dtype=np.float32)
    options = replace(SMOOTH, paths=paths)
    native, twin = (smoothed(b, cost, p, 0.1, 0.4, options) for b in (NativeBackend(1), TorchBackend("cpu")))
    same = native.best == twin.best
    assert same.mean() > 0.995  # near ties may fall to either side
    for name in ("index", "probability", "margin"):
        np.testing.assert_allclose(getattr(native, name)[same], getattr(twin, name)[same], atol=2e-3)


def test_smoothing_is_the_minimum_over_all_paths_of_a_line() -> None:
    """On one row the horizontal path cost is a shortest path: enumerate them all."""
    rng = np.random.default_rng(2)
    width, count = 5, 3
    cost = rng.random((1, count, width), dtype=np.float32)
    flat, step = np.zeros((1, width), np.float32), np.ones((1, width), np.float32)
    jump = np.array([[0.0, 0.2, 0.5], [0.2, 0.0, 0.2], [0.5, 0.2, 0.0]])
    forward = np.zeros((count, width))
    forward[:, 0] = cost[0, :, 0]
    for x in range(1, width):
        forward[:, x] = cost[0, :, x] + (forward[:, x - 1][None] + jump).min(axis=1) - forward[:, x - 1].min()
    backward = np.zeros((count, width))
    backward[:, -1] = cost[0, :, -1]
    for x in range(width - 2, -1, -1):
        backward[:, x] = cost[0, :, x] + (backward[:, x + 1][None] + jump).min(axis=1) - backward[:, x + 1].min()
    total = (forward + backward + 2 * cost[0]) / 4  # up and down: a row alone
    found = NativeBackend(1).semi_global(cost, flat, flat, step, 0.2, 0.5, replace(SMOOTH, paths=4))
    np.testing.assert_array_equal(found.best[0], total.argmin(axis=0))


def test_exposure_does_not_change_the_cost() -> None:
    p = problem()
    options = replace(COST, noise=0.01)
    plain = swept(NativeBackend(1), p, 5, options)
    darker = replace(p, images=replace(p.images, neighbors=0.6 * p.images.neighbors + 20.0))
    exposed = swept(NativeBackend(1), darker, 5, options)
    assert np.quantile(np.abs(plain - exposed), 0.99) < 0.02


def test_result_does_not_depend_on_threads() -> None:
    p = problem()
    one, two = (swept(NativeBackend(threads), p, 5) for threads in (1, 2))
    np.testing.assert_array_equal(one, two)
    smooth = [smoothed(NativeBackend(threads), one, p) for threads in (1, 2)]
    np.testing.assert_array_equal(smooth[0].index, smooth[1].index)


def test_bad_shapes_are_refused() -> None:
    p = problem()
    with pytest.raises(ValueError, match="size"):
        swept(NativeBackend(1), replace(p, first=p.first[:-1].copy()), 5)
    with pytest.raises(ValueError, match="one warp per neighbor"):
        swept(NativeBackend(1), replace(p, images=replace(p.images, warps=p.images.warps[:1].copy())), 5)


def surfaces_of(p: Problem, count: int) -> np.ndarray:
    return np.stack([p.first + k * p.step for k in range(count)])


def test_the_cost_of_surfaces_is_that_of_a_sweep_through_them() -> None:
    p = problem()
    needed = np.ones((-(-SIZE[0] // TILE[0]), 5, -(-SIZE[1] // TILE[1])), np.uint8)
    needed[1, :, 1] = 0
    native = NativeBackend(2).surface_costs(p.images, surfaces_of(p, 5), 2, COST, needed)
    np.testing.assert_allclose(native, swept(NativeBackend(1), p, 5, needed=needed))
    twin = TorchBackend("cpu").surface_costs(p.images, surfaces_of(p, 5), 2, COST, needed)
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    with pytest.raises(ValueError, match="surfaces"):
        NativeBackend(1).surface_costs(p.images, surfaces_of(p, 5)[:, 1:].copy(), 2, COST)


@pytest.mark.parametrize("count", [1, 6])
def test_choices_of_both_backends_agree(count: int) -> None:
    p = problem()
    rng = np.random.default_rng(4)
    cost = rng.random((SIZE[0], count, SIZE[1]), dtype=np.float32)
    surfaces = np.concatenate([surfaces_of(p, count)[:, :18], rng.permuted(surfaces_of(p, count)[:, 18:], axis=0)], 1)
    options = ChooseOptions(p1=20.0, p2=0.6, edge=12.0, apart=0.03)
    best, gap = NativeBackend(2).choose_surface(cost, surfaces, p.images.reference, options)
    twin, twin_gap = TorchBackend("cpu").choose_surface(cost, surfaces, p.images.reference, options)
    same = best == twin
    assert same.mean() > 0.995  # near ties may fall to either side
    np.testing.assert_allclose(gap[same], twin_gap[same], atol=2e-3)
    again = NativeBackend(1).choose_surface(cost, surfaces, p.images.reference, options)
    np.testing.assert_array_equal(best, again[0])


def test_choosing_a_surface_is_the_minimum_over_all_paths_of_a_line() -> None:
    """On one row the horizontal path cost is a shortest path: enumerate them all."""
    rng = np.random.default_rng(5)
    width, count = 6, 4
    cost = rng.random((1, count, width), dtype=np.float32)
    surfaces = rng.random((count, 1, width), dtype=np.float32)
    jump = np.minimum(0.8 * np.abs(surfaces[:, None, 0, 1:] - surfaces[None, :, 0, :-1]), 0.3)  # (to, from, x)
    lines = []
    for line, jumps in ((cost[0], jump), (cost[0, :, ::-1], jump.transpose(1, 0, 2)[:, :, ::-1])):
        path = line.copy()
        for x in range(1, width):
            path[:, x] += (path[:, x - 1] + jumps[:, :, x - 1]).min(axis=1) - path[:, x - 1].min()
        lines.append(path)
    total = (lines[0] + lines[1][:, ::-1] + 6 * cost[0]) / 8  # up, down, aslant: a row alone
    options = ChooseOptions(p1=0.8, p2=0.3, edge=12.0, apart=0.1)
    best, gap = NativeBackend(1).choose_surface(cost, surfaces, np.zeros((1, width), np.float32), options)
    np.testing.assert_array_equal(best[0], total.argmin(axis=0))
    ahead = np.abs(surfaces[:, 0] - np.take_along_axis(surfaces[:, 0], best, axis=0)) > 0.1
    expected = np.where(ahead, total - total.min(axis=0), 1.0).min(axis=0)
    np.testing.assert_allclose(gap[0], expected, atol=1e-6)
