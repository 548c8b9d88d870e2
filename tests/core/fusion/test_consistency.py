"""Geometric consistency, splatting and fusion: brute force, twins, and what they must reject."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import camera, geometry
from mvsgs_core.fusion.backend import NativeFusionBackend
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig, OnlineFusion, fuse, nearest_views
from mvsgs_core.fusion.interface import FuseOptions
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth, depth_maps
from mvsgs_core.fusion.normals import normals_of
from mvsgs_core.fusion.torch_backend import TorchFusionBackend
from mvsgs_core.keyframe_window import Correction
from mvsgs_core.mvs.cascade import DOUBTFUL
from mvsgs_core.warp import apply_warp, relative_warp
from tests.support.depth_views import SIZE, view
from tests.support.plane_scene import intrinsics_of, look, true_depth

FINE = (160, 224)  # where parallax is enough for a depth to be sure
CONFIG = FusionConfig(device="cpu", threads=1, relative=0.01, confidence=0.77)


def brute_force(reference: KeyframeDepth, neighbor: KeyframeDepth, relative: float) -> np.ndarray:
    """The paper's check, pixel by pixel, in float64 with 4x4 poses."""
    agree = np.zeros(SIZE, dtype=bool)
    k, k_inv = camera.matrix(reference.intrinsics), np.linalg.inv(camera.matrix(reference.intrinsics))
    there = geometry.inverse(neighbor.world_from_cam) @ reference.world_from_cam
    for v in range(SIZE[0]):
        for u in range(SIZE[1]):
            z = float(reference.depth[v, u])
            if z <= 0:
                continue
            point = there[:3, :3] @ (k_inv @ np.array([u, v, 1.0]) * z) + there[:3, 3]
            if point[2] <= 0:
                continue
            x, y, _ = k @ point / point[2]
            ix, iy = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
            if not (0 <= ix < SIZE[1] and 0 <= iy < SIZE[0]) or neighbor.depth[iy, ix] <= 0:
                continue
            found = float(neighbor.depth[iy, ix])
            agree[v, u] = abs(found - point[2]) < relative * max(found, point[2])
    return agree


def test_consistency_equals_brute_force() -> None:
    reference, neighbors = view(0, 0.0, 0.01), [view(1, 0.2, 0.01, 0.05), view(2, -0.3, 0.01)]
    reference.depth[5:9, 5:9] = 0
    maps = depth_maps(reference, neighbors)
    expected = sum(brute_force(reference, n, 0.02).astype(int) for n in neighbors)
    for backend in (NativeFusionBackend(1), TorchFusionBackend("cpu")):
        found = backend.consistent_views(maps, np.full(SIZE, 0.02, np.float32))
        assert np.mean(found != expected) < 0.003  # rounding at half a pixel
    assert 0.2 < np.mean(np.asarray(expected) > 0) < 1.0


def test_parallax_is_what_a_change_of_depth_moves_in_the_neighbors() -> None:
    reference, neighbors = view(0, 0.0, 0.01), [view(1, 0.6, 0.0, 0.05), view(2, 0.9)]
    reference.depth[5:9, 5:9] = 0
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    inverse = 1.0 / np.where(reference.depth > 0, reference.depth, 1.0).astype(np.float64)
    squares = np.zeros(SIZE)
    for n in neighbors:
        warp = relative_warp(reference.intrinsics, reference.world_from_cam, n.intrinsics, n.world_from_cam)
        x, y, z = apply_warp(warp, u, v, inverse)
        ahead, behind = (np.stack(apply_warp(warp, u, v, f * inverse)[:2]) for f in (1 + 1e-5, 1 - 1e-5))
        inside = (z > 0) & (x > -0.5) & (y > -0.5) & (x < SIZE[1] - 0.5) & (y < SIZE[0] - 0.5)
        squares += np.where(inside, ((ahead - behind) ** 2).sum(axis=0) / 2e-5**2, 0.0)
    expected = np.where(reference.depth > 0, np.sqrt(squares), 0.0)
    assert 1.0 < np.median(expected) < 30.0
    assert (expected[reference.depth > 0] == 0).any()  # what no neighbor sees
    for backend in (NativeFusionBackend(1), TorchFusionBackend("cpu")):
        found = backend.parallax(depth_maps(reference, neighbors))
        assert found.dtype == np.float32
        wrong = np.abs(found - expected) > 1e-3 * (1 + expected)
        assert wrong.mean() < 0.003  # rounding at half a pixel


def test_fusion_of_both_backends_agrees() -> None:
    reference, neighbors = view(0, 0.0, 0.03), [view(1, 0.2, 0.01), view(2, -0.3, 0.01), view(3, 0.1, 0.01)]
    maps, options = depth_maps(reference, neighbors), FuseOptions(1.0, 0.4)
    native, twin = NativeFusionBackend(1), TorchFusionBackend("cpu")
    splats = [b.splat(maps, options) for b in (native, twin)]
    assert np.mean(np.abs(splats[0] - splats[1]) > 1e-3) < 0.003
    sigma = np.random.default_rng(0).uniform(0.005, 0.05, SIZE).astype(np.float32)
    results = [b.fuse(maps, splats[0], sigma, replace(options, min_neighbor_confidence=0.1)) for b in (native, twin)]
    for name in ("depth", "support", "violation", "own"):
        difference = np.abs(getattr(results[0], name) - getattr(results[1], name))
        assert np.mean(difference > 1e-3) < 0.005, name


