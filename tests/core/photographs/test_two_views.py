"""Two photographs: verification, planes, relative pose, focal length."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.photographs.focal import BY_HOMOGRAPHY, MIN_PAIRS, focal_factor
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.two_views import MIN_MATCHES, midpoints, relative_poses, verify
from tests.support.photograph_ring import FOCAL, Ring, ring


def test_wrong_matches_are_left_out() -> None:
    for views in ring(3).pairs(wrong=0.3).values():
        right = views.matches[:, 0] == views.matches[:, 1]
        assert right.mean() > 0.97
        assert right.sum() > 200
        assert views.by_homography < BY_HOMOGRAPHY


def test_a_plane_is_told() -> None:
    assert min(views.by_homography for views in ring(3, flat=True).pairs().values()) > 0.95


def test_photographs_of_different_things_are_no_pair() -> None:
    here, there = (np.random.default_rng(n).uniform(0, 600, (300, 2)) for n in (0, 1))
    both = np.stack([np.arange(300)] * 2, axis=1)
    found = verify(here, there, both)
    assert found is None or len(found.matches) < 0.2 * 300
    assert verify(here, here, both[: MIN_MATCHES - 1]) is None


def relative_errors(of: Ring, i: int, j: int, planar: bool) -> list[tuple[float, float]]:
    """Degrees of rotation and of the direction of translation, of each pose, the best first."""
    seen = np.isfinite(of.pixels[[i, j], :, 0]).all(axis=0)
    count = int(seen.sum())
    rays = [of.lens.unproject(np.full(count, n), of.pixels[n, seen]) for n in (i, j)]
    true = of.cam_from_world[j] @ geometry.inverse(of.cam_from_world[i])
    direction = true[:3, 3] / np.linalg.norm(true[:3, 3])
    errors = []
    for found in relative_poses(rays[0], rays[1], FOCAL, planar):
        turned = np.linalg.norm(geometry.so3_log(found.second_from_first[:3, :3] @ true[:3, :3].T))
        off = np.arccos(np.clip(found.second_from_first[:3, 3] @ direction, -1.0, 1.0))
        errors.append((float(np.degrees(turned)), float(np.degrees(off))))
    return sorted(errors)


def test_the_relative_pose_is_found() -> None:
    ((turned, off),) = relative_errors(ring(4), 1, 2, planar=False)
    assert turned < 0.5
    assert off < 3.0


def test_of_a_plane_it_is_one_of_two() -> None:
    for depths in (0.05, 0.4):
        (turned, off), *other = relative_errors(ring(4, flat=True, depths=depths), 0, 3, planar=True)
        assert turned < 1.0
        assert off < 4.0
        assert len(other) <= 1


def test_midpoints_are_the_points_and_none_is_behind() -> None:
    of = ring(2, noise=0.0)
    seen = np.isfinite(of.pixels[..., 0]).all(axis=0)
    rays = [of.lens.unproject(np.full(int(seen.sum()), n), of.pixels[n, seen]) for n in (0, 1)]
    there_from_here = of.cam_from_world[1] @ geometry.inverse(of.cam_from_world[0])
    points, angle = midpoints(*rays, there_from_here)
    true = of.world[seen] @ of.cam_from_world[0, :3, :3].T + of.cam_from_world[0, :3, 3]
    np.testing.assert_allclose(points, true, atol=1e-6)
    assert np.degrees(np.median(angle)) > 8.0
    behind, _ = midpoints(-rays[0], rays[1], there_from_here)
    assert np.isnan(behind).any()


def test_lens_and_back() -> None:
    lens = SharedLens(np.array([[500.0, 510.0, 320.0, 240.0]]), 1.1, -0.1, 0.03)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (100, 2))
    one = np.zeros(100, np.int64)
    pixels = lens.project(one, np.concatenate([2.0 * points, np.full((100, 1), 2.0)], axis=1))
    np.testing.assert_allclose(lens.unproject(one, pixels), points, atol=1e-8)
    assert lens.focal(0) == 1.1 * 505.0


def factor_of(of: Ring, guess: float) -> float | None:
    intrinsics = of.lens.intrinsics[0] * [guess, guess, 1.0, 1.0]
    pairs = [views for views in of.pairs().values() if views.by_homography < BY_HOMOGRAPHY]
    weights = [float(len(views.matches)) for views in pairs]
    return focal_factor([views.fundamental for views in pairs], [(intrinsics, intrinsics)] * len(pairs), weights)


def test_pairs_vote_for_the_focal_length() -> None:
    for guess in (0.7, 1.0, 1.6):
        found = factor_of(ring(8, noise=0.2), guess)
        assert found is not None
        assert abs(found * guess - 1.0) < 0.06


def test_few_pairs_or_planes_tell_no_focal_length() -> None:
    assert factor_of(ring(3), 1.0) is None
    assert factor_of(ring(8, flat=True), 1.0) is None
    assert MIN_PAIRS > 3
