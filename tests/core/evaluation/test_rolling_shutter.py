"""Renders are as the camera's rolling shutter would have seen them."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.camera import project, unproject
from mvsgs_core.datasets.synthetic import FPS, Synthetic
from mvsgs_core.evaluation.rolling_shutter import Shutter, apply_rolling_shutter, pixel_velocity, velocities
from mvsgs_core.image_metrics import psnr

VELOCITY = np.array([0.3, -0.2, 0.4, 0.2, -0.1, 0.3])


def test_velocity_of_a_steady_motion_is_found_at_every_frame() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.25, 0.35])
    start = geometry.se3_exp(np.array([1.0, 2.0, 3.0, 0.5, 0.2, 0.1]))
    poses = np.array([start @ geometry.se3_exp(VELOCITY * t) for t in times])
    found = velocities(times, poses, np.ones(5, dtype=bool))
    np.testing.assert_allclose(found, np.tile(VELOCITY, (5, 1)), atol=1e-9)


def test_velocity_is_zero_where_no_neighbor_in_time_is_known() -> None:
    times = np.array([0.0, 0.1, 0.2, 1.0, 1.1])
    poses = np.array([geometry.se3_exp(VELOCITY * t) for t in times])
    poses[1] = np.nan
    found = velocities(times, poses, np.array([True, False, True, True, False]))
    np.testing.assert_allclose(found[[0, 2]], [VELOCITY, VELOCITY], atol=1e-9)
    assert not found[[1, 3, 4]].any()


def test_pixel_velocity_is_the_derivative_of_the_projection() -> None:
    depth = np.random.default_rng(0).uniform(1.0, 4.0, (12, 16))
    lens = np.array([20.0, 21.0, 7.5, 5.5])
    points = unproject(depth, lens)
    step = 1e-6
    back = geometry.inverse(geometry.se3_exp(VELOCITY * step))
    expected = (project(points @ back[:3, :3].T + back[:3, 3], lens) - project(points, lens)) / step
    np.testing.assert_allclose(pixel_velocity(depth, lens, VELOCITY), expected, atol=1e-4)


def test_a_rolled_render_shows_what_the_rolling_camera_saw() -> None:
    still, rolling = Synthetic(threads=1), Synthetic(threads=1, rolling_shutter=0.8)
    for n in (20, 60):
        item, seen = still[n], rolling[n]
        assert item.depth is not None
        np.testing.assert_array_equal(item.world_from_cam, seen.world_from_cam)
        around = np.array([still[n + k].world_from_cam for k in (-1, 0, 1)])
        velocity = velocities(np.array([-1, 0, 1]) / FPS, around, np.ones(3, dtype=bool))[1]
        color, target = item.image.astype(np.float32) / 255, seen.image.astype(np.float32) / 255
        ours = apply_rolling_shutter(color, item.depth, item.intrinsics, Shutter(0.8 / FPS, velocity))
        inner = np.s_[8:-8, 8:-8]
        assert psnr(ours[inner], target[inner]) > psnr(color[inner], target[inner]) + 4.0
        wrong = apply_rolling_shutter(color, item.depth, item.intrinsics, Shutter(0.8 / FPS, -velocity))
        assert psnr(wrong[inner], target[inner]) < psnr(color[inner], target[inner])


@pytest.mark.parametrize("readout_time", [0.0, 0.02])
def test_nothing_moves_without_readout_velocity_or_depth(readout_time: float) -> None:
    color = np.random.default_rng(0).random((12, 16, 3)).astype(np.float32)
    lens = np.array([20.0, 21.0, 7.5, 5.5])
    depth = np.ones((12, 16), np.float32)
    assert apply_rolling_shutter(color, depth * 0, lens, Shutter(readout_time, VELOCITY)) is color
    assert apply_rolling_shutter(color, depth, lens, Shutter(readout_time, VELOCITY * 0)) is color
    assert (apply_rolling_shutter(color, depth, lens, Shutter(readout_time, VELOCITY)) is color) == (
        readout_time == 0.0
    )