def test_noise_that_parallax_cannot_tell_apart_supports_and_agrees() -> None:
    """Depths 3 % off, at a baseline where that is a fraction of a pixel; the same at a wide one is a disagreement."""
    truth = true_depth(look(0.0), SIZE)
    narrow = replace(CONFIG, sigma_most=CONFIG.sigma)

    def fused(step: float, config: FusionConfig) -> FusedDepth:
        neighbors = [view(k, step * x, 0.03) for k, x in enumerate((1, -1, 2), 1)]
        return fuse(view(0, 0.0, 0.03), neighbors, config, NativeFusionBackend(1))

    def error(found: FusedDepth) -> float:
        return float(np.abs(np.log(found.unfiltered[8:24, 8:48] / truth[8:24, 8:48])).mean())

    near, fixed = fused(0.02, CONFIG), fused(0.02, narrow)
    assert error(near) < 0.8 * error(fixed)
    assert near.consistent.mean() > 1.5 * fixed.consistent.mean()
    assert fused(1.0, CONFIG).consistent[8:24, 16:40].mean() < 0.7 * near.consistent[8:24, 16:40].mean()


def test_a_width_above_the_most_is_a_fixed_one() -> None:
    views = [view(k, 0.02 * x, 0.03) for k, x in enumerate((0, 1, -1, 2))]
    backend = NativeFusionBackend(1)
    fixed, other = (fuse(views[0], views[1:], replace(CONFIG, sigma=0.3, sigma_most=m), backend) for m in (0.01, 0.3))
    np.testing.assert_array_equal(fixed.unfiltered, other.unfiltered)
    assert (fixed.unfiltered > 0).any()


def test_fusion_replaces_an_outlier_and_fills_a_hole() -> None:
    reference = view(0, 0.0)
    reference.depth[10:14, 10:14] *= 0.6
    reference.depth[20:24, 10:14] = 0
    truth = true_depth(look(0.0), SIZE)
    result = fuse(reference, [view(1, 0.05), view(2, -0.05), view(3, 0.1)], CONFIG, NativeFusionBackend(1))
    for rows in (slice(10, 14), slice(20, 24)):
        np.testing.assert_allclose(result.unfiltered[rows, 10:14], truth[rows, 10:14], rtol=0.02)


def test_a_point_that_others_see_through_is_rejected() -> None:
    """Something floats in front of the wall in one map only: free-space violation."""
    reference = view(0, 0.0)
    reference.depth[4:10, 4:10] = 1.0
    result = fuse(reference, [view(1, 0.05), view(2, -0.05), view(3, 0.1)], CONFIG, NativeFusionBackend(1))
    kept = result.depth[4:10, 4:10]
    truth = true_depth(look(0.0), SIZE)[4:10, 4:10]
    assert np.all((kept == 0) | (np.abs(kept - truth) < 0.02 * truth))


def _fine(index: int, x: float) -> KeyframeDepth:
    return view(index, x, size=FINE)


def test_the_wrong_pose_of_one_neighbor_does_not_get_through() -> None:
    reference, good = _fine(0, 0.0), [_fine(1, 0.3), _fine(2, -0.3), _fine(3, 0.5)]
    wrong = _fine(4, 0.3)
    shifted = KeyframeDepth(4, wrong.depth, wrong.confidence, wrong.intrinsics, look(0.5, 0.1), 1.0)
    result = fuse(reference, [*good, shifted], CONFIG, NativeFusionBackend(1))
    truth = true_depth(look(0.0), FINE)
    kept = result.depth > 0
    assert kept.mean() > 0.7
    assert np.mean(np.abs(result.depth - truth)[kept] > 0.05 * truth[kept]) < 0.02


def test_few_agreeing_neighbors_count_against_a_depth_only_where_others_see_another() -> None:
    """One neighbor agrees and nobody else looks; or one agrees and three see another depth there."""
    reference, agreeing = _fine(0, 0.0), _fine(1, 0.3)
    others = [_fine(2, -0.3), _fine(3, 0.5), _fine(4, -0.5)]
    for other in others:
        other.depth[:, :112] = 0.0
        other.depth[:, 112:] *= 0.8
    found = fuse(reference, [agreeing, *others], CONFIG, NativeFusionBackend(1))
    truth = true_depth(look(0.0), FINE)
    right = np.abs(found.unfiltered - truth) < 0.02 * truth
    unseen, contested = found.confidence[32:128, 32:88], found.confidence[32:128, 136:192][right[32:128, 136:192]]
    assert np.median(unseen) > np.median(contested) + 0.1
    assert (found.depth[32:128, 32:88] > 0).mean() > 0.6


