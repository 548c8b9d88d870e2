"""What a sweep leaves out, against brute force, and that depth does not suffer from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.hypotheses import RangeConfig, range_of, valid_cells
from mvsgs_core.mvs.interface import TILE
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from mvsgs_core.mvs.pruning import PruningConfig, cell_bounds, tiles_in_cells
from mvsgs_core.mvs.stereo import StereoConfig, StereoDepth, estimate_depth
from tests.support.plane_scene import look, render, true_depth

SIZE = (96, 128)
CONFIG = PruningConfig(cell_radius=1, cell_percentile=10.0, cell_margin=1.5, min_cells=3)


def view(index: int, x: float) -> StereoKeyframe:
    pose = look(x)
    image, intrinsics = render(pose, SIZE)
    grid = (1.0 / true_depth(pose, SIZE)[4::8, 4::8]).astype(np.float32)
    return prepare_keyframe(index, image, intrinsics, pose, area=SIZE[0] * SIZE[1], scales=(1, 2), inverse_depth=grid)


def depth_of(pruning: PruningConfig, **changes: object) -> StereoDepth:
    reference = replace(view(0, 0.0), **changes)  # type: ignore[arg-type]
    search = range_of(valid_cells(view(0, 0.0), RangeConfig()), RangeConfig(margin=3.0), "given")
    neighbors = [view(i, x) for i, x in ((1, 0.4), (2, -0.4), (3, 0.8))]
    return estimate_depth(reference, neighbors, search, StereoConfig(pruning=pruning), NativeBackend(1))


def test_bounds_of_a_cell_are_those_of_the_known_cells_around() -> None:
    rng = np.random.default_rng(0)
    grid = rng.uniform(0.1, 1.0, (6, 8)).astype(np.float32)
    weight = (rng.random((6, 8)) < 0.6).astype(np.float32)
    low, high = cell_bounds(grid, weight, CONFIG)
    for y in range(6):
        for x in range(8):
            rows, columns = slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2)
            known = np.sort(grid[rows, columns][weight[rows, columns] > 0])
            if len(known) < CONFIG.min_cells:
                assert (low[y, x], high[y, x]) == (0.0, np.inf)
                continue
            out = int(len(known) * 0.1)
            assert low[y, x] == pytest.approx(known[out] / 1.5)
            assert high[y, x] == pytest.approx(known[len(known) - 1 - out] * 1.5)


def test_tiles_search_what_their_cells_leave_open() -> None:
    grid = np.full((12, 16), 0.2, np.float32)
    grid[:, 8:] = 0.8
    grid[:3, :3] = 0.0  # unknown
    reference = replace(view(0, 0.0), inverse_depth=grid, weight=np.ones_like(grid))
    tiles = tiles_in_cells(reference, SIZE, 0.1, 0.01, 100, CONFIG)
    assert tiles.shape == (SIZE[0] // TILE[0], 100, SIZE[1] // TILE[1])
    hypotheses = 0.1 + 0.01 * np.arange(100)
    far, near = tiles[6, :, 1] > 0, tiles[6, :, 7] > 0
    assert hypotheses[far].min() == pytest.approx(0.2 / 1.5, abs=0.02)
    assert hypotheses[far].max() == pytest.approx(0.2 * 1.5, abs=0.02)
    assert hypotheses[near].min() == pytest.approx(0.8 / 1.5, abs=0.02)
    assert tiles[0, :, 0].all()  # nothing is known there
    middle = hypotheses[tiles[6, :, 3] > 0]  # at the jump, both sides
    assert middle.min() < 0.2
    assert middle.max() > 0.8


def test_cells_that_contradict_the_range_close_no_tile() -> None:
    grid = np.full((12, 16), 50.0, np.float32)
    reference = replace(view(0, 0.0), inverse_depth=grid, weight=np.ones_like(grid))
    assert tiles_in_cells(reference, SIZE, 0.1, 0.01, 100, CONFIG).all()


def test_fewer_hypotheses_give_the_same_depth() -> None:
    whole, less = depth_of(PruningConfig(outside_cells=False)), depth_of(PruningConfig())
    truth = true_depth(look(0.0), SIZE)
    assert less.counts["outside the cells"] > 0.1 * less.counts["hypotheses"]
    assert whole.counts["outside the cells"] == 0
    for found in (whole, less):
        assert np.mean(np.abs(found.depth - truth) < 0.02 * truth) > 0.85


def test_without_the_limit_of_the_range_every_hypothesis_is_tried() -> None:
    all_of_them = depth_of(PruningConfig(outside_range=False, outside_cells=False))
    assert all_of_them.counts["outside the range"] == 0
    assert all_of_them.counts["hypotheses"] > depth_of(PruningConfig(outside_cells=False)).counts["hypotheses"]
