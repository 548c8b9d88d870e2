"""The surface of a pixel at a depth edge."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.depth_edges import (
    DepthEdgeConfig,
    continued_surfaces,
    differing_tiles,
    equalized,
    refine_depth_edges,
)
from mvsgs_core.mvs.hypotheses import SearchRange
from mvsgs_core.mvs.interface import TILE, MatchingImages
from mvsgs_core.mvs.keyframe import prepare_keyframe
from mvsgs_core.mvs.stereo import StereoConfig, estimate_depth
from tests.support.plane_scene import look, render, true_depth

SIZE = (96, 128)


def test_a_plane_continues_itself_and_both_sides_of_a_jump_are_candidates() -> None:
    v, u = np.mgrid[0:40, 0:60]
    plane = (0.2 + 0.002 * u + 0.001 * v).astype(np.float32)
    middle = continued_surfaces(plane, (3, 6))[:, 8:-8, 8:-8]
    assert middle.shape[0] == 17
    assert np.abs(middle - plane[8:-8, 8:-8]).max() < 1e-6
    step = np.where(u < 30, plane, plane + 0.5).astype(np.float32)
    around = continued_surfaces(step, (3,))[:, 20, 29:31]
    for side in (plane[20, 29:31], plane[20, 29:31] + 0.5):
        assert np.all(np.abs(around - side).min(axis=0) < 1e-4)
    tiles = differing_tiles(continued_surfaces(step, (3,)), 0.1)
    assert tiles.shape == (5, 9, 4)
    assert set(np.flatnonzero(tiles.any(axis=(0, 1)))) == {26 // TILE[1], 33 // TILE[1]}


def test_the_level_of_another_exposure_is_taken_out_where_the_neighbor_sees_the_surface() -> None:
    rng = np.random.default_rng(1)
    reference = cv2.GaussianBlur(rng.normal(0, 60, SIZE).astype(np.float32), (9, 9), 2)
    shift = 6.0 * 0.25  # pixels: a baseline along x, and an inverse depth
    warp = np.concatenate([np.eye(3).ravel(), [6.0, 0.0, 0.0]])[None].astype(np.float32)
    there = cv2.warpAffine(reference, np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]]), SIZE[::-1])
    there[:20] = 200.0  # something else stands in front of a fifth of it
    brighter = MatchingImages(reference, (there + 17.0)[None], warp)
    level = equalized(brighter, np.full(SIZE, 0.25, np.float32))
    np.testing.assert_allclose(level.neighbors[0], there, atol=0.5)
    unseen = equalized(MatchingImages(reference, there[None], warp), np.zeros(SIZE, np.float32))
    np.testing.assert_array_equal(unseen.neighbors[0], there)


def test_edges_of_a_box_come_out_sharper() -> None:
    poses = [look(x) for x in (0.0, -0.3, -0.15, 0.15, 0.3)]
    views = []
    for k, pose in enumerate(poses):
        image, intrinsics = render(pose, SIZE)
        views.append(prepare_keyframe(k, image, intrinsics, pose, area=SIZE[0] * SIZE[1], scales=(1, 2)))
    truth = true_depth(poses[0], SIZE)
    edge = cv2.dilate(truth, np.ones((9, 9))) > 1.2 * cv2.erode(truth, np.ones((9, 9)))
    right = {}
    for name, config in (("with", StereoConfig()), ("without", replace(StereoConfig(), depth_edges=None))):
        found = estimate_depth(views[0], views[1:], SearchRange(0.12, 0.8, "given"), config, NativeBackend(1))
        right[name] = np.mean(np.abs(found.depth - truth)[edge] < 0.05 * truth[edge])
    assert right["with"] > right["without"] + 0.02


def test_each_round_frees_more_of_what_a_window_covered() -> None:
    """A chair's back: slats before a wall with gaps of sixteen pixels, into which they grew by six from both sides."""
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    noise = np.random.default_rng(2)
    near, far = (cv2.GaussianBlur(noise.normal(0, 80, (SIZE[0], 400)).astype(np.float32), (0, 0), 1.2) for _ in "nf")
    slats = (0.8, 0.4)  # inverse depths of a slat and the wall
    focal = 100.0

    def seen(x: float) -> np.ndarray:
        """A camera at x: what stands at column u of the one at 0 appears at u - focal * x * inverse depth."""
        wall = u + focal * x * slats[1] + 100
        slat = u + focal * x * slats[0]
        there = slat % 24 < 8
        rows = v.astype(np.float32)
        behind = cv2.remap(far, wall.astype(np.float32), rows, cv2.INTER_LINEAR)
        return np.where(there, cv2.remap(near, (slat + 100).astype(np.float32), rows, cv2.INTER_LINEAR), behind)

    places = (-0.1, -0.05, 0.05, 0.1)
    truth = np.where(u % 24 < 8, *slats).astype(np.float32)
    closed = np.where((u + 6) % 24 < 20, *slats).astype(np.float32)
    warps = np.stack([[1, 0, 0, 0, 1, 0, 0, 0, 1, -focal * x, 0, 0] for x in places]).astype(np.float32)
    neighbors = np.stack([seen(x) for x in places]).astype(np.float32)
    images = MatchingImages(seen(0.0).astype(np.float32), neighbors, warps)
    wrong = []
    for rounds in ((), ((4, 8),), DepthEdgeConfig().rounds):
        surface, clear = refine_depth_edges(
            closed, images, 1.0 / (focal * 0.075), 3, DepthEdgeConfig(rounds=rounds), NativeBackend(1),
        )  # fmt: skip
        wrong.append(np.mean(np.abs(surface - truth)[:, 16:112] > 0.01))
        assert np.all((clear >= 0) & (clear <= 1))
    assert wrong[0] == 0.5
    assert wrong[1] < 0.03
    assert wrong[2] < 0.3 * wrong[1]
