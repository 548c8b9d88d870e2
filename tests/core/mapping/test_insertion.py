"""Unexplored mask, points, voxel filter and what the new splats look like."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.insertion import (
    InsertionConfig,
    Points,
    outliers,
    points_from_depth,
    rotation_to,
    splats_from_points,
    unexplored_mask,
    unoccupied,
    voxel_filter,
)
from mvsgs_core.rasterizer.reference import rotation_matrices
from mvsgs_core.rasterizer.spherical_harmonics import C0
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def random_points(count: int, seed: int = 0) -> Points:
    random = np.random.default_rng(seed)
    normals = random.normal(size=(count, 3))
    return Points(
        random.uniform(-1, 1, (count, 3)),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        random.uniform(size=(count, 3)),
        random.uniform(0.01, 0.02, count),
    )


def test_the_paper_threshold_of_40_db_is_an_error_of_a_hundredth() -> None:
    observed = np.full((2, 3, 3), 0.5)
    rendered = observed.copy()
    rendered[0, 0] += 0.0099
    rendered[0, 1] += 0.0101
    opacity = np.ones((2, 3))
    opacity[1, 2] = 0.4
    mask = unexplored_mask(rendered, opacity, observed, InsertionConfig(unexplored_psnr=40.0))
    assert mask.tolist() == [[False, True, False], [False, False, True]]


def test_voxel_filter_keeps_the_mean_and_the_surface() -> None:
    points = random_points(5000)
    filtered = voxel_filter(points, 0.25)
    cells = {tuple(c) for c in np.floor((points.positions - points.positions.min(axis=0)) / 0.25).astype(int)}
    assert len(filtered) == len(cells)
    np.testing.assert_allclose(np.sum(filtered.spacing**2), np.sum(points.spacing**2))
    again = voxel_filter(filtered, 1e-4)
    assert len(again) == len(filtered)


def test_voxel_filter_averages_the_points_of_a_cell() -> None:
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    points = Points(
        np.array([[0.0, 0, 0], [0.2, 0, 0], [1.5, 0, 0]]), normals, np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]),
        np.array([3.0, 4.0, 1.0]),
    )  # fmt: skip
    filtered = voxel_filter(points, 1.0)
    np.testing.assert_allclose(filtered.positions, [[0.1, 0, 0], [1.5, 0, 0]])
    np.testing.assert_allclose(filtered.colors, [[0.5, 0.5, 0], [0, 0, 1]])
    np.testing.assert_allclose(filtered.spacing, [5.0, 1.0])
    np.testing.assert_allclose(filtered.normals, [[0, 0, 0], [0, 1, 0]])  # opposite normals say nothing


def test_voxels_too_small_for_the_extent_are_refused() -> None:
    with pytest.raises(ValueError, match="enlarge voxel"):
        voxel_filter(random_points(10), 1e-8)


def test_empty_points_make_no_splats() -> None:
    view = rgbd_keyframe(0, np.eye(4))
    nothing = np.zeros(view.depth.shape, dtype=bool)
    points = points_from_depth(view.depth, view.intrinsics, view.image / 255.0, view.normals, nothing)
    assert len(voxel_filter(points, 0.1)) == 0
    assert len(splats_from_points(points, np.eye(4), 1, "gaussian", InsertionConfig())) == 0


def test_splats_lie_on_the_surface_and_are_flat_along_its_normal() -> None:
    view = rgbd_keyframe(0, pose_on_arc(0.3))
    points = points_from_depth(
        view.depth, view.intrinsics, view.image / 255.0, view.normals, np.ones(view.depth.shape, dtype=bool)
    )
    config = InsertionConfig(flatten=0.2)
    splats = splats_from_points(points, view.world_from_cam, 4, "exact", config)
    splats.check()
    world = points.positions @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3]
    np.testing.assert_allclose(splats.means.numpy(), world, atol=1e-5)
    deviations = splats.log_scales.exp()
    torch.testing.assert_close(deviations[:, 2], 0.2 * deviations[:, 0])
    thin = rotation_matrices(splats.quaternions)[:, :, 2].numpy()
    normals = view.normals.reshape(-1, 3) @ view.world_from_cam[:3, :3].T
    np.testing.assert_allclose(np.abs(np.sum(thin * normals, axis=1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(0.5 + C0 * splats.sh[:, 0].numpy(), view.image.reshape(-1, 3) / 255.0, atol=1e-6)
    assert (splats.betas == 2.0).all()
    assert not splats.sh[:, 1:].any()


def test_a_slanted_surface_gets_wider_splats() -> None:
    depth, intrinsics = np.full((1, 2), 2.0), np.array([100.0, 100.0, 0.5, 0.0])
    facing, slanted = [0.0, 0.0, -1.0], [np.sqrt(0.75), 0.0, -0.5]
    points = points_from_depth(
        depth, intrinsics, np.zeros((1, 2, 3)), np.array([[facing, slanted]]), np.ones((1, 2), dtype=bool)
    )
    np.testing.assert_allclose(points.spacing[0], 0.02, rtol=1e-4)
    np.testing.assert_allclose(points.spacing[1], 0.02 * np.sqrt(2), rtol=2e-2)


def test_rotation_to_every_direction_even_straight_back() -> None:
    normals = np.vstack([random_points(100).normals, [[0, 0, 1.0], [0, 0, -1.0]]])
    turned = rotation_matrices(torch.from_numpy(rotation_to(normals)))[:, :, 2].numpy()
    np.testing.assert_allclose(turned, normals, atol=1e-9)


def test_a_voxel_that_holds_a_splat_needs_no_second() -> None:
    random = np.random.default_rng(1)
    positions, means = random.uniform(-1, 1, (300, 3)), random.uniform(-3, 3, (2000, 3))
    edge, low = 0.3, positions.min(axis=0)
    taken = {tuple(c) for c in np.floor((means - low) / edge).astype(int)}
    expected = [tuple(c) not in taken for c in np.floor((positions - low) / edge).astype(int)]
    assert unoccupied(positions, means, edge).tolist() == expected
    assert 0 < sum(expected) < len(expected)
    assert unoccupied(positions, means[:0], edge).all()
    assert unoccupied(positions[:0], means, edge).shape == (0,)


def test_outliers_are_told_from_what_the_whole_view_suffers_from() -> None:
    observed = np.full((4, 10, 3), 0.5)
    opacity = np.ones((4, 10))
    opacity[3] = 0.0
    noisy, clean = observed + 0.1, observed + 0.01
    for rendered in (noisy, clean):
        rendered[3] += 0.3  # not mapped: does not count in the median
        rendered[0, 0] = observed[0, 0] + 0.2
    config = InsertionConfig(map_voxel_error=3.0)
    assert not outliers(noisy, opacity, observed, config)[:3].any()
    assert np.argwhere(outliers(clean, opacity, observed, config)[:3]).tolist() == [[0, 0]]
    assert outliers(noisy, np.zeros((4, 10)), observed, config).all()
