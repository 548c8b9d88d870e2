"""The C++ kernels against their PyTorch twins and against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.interface import TILE, CostOptions, SmoothOptions
from mvsgs_core.mvs.torch_backend import TorchBackend
from mvsgs_core.mvs.warp import relative_warp
from mvsgs_core.native import load
from tests.core.mvs.plane_scene import look, render

SIZE = (36, 52)
COST = CostOptions(radius=2, best=2)
SMOOTH = SmoothOptions()


def problem(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    poses = [look(0.0), look(0.15, 0.02), look(-0.1), look(0.3, -0.03)]
    images = [render(p, SIZE)[0][..., 0].astype(np.float32) - 128.0 for p in poses]
    intrinsics = render(poses[0], SIZE)[1]
    warps = np.stack([relative_warp(intrinsics, poses[0], intrinsics, p) for p in poses[1:]])
    first = 0.15 + 0.02 * rng.random(SIZE)
    return {
        "reference": images[0],
        "neighbors": np.stack(images[1:]),
        "warps": warps.astype(np.float32),
        "first": first.astype(np.float32),
        "step": np.full(SIZE, 0.02, dtype=np.float32),
    }


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_cost_volumes_of_both_backends_agree(radius: int) -> None:
    p = problem()
    options = replace(COST, radius=radius)
    native = NativeBackend(1).cost_volume(**p, hypotheses=9, options=options)
    twin = TorchBackend("cpu").cost_volume(**p, hypotheses=9, options=options)
    assert native.shape == (SIZE[0], 9, SIZE[1])
    assert native.min() >= 0
    assert native.max() <= 1
    # Rounding decides on which side of the border a sample falls: a few pixels may differ by more.
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    assert native.std() > 0.05


def test_tiles_that_are_not_needed_cost_one_and_the_others_stay() -> None:
    p = problem()
    rows, columns = (-(-size // tile) for size, tile in zip(SIZE, TILE, strict=True))
    needed = (np.random.default_rng(3).random((rows, 9, columns)) < 0.5).astype(np.uint8)
    whole = NativeBackend(1).cost_volume(**p, hypotheses=9, options=COST)
    part = NativeBackend(1).cost_volume(**p, hypotheses=9, options=COST, needed=needed)
    twin = TorchBackend("cpu").cost_volume(**p, hypotheses=9, options=COST, needed=needed)
    inside = needed.repeat(TILE[0], 0).repeat(TILE[1], 2)[: SIZE[0], :, : SIZE[1]] > 0
    np.testing.assert_allclose(part[inside], whole[inside], atol=1e-5)
    assert np.all(part[~inside] == 1)
    assert np.mean(np.abs(part - twin) > 1e-3) < 2e-3
    with pytest.raises(ValueError, match="tile rows"):
        NativeBackend(1).cost_volume(**p, hypotheses=9, options=COST, needed=needed[:, :8].copy())


def test_the_tile_is_the_kernels() -> None:
    assert load("stereo").TILE == TILE


def test_correlations_agree_and_mark_what_is_not_seen() -> None:
    p = problem()
    arguments = (p["reference"], p["neighbors"], p["warps"], np.full(SIZE, 0.22, np.float32), COST)
    native, twin = NativeBackend(1).view_correlation(*arguments), TorchBackend("cpu").view_correlation(*arguments)
    assert np.mean(np.abs(native - twin) > 1e-3) < 2e-3
    assert (native == -2).any()
    assert native.max() <= 1.001


@pytest.mark.parametrize("paths", [4, 8])
def test_smoothing_of_both_backends_agrees(paths: int) -> None:
    p = problem()
    p["first"][:, 30:] += 0.5  # a jump that must end the paths
    cost = np.random.default_rng(1).random((SIZE[0], 7, SIZE[1]), dtype=np.float32)
    options = replace(SMOOTH, paths=paths, small_jump=0.1, large_jump=0.4)
    native = NativeBackend(1).semi_global(cost, p["reference"], p["first"], p["step"], options)
    twin = TorchBackend("cpu").semi_global(cost, p["reference"], p["first"], p["step"], options)
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
    options = replace(SMOOTH, paths=4, small_jump=0.2, large_jump=0.5)
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
    found = NativeBackend(1).semi_global(cost, flat, flat, step, options)
    np.testing.assert_array_equal(found.best[0], total.argmin(axis=0))


def test_exposure_does_not_change_the_cost() -> None:
    p = problem()
    options = replace(COST, noise=0.01)
    plain = NativeBackend(1).cost_volume(**p, hypotheses=5, options=options)
    p["neighbors"] = 0.6 * p["neighbors"] + 20.0
    exposed = NativeBackend(1).cost_volume(**p, hypotheses=5, options=options)
    assert np.quantile(np.abs(plain - exposed), 0.99) < 0.02


def test_result_does_not_depend_on_threads() -> None:
    p = problem()
    one = NativeBackend(1).cost_volume(**p, hypotheses=5, options=COST)
    two = NativeBackend(2).cost_volume(**p, hypotheses=5, options=COST)
    np.testing.assert_array_equal(one, two)
    smooth = [NativeBackend(t).semi_global(one, p["reference"], p["first"], p["step"], SMOOTH) for t in (1, 2)]
    np.testing.assert_array_equal(smooth[0].index, smooth[1].index)


def test_bad_shapes_are_refused() -> None:
    p = problem()
    with pytest.raises(ValueError, match="size"):
        NativeBackend(1).cost_volume(**{**p, "first": p["first"][:-1].copy()}, hypotheses=5, options=COST)
    with pytest.raises(ValueError, match="one warp per neighbor"):
        NativeBackend(1).cost_volume(**{**p, "warps": p["warps"][:1].copy()}, hypotheses=5, options=COST)
