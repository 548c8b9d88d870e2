"""Search ranges, neighbors and the surfaces between stages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.inverse_depth import enlarge_inverse_depth
from mvsgs_core.keyframe_window import Correction
from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig
from mvsgs_core.mvs.hypotheses import RangeConfig, SearchRange, fill_uncertain, search_range, upsample_surface
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from mvsgs_core.mvs.neighbors import NeighborConfig, select_neighbors
from mvsgs_core.mvs.stereo import StereoConfig, estimate_depth
from mvsgs_core.warp import apply_warp, parallax, relative_warp
from tests.support.plane_scene import look, render, true_depth

SIZE = (96, 128)
TYPICAL = np.array([0.2, 0.3, 0.45])


def view(index: int, x: float, turn: float = 0.0) -> StereoKeyframe:
    pose = look(x, turn)
    image, intrinsics = render(pose, SIZE)
    grid = (1.0 / true_depth(pose, SIZE)[4::8, 4::8]).astype(np.float32)
    return prepare_keyframe(
        index, image, intrinsics, pose, area=SIZE[0] * SIZE[1], scales=(1, 2), inverse_depth=grid
    )  # fmt: skip


def test_a_few_wrong_cells_do_not_widen_the_range() -> None:
    reference = view(0, 0.0)
    clean = search_range(reference, [], None, RangeConfig())
    grid = reference.inverse_depth.copy()
    grid[0, :2] = 100.0
    grid[1, 0] = np.nan
    dirty = search_range(replace(reference, inverse_depth=grid), [], None, RangeConfig())
    assert clean is not None
    assert dirty is not None
    assert dirty.high == pytest.approx(clean.high, rel=0.05)
    truth = 1.0 / true_depth(reference.world_from_cam, SIZE)
    assert dirty.low < truth.min()
    assert dirty.high > truth.max()


def test_the_range_comes_from_whoever_knows() -> None:
    reference, other = view(0, 0.0), view(1, 0.2)
    blind = replace(reference, inverse_depth=np.zeros_like(reference.inverse_depth))
    own = search_range(reference, [other], None, RangeConfig())
    theirs = search_range(blind, [other], None, RangeConfig())
    before = search_range(blind, [], SearchRange(0.1, 0.5, "own grid"), RangeConfig())
    assert own is not None
    assert theirs is not None
    assert before is not None
    assert (own.source, theirs.source, before.source) == ("own grid", "neighbors' grids", "previous keyframe")
    assert theirs.high == pytest.approx(own.high, rel=0.3)
    assert search_range(blind, [], None, RangeConfig()) is None


@pytest.mark.parametrize("segment", [0, 1])
def test_a_range_that_is_remembered_follows_the_maps_scale_and_segment(segment: int) -> None:
    """Only the first keyframe has a grid, and before the last one the map gets twice as large."""
    blind = {"inverse_depth": np.zeros((12, 16), np.float32), "segment": segment}
    first = replace(view(0, 0.0), segment=segment)
    views = [first, *(replace(view(i, 0.2 * i), **blind) for i in range(1, 4))]
    cascade = Cascade(CascadeConfig(area=SIZE[0] * SIZE[1], window=0, lag=1, threads=1))
    before = [found.search for v in views[:3] for found in cascade.add(v)]
    assert [search.source for search in before if search] == ["own grid", "neighbors' grids"]
    doubled = [v.world_from_cam.copy() for v in views]
    for pose in doubled:
        pose[:3, 3] *= 2.0
    corrections = {v.index: Correction(doubled[v.index], 2.0, segment=0) for v in views[:3]}
    for _ in range(2):  # absolute: a second time changes nothing
        cascade.move(corrections)
    (late,) = cascade.add(replace(views[3], world_from_cam=doubled[3], scale=2.0, segment=0))
    assert before[1] is not None
    assert late.search == SearchRange(before[1].low / 2.0, before[1].high / 2.0, "previous keyframe")


def test_neighbors_come_from_both_sides_and_have_a_baseline() -> None:
    views = [view(i, 0.15 * (i - 4)) for i in range(9)]
    chosen = select_neighbors(views[4], [v for v in views if v.index != 4], TYPICAL, NeighborConfig())
    indices = {n.view.index for n in chosen}
    assert len(indices) == 4
    assert any(i < 4 for i in indices)
    assert any(i > 4 for i in indices)
    assert all(n.angle > 0.4 for n in chosen)


def test_a_camera_that_moves_forward_has_neighbors() -> None:
    """Nothing in the middle of its images has parallax; a far step shows everything at another size."""

    def ahead(index: int, z: float) -> StereoKeyframe:
        keyframe = view(index, 0.0)
        pose = keyframe.world_from_cam.copy()
        pose[:3, 3] += z * pose[:3, 2]
        return replace(keyframe, world_from_cam=pose)

    others = [ahead(i, -0.5 * i) for i in range(1, 7)]
    chosen = select_neighbors(ahead(0, 0.0), others, TYPICAL, NeighborConfig(count=2))
    assert {n.view.index for n in chosen} == {1, 2}
    assert all(n.angle > 2.0 for n in chosen)


def test_what_only_turned_or_looks_elsewhere_is_no_neighbor() -> None:
    reference = view(0, 0.0)
    assert select_neighbors(reference, [view(1, 0.0, 0.2), view(2, 0.3, 2.5)], TYPICAL, NeighborConfig()) == []


def test_parallax_is_the_derivative_of_the_warp() -> None:
    a, b = view(0, 0.0), view(1, 0.2)
    warp = relative_warp(a.intrinsics, a.world_from_cam, b.intrinsics, b.world_from_cam)
    x0, _, z = apply_warp(warp, np.array(50.0), np.array(40.0), np.array(0.25))
    x1, _, _ = apply_warp(warp, np.array(50.0), np.array(40.0), np.array(0.26))
    assert z > 0
    assert parallax(warp, SIZE, 0.25) == pytest.approx(abs(x1 - x0) / 0.01, rel=1e-6)


def test_upsampling_does_not_mix_the_two_sides_of_a_jump() -> None:
    coarse = np.full((12, 16), 0.2, np.float32)
    coarse[:, 8:] = 0.6
    fine = upsample_surface(coarse, (24, 32), max_gap=0.05)
    assert np.all((np.abs(fine - 0.2) < 1e-6) | (np.abs(fine - 0.6) < 1e-6))
    ramp = np.tile(np.linspace(0.2, 0.3, 16, dtype=np.float32), (12, 1))
    assert np.ptp(np.diff(upsample_surface(ramp, (24, 32), max_gap=0.05)[12, 4:-4])) < 1e-3


def test_the_membrane_bridges_a_plane() -> None:
    v, u = np.mgrid[0:40, 0:60]
    plane = (0.2 + 0.002 * u + 0.001 * v).astype(np.float32)
    sure = np.ones_like(plane)
    sure[12:28, 20:40] = 0
    broken = np.where(sure > 0, plane, 1.0).astype(np.float32)
    filled = fill_uncertain(broken, sure, np.zeros_like(plane))
    np.testing.assert_array_equal(filled[sure > 0], plane[sure > 0])
    assert np.abs(filled - plane).max() < 0.05 * plane.mean()


def test_depth_of_one_view_is_right_and_confidence_knows_where() -> None:
    reference = view(0, 0.0)
    truth = true_depth(reference.world_from_cam, SIZE)
    # With neighbors on one side there is a strip that none of them sees, and with both there is hardly an error.
    for places, right in (((-0.3, -0.15, 0.15, 0.3), 0.98), ((0.1, 0.2, 0.3, 0.4), 0.9)):
        neighbors = [view(i, x) for i, x in enumerate(places, start=1)]
        found = estimate_depth(
            reference, neighbors, SearchRange(0.12, 0.8, "given"), StereoConfig(), NativeBackend(1)
        )  # fmt: skip
        good = np.abs(found.depth - truth) < 0.05 * truth
        assert good.mean() > right
        assert good[found.confidence > 0.9].mean() > 0.95
    assert found.confidence[good].mean() > found.confidence[~good].mean() + 0.2
    with pytest.raises(ValueError, match="neighbor"):
        estimate_depth(reference, [], SearchRange(0.1, 1.0, "given"), StereoConfig(), NativeBackend(1))


def test_coarse_depth_ignores_unknown_cells() -> None:
    grid = np.full((6, 8), 0.5, np.float32)
    grid[2, 3] = np.nan
    grid[4:, :] = 0
    depth, confidence = enlarge_inverse_depth(grid, np.ones_like(grid), (48, 64))
    np.testing.assert_allclose(depth[depth > 0], 2.0, rtol=1e-5)
    assert not (depth[44:] > 0).any()
    assert (depth[:24] > 0).mean() > 0.9
    assert np.all((confidence > 0) == (depth > 0))