def _coarse(index: int, x: float, wrong: float = 1.0) -> KeyframeDepth:
    """The tracker's depth in the place of stereo's."""
    found = _fine(index, x)
    return replace(found, depth=found.depth * np.float32(wrong), confidence=found.confidence * np.float32(DOUBTFUL))


def test_doubtful_maps_do_not_contradict_one_that_is_sure() -> None:
    reference, good = _fine(0, 0.0), [_fine(1, 0.3), _fine(2, -0.3)]
    wrong = [_coarse(k, x, 1.2) for k, x in enumerate((0.4, -0.4, 0.5, -0.5), 3)]
    alone = fuse(reference, good, CONFIG, NativeFusionBackend(1))
    among = fuse(reference, [*wrong[:2], *good, *wrong[2:]], CONFIG, NativeFusionBackend(1))
    assert np.median(among.confidence) > np.median(alone.confidence) - 0.02
    assert (among.depth > 0).sum() > 0.98 * (alone.depth > 0).sum() > 0.5 * reference.depth.size
    doubted = fuse(reference, wrong, CONFIG, NativeFusionBackend(1))
    assert not doubted.consistent.any()
    assert not doubted.depth.any()


def test_a_doubtful_map_may_be_the_one_that_agrees() -> None:
    reference, coarse = _fine(0, 0.0), _coarse(1, 0.3, 1.005)
    found = fuse(reference, [coarse], CONFIG, NativeFusionBackend(1))
    assert found.consistent[32:128, 80:192].mean() > 0.9
    np.testing.assert_allclose(found.unfiltered, reference.depth, rtol=1e-6)  # of its depth nothing is taken


def test_doubtful_maps_are_the_last_neighbors() -> None:
    reference, good = _fine(0, 0.0), _fine(1, 0.6)
    coarse = [_coarse(k, x) for k, x in enumerate((0.3, -0.3, 0.1, -0.1), 2)]
    chosen = nearest_views(reference, [*coarse[:2], good, *coarse[2:]], 2, CONFIG.min_neighbor_confidence)
    assert chosen[0] is good
    assert chosen[1] in coarse
    assert good not in nearest_views(reference, [*coarse, good], 2, 0.0)  # the others see more of the reference


@pytest.mark.parametrize("wrong", ["depth", "confidence"])
def test_a_pixel_that_is_not_a_number_takes_no_part(wrong: str) -> None:
    reference, neighbors = view(0, 0.0, 0.01), [view(1, 0.2, 0.01), view(2, -0.3, 0.01)]
    getattr(neighbors[0], wrong)[12:16, 20:24] = np.nan
    maps, options = depth_maps(reference, neighbors), FuseOptions(1.0, 0.1)
    sigma = np.full(SIZE, 0.02, np.float32)
    for backend in (NativeFusionBackend(1), TorchFusionBackend("cpu")):
        splatted = backend.splat(maps, options)
        neighbors[0].depth[12:16, 20:24] = 0.0
        np.testing.assert_array_equal(splatted, backend.splat(depth_maps(reference, neighbors), options))
        fused = backend.fuse(maps, splatted, sigma, options)
        assert all(np.isfinite(values).all() for values in vars(fused).values())


def test_fewer_neighbors_than_asked_for_is_said() -> None:
    fusion = OnlineFusion(CONFIG)
    assert list(fusion.add(view(0, 0.0))) == []
    (alone,) = fusion.flush()
    assert "no neighbor" in alone.problem
    assert not (alone.depth > 0).any()


def test_scale_corrections_scale_stored_depth() -> None:
    fusion = OnlineFusion(CONFIG)
    for i in range(2):
        list(fusion.add(view(i, 0.1 * i)))
    doubled = {i: Correction(look(0.2 * i), 2.0) for i in range(2)}
    fusion.move(doubled)
    fusion.move(doubled)  # absolute: a second time changes nothing
    for found in fusion.flush():
        np.testing.assert_allclose(found.view.depth, 2.0 * true_depth(look(0.1 * found.view.index), SIZE), rtol=1e-5)


def test_normals_of_a_plane_are_exact() -> None:
    intrinsics = intrinsics_of(SIZE)
    normal = np.array([0.3, -0.5, -0.8])
    normal /= np.linalg.norm(normal)
    u, v = camera.pixel_grid(*SIZE)
    rays = np.stack([(u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], np.ones(SIZE)], axis=-1)
    depth = (-2.0 / (rays @ normal)).astype(np.float32)
    assert depth.min() > 0
    depth[:4] = 0
    found = normals_of(depth, intrinsics)
    assert np.all(found[:4] == 0)
    np.testing.assert_allclose(found[4:], np.broadcast_to(normal, found[4:].shape), atol=2e-3)


def test_normals_do_not_bend_at_a_jump() -> None:
    depth = np.full(SIZE, 2.0, np.float32)
    depth[:, 28:] = 4.0
    np.testing.assert_allclose(
        normals_of(depth, intrinsics_of(SIZE)), np.broadcast_to([0.0, 0.0, -1.0], (*SIZE, 3)), atol=1e-4
    )
