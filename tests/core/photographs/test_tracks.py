"""Tracks, and their points."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from mvsgs_core.photographs.tracks import link
from mvsgs_core.photographs.triangulation import triangulate
from tests.support.photograph_ring import ring


def test_matches_become_tracks() -> None:
    points = [np.arange(8.0).reshape(4, 2) + 10 * n for n in range(4)]
    tracks = link(points, {(0, 1): np.array([[0, 1], [2, 2]]), (1, 2): np.array([[1, 3]]), (2, 3): np.array([[3, 0]])})
    assert tracks.count == 2
    long = tracks.track == tracks.track[(tracks.photograph == 3)][0]
    assert tracks.photograph[long].tolist() == [0, 1, 2, 3]
    assert tracks.feature[long].tolist() == [0, 1, 3, 0]
    np.testing.assert_array_equal(tracks.pixels[long], [points[0][0], points[1][1], points[2][3], points[3][0]])
    assert np.all(np.diff(tracks.track) >= 0)
    assert tracks.of_features(1, 4).tolist() == [-1, int(tracks.track[long][0]), int(tracks.track[~long][0]), -1]


def test_two_features_of_one_photograph_are_not_one_point() -> None:
    points = [np.zeros((3, 2))] * 3
    matches = {(0, 1): np.array([[0, 0]]), (1, 2): np.array([[0, 0]]), (0, 2): np.array([[1, 0]])}
    tracks = link(points, matches)
    assert tracks.count == 1
    assert tracks.photograph.tolist() == [1, 2]


def test_nothing_gives_no_track() -> None:
    tracks = link([np.zeros((3, 2))] * 2, {})
    assert tracks.count == 0
    assert tracks.pixels.shape == (0, 2)


def test_a_long_chain_is_one_track() -> None:
    count = 50
    order = np.random.default_rng(0).permutation(count)
    matches = {(int(min(a, b)), int(max(a, b))): np.array([[0, 0]]) for a, b in pairwise(order)}
    tracks = link([np.zeros((1, 2))] * count, matches)
    assert tracks.count == 1
    assert len(tracks.track) == count


def test_points_are_where_most_observations_say() -> None:
    of = ring(6, 100, noise=0.2)
    track, photograph = np.nonzero(np.isfinite(of.pixels[..., 0]).T)
    pixels = of.pixels[photograph, track].copy()
    wrong = (track % 5 == 0) & (photograph == 2)
    pixels[wrong] += 60.0
    points, names = triangulate(of.cam_from_world, of.lens, photograph, track, pixels, 4.0, np.radians(1.5))
    seen = np.bincount(track, minlength=100)
    assert set(np.flatnonzero(seen >= 4)) <= set(names.tolist())
    error = np.linalg.norm(points - of.world[names], axis=1)
    assert np.median(error) < 0.01
    assert error[seen[names] >= 5].max() < 0.05


def test_rays_that_are_nearly_parallel_give_no_point() -> None:
    of = ring(3, 50, noise=0.0)
    track, photograph = np.nonzero(np.isfinite(of.pixels[..., 0]).T)
    pixels = of.pixels[photograph, track]
    for angle, found in ((1.5, 50), (60.0, 0)):
        points, _ = triangulate(of.cam_from_world, of.lens, photograph, track, pixels, 4.0, np.radians(angle))
        assert len(points) == found
    empty = np.zeros(0, np.int64)
    assert len(triangulate(of.cam_from_world, of.lens, empty, empty, np.zeros((0, 2)), 4.0, 0.0)[0]) == 0
