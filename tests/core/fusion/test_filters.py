"""Filters of one depth map: edges of near surfaces, and small patches."""

from __future__ import annotations

import numpy as np

from mvsgs_core.fusion.backend import NativeFusionBackend
from mvsgs_core.fusion.filters import discontinuity_mask, speckle_mask
from mvsgs_core.fusion.fusion import FusionConfig, fuse
from tests.support.depth_views import view


def test_the_edge_of_the_near_surface_goes_and_what_lies_behind_stays() -> None:
    depth = np.full((30, 40), 4.0, np.float32)
    depth[:, :20] = 2.0
    depth[:, 30:] = 0.0  # unknown: not farther
    reject = discontinuity_mask(depth, 3)
    assert not reject[:, :17].any()
    assert reject[:, 17:20].all()
    assert not reject[:, 20:].any()
    assert not discontinuity_mask(depth, 0).any()


def test_a_slanted_surface_has_no_edge() -> None:
    depth = np.tile(np.linspace(2.0, 3.0, 100, dtype=np.float32), (20, 1))
    assert not discontinuity_mask(depth, 3).any()


def test_a_steep_road_has_no_edge_and_what_stands_on_it_has() -> None:
    rows = np.arange(40, dtype=np.float32)
    depth = np.tile((100.0 / (rows + 6.0))[:, None], (1, 60))  # a plane: three pixels change its depth by 7 to 50 %
    assert not discontinuity_mask(depth, 3)[3:-3, 3:-3].any()  # beside the image's border there is one side only
    depth[10:30, 20:30] = 100.0 / 36.0  # an upright board: its foot is on the road, its sides and top before it
    reject = discontinuity_mask(depth, 3)
    assert reject[10:24, 20:23].all()
    assert reject[10:24, 27:30].all()
    assert reject[10:13, 20:30].all()
    assert not reject[3:-3, 3:17].any()


def test_beside_unknown_depth_a_fall_is_an_edge() -> None:
    depth = np.full((20, 30), 4.0, np.float32)
    depth[:, 10:15] = 2.0
    depth[:, :10] = 0.0
    reject = discontinuity_mask(depth, 3)
    assert reject[:, 12:15].all()
    assert not reject[:, 15:].any()


def test_small_patches_go_at_any_scale_and_large_ones_stay() -> None:
    for scale in (1e-3, 1.0, 1e4):
        depth = np.zeros((40, 40), np.float32)
        depth[:, :20] = np.linspace(2.0, 3.0, 20)  # steps of 2.5 % at most: one patch at a tolerance of 3 %
        depth[5:8, 5:8] = 9.0  # in it, but apart
        depth[20:24, 30:34] = 2.0
        expected = np.zeros(depth.shape, dtype=bool)
        expected[5:8, 5:8] = expected[20:24, 30:34] = True
        np.testing.assert_array_equal(speckle_mask(scale * depth, 16, 0.03), expected)
        np.testing.assert_array_equal(speckle_mask(scale * depth, 15, 0.03)[20:24, 30:34], False)
        assert not speckle_mask(scale * depth, 0, 0.03).any()


def test_a_map_without_depth_stays_without() -> None:
    nothing = np.zeros((8, 8), np.float32)
    assert not speckle_mask(nothing, 100, 0.02).any()
    assert not discontinuity_mask(nothing, 3).any()


def test_fusion_counts_what_each_filter_rejects() -> None:
    reference, neighbors = view(0, 0.0), [view(1, 0.05), view(2, -0.05), view(3, 0.1)]
    reference.depth[:, 30:] = 0.0
    for neighbor in neighbors:
        neighbor.depth[:, 30:] = 0.0
    config = FusionConfig(device="cpu", threads=1)
    plain = fuse(
        reference,
        neighbors,
        FusionConfig(device="cpu", threads=1, discontinuity_radius=0, speckle=0),
        NativeFusionBackend(1),
    )
    huge = fuse(reference, neighbors, FusionConfig(device="cpu", threads=1, speckle=10**6), NativeFusionBackend(1))
    default = fuse(reference, neighbors, config, NativeFusionBackend(1))
    assert plain.counts["rejected: discontinuity"] == plain.counts["rejected: speckle"] == 0
    assert huge.counts["kept"] == 0
    assert huge.counts["rejected: speckle"] > 0
    for found in (plain, default):
        rejected = sum(found.counts[f"rejected: {name}"] for name in ("discontinuity", "speckle"))
        sure = (found.unfiltered > 0) & (found.confidence >= config.confidence) & (found.consistent >= 1)
        assert found.counts["kept"] == sure.sum() - rejected
