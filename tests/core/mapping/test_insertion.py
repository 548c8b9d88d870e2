"""Points of pixels and of rectangles, and what the new splats look like."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.mapping.insertion import (
    MIN_COSINE,
    InsertionConfig,
    ellipses,
    points_from_depth,
    points_of_rectangles,
    rotation_to,
    splats_from_points,
)
from mvsgs_core.mapping.partition import Partition
from mvsgs_core.rasterizer.reference import rotation_matrices
from mvsgs_core.rasterizer.spherical_harmonics import C0
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def unit_vectors(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_empty_points_make_no_splats() -> None:
    view = rgbd_keyframe(0, np.eye(4))
    nothing = np.zeros(view.depth.shape, dtype=bool)
    points = points_from_depth(view.depth, view.intrinsics, view.image / 255.0, view.normals, nothing)
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
    tangents = np.linalg.norm(points.tangents, axis=2).min(axis=1)
    np.testing.assert_allclose(deviations[:, 2].numpy(), 0.2 * config.initial_scale * tangents, rtol=1e-5)
    thin = rotation_matrices(splats.quaternions)[:, :, 2].numpy()
    normals = view.normals.reshape(-1, 3) @ view.world_from_cam[:3, :3].T
    np.testing.assert_allclose(np.abs(np.sum(thin * normals, axis=1)), 1.0, atol=1e-5)
    np.testing.assert_allclose(0.5 + C0 * splats.sh[:, 0].numpy(), view.image.reshape(-1, 3) / 255.0, atol=1e-6)
    assert (splats.betas == 2.0).all()
    assert not splats.sh[:, 1:].any()


def test_tangents_span_what_a_pixel_sees_of_a_slanted_surface() -> None:
    """The ends of a pixel's sides, cast onto the plane of its normal."""
    intrinsics = np.array([100.0, 120.0, 30.0, 20.0])
    normals = unit_vectors(40 * 60).reshape(40, 60, 3)
    depth = np.full((40, 60), 2.0)
    rays = camera.unproject(np.ones((40, 60)), intrinsics)
    normals = np.where(np.sum(normals * rays, axis=-1, keepdims=True) < 0, normals, -normals)
    slant = -np.sum(normals * rays, axis=-1) / np.linalg.norm(rays, axis=-1)
    mask = slant > MIN_COSINE
    points = points_from_depth(depth, intrinsics, np.zeros((40, 60, 3)), normals, mask)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", points.tangents, points.normals), 0.0, atol=1e-12)
    moved = camera.project(points.positions[:, None] + 1e-4 * points.tangents, intrinsics)
    start = camera.project(points.positions, intrinsics)[:, None]
    np.testing.assert_allclose((moved - start) / 1e-4, np.broadcast_to(np.eye(2), moved.shape), atol=5e-3)
    nearly = points_from_depth(depth, intrinsics, np.zeros((40, 60, 3)), normals, ~mask)
    assert np.linalg.norm(nearly.tangents, axis=2).max() < 2.0 / 100 * (1 + 1 / MIN_COSINE)


def test_an_ellipse_is_that_of_its_tangents() -> None:
    random = np.random.default_rng(3)
    tangents = random.normal(size=(200, 2, 3)) * np.exp(random.normal(size=(200, 1, 1)))
    axes, quaternions = ellipses(tangents)
    turn = rotation_matrices(torch.from_numpy(quaternions))[:, :, :2].numpy()
    covariance = np.einsum("nij,nj,nkj->nik", turn, axes**2, turn)
    np.testing.assert_allclose(covariance, np.einsum("nij,nik->njk", tangents, tangents), rtol=1e-9, atol=1e-9)
    assert (axes[:, 0] >= axes[:, 1]).all()
    parallel = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]])
    assert all(np.isfinite(value).all() for value in ellipses(parallel))


def test_a_rectangle_is_one_point_that_stands_for_all_of_it() -> None:
    view = rgbd_keyframe(0, pose_on_arc(0.3), (8, 8))
    labels = np.full((8, 8), -1)
    labels[:4], labels[4:, :2] = 0, 1
    labels[7, 1] = -1  # one of its eight pixels is shown already
    parts = Partition(labels, np.array([[4, 8], [4, 2]]))
    known, sure = np.ones((8, 8), dtype=bool), np.ones((8, 8), np.float32)
    depth, colors = np.full((8, 8), 3.0), view.image / 255.0
    points = points_of_rectangles(parts, depth, known, sure, view.intrinsics, colors, None)
    pixels = camera.unproject(depth, view.intrinsics)
    for number in range(2):
        np.testing.assert_allclose(points.positions[number], pixels[labels == number].mean(axis=0))
        np.testing.assert_allclose(points.colors[number], colors[labels == number].mean(axis=0))
    side = 3.0 / view.intrinsics[0]
    lengths = np.linalg.norm(points.tangents, axis=2)
    np.testing.assert_allclose(lengths[0], [8 * side, 4 * side])
    np.testing.assert_allclose(lengths[1], np.array([2 * side, 4 * side]) * np.sqrt(7 / 8))


def test_known_depth_counts_beside_doubtful_and_the_surest_of_doubtful_alone() -> None:
    labels = np.array([[0, 0, 0, 0], [1, 1, 1, 1]])
    parts = Partition(labels, np.array([[1, 4], [1, 4]]))
    depth = np.array([[2.0, 2.0, 9.0, 9.0], [3.0, 5.0, 7.0, 4.0]])
    known = np.array([[True, True, False, False], [False] * 4])
    confidence = np.array([[0.1, 0.1, 0.9, 0.9], [0.2, 0.6, 0.3, 0.4]], np.float32)
    intrinsics = np.array([10.0, 10.0, 1.5, 0.5])
    points = points_of_rectangles(parts, depth, known, confidence, intrinsics, np.zeros((2, 4, 3)), None)
    np.testing.assert_allclose(points.positions[:, 2], [2.0, 5.0], atol=0.01)


def test_rotation_to_every_direction_even_straight_back() -> None:
    normals = np.vstack([unit_vectors(100), [[0, 0, 1.0], [0, 0, -1.0]]])
    turned = rotation_matrices(torch.from_numpy(rotation_to(normals)))[:, :, 2].numpy()
    np.testing.assert_allclose(turned, normals, atol=1e-9)
