"""The whole system around networks that know the truth: what they say is enough to find poses and depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.droid.config import DroidConfig
from mvsgs_core.droid.system import DroidSlam
from mvsgs_core.tracking.tracker import Update
from mvsgs_core.trajectory import TrackingState, Trajectory
from tests.support import droid_oracle as oracle

pytestmark = pytest.mark.slow

HEIGHT, WIDTH, COUNT = 96, 128, 44
INTRINSICS = np.array([115.0, 115.0, 63.5, 47.5])
SMALL = {  # thresholds for a map of 16x12 cells
    "stride": 2,
    "filter_threshold": 0.4,
    "warmup": 6,
    "keyframe_threshold": 0.6,
    "frontend_threshold": 4.0,
    "backend_threshold": 5.0,
    "backend_steps": (4, 8),
}
CONFIG = DroidConfig(constants=SMALL, area=HEIGHT * WIDTH, device="cpu")


def run(
    config: DroidConfig, noise: float = 0.0, frames: Sequence[int] = range(COUNT)
) -> tuple[DroidSlam, list[Update]]:
    system = DroidSlam(config, net=oracle.Oracle(oracle.path(COUNT), INTRINSICS / 8, noise))
    updates = [system.add(n, n / 30, oracle.image(n, HEIGHT, WIDTH), INTRINSICS) for n in frames]
    return system, updates + list(system.finish())


def errors(trajectory: Trajectory) -> tuple[np.ndarray, float]:
    """Distances from the true positions after Sim(3) alignment, and the scale found."""
    truth, found = oracle.path(COUNT)[trajectory.index][:, :3, 3], trajectory.world_from_cam[:, :3, 3]
    scale, rotation, translation = geometry.umeyama(found, truth)
    return np.linalg.norm(scale * found @ rotation.T + translation - truth, axis=1), scale


@pytest.fixture(scope="module")
def tracked() -> tuple[DroidSlam, list[Update]]:
    return run(CONFIG)


def test_all_poses_are_found(tracked: tuple[DroidSlam, list[Update]]) -> None:
    system, _ = tracked
    trajectory = system.trajectory()
    distance, _ = errors(trajectory)
    assert len(trajectory.index) == COUNT
    assert 6 <= trajectory.keyframe.sum() < COUNT / 2
    assert distance[trajectory.keyframe].max() < 0.005  # of a trajectory of 1.3
    inside = trajectory.index <= trajectory.index[trajectory.keyframe].max()
    assert distance[inside].max() < 0.008
    # beyond the last keyframe poses start at its own; the published damping slows their solution on so small a map
    assert distance.max() < 0.05
    assert set(trajectory.state.tolist()) == {TrackingState.TRACKED}
    assert not system.stats.warnings


def test_depths_are_found_and_trusted(tracked: tuple[DroidSlam, list[Update]]) -> None:
    system, _ = tracked
    _, scale = errors(system.trajectory())
    assert system.framing is not None
    h, w = system.framing.grid
    for frame in system.video.frames[1:-1]:
        coarse = system.coarse_map(frame.index)
        known = coarse.inverse_depth > 0
        assert known.mean() > 0.8
        np.testing.assert_array_equal(known, coarse.weight > 0)
        # cell (r, c) of the message covers the same field of view as 8x8 pixels of the image
        v, u = np.mgrid[:h, :w] * 8.0 + 3.5
        fx, fy, cx, cy = INTRINSICS
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
        true = oracle.depth(oracle.path(COUNT)[frame.index], rays)
        inner = known & (np.mgrid[:h, :w] < np.array([h - 1, w - 1])[:, None, None]).all(axis=0)  # not extrapolated
        relative = np.abs(scale / coarse.inverse_depth[inner] - true[inner]) / true[inner]
        assert np.median(relative) < 0.005


def test_what_is_told_is_never_taken_back(tracked: tuple[DroidSlam, list[Update]]) -> None:
    system, updates = tracked
    published: list[int] = []
    for update in updates:
        if update.correction is not None:
            assert set(update.correction.index.tolist()) <= set(published) | set(update.keyframes)
            assert np.all(update.correction.scale > 0)
        published += update.keyframes
    trajectory = system.trajectory()
    assert published == trajectory.index[trajectory.keyframe].tolist()
    last = updates[-1].correction
    assert last is not None
    np.testing.assert_array_equal(last.world_from_cam, trajectory.world_from_cam[trajectory.keyframe])
    assert system.stats.skipped["frames between strides"] == COUNT // 2


def test_noise_of_the_network_is_averaged(tracked: tuple[DroidSlam, list[Update]]) -> None:
    system, _ = run(CONFIG, noise=0.1, frames=range(24))
    distance, _ = errors(system.trajectory())
    assert 1e-4 < np.sqrt(np.mean(distance**2)) < 0.02


def test_the_same_stream_gives_the_same_poses() -> None:
    first, second = (run(CONFIG, frames=range(20))[0].trajectory().world_from_cam for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_short_stream_starts_by_force() -> None:
    system, _ = run(replace(CONFIG, constants=SMALL | {"warmup": 12}), frames=range(16))
    assert any("forced" in warning for warning in system.stats.warnings)
    distance, _ = errors(system.trajectory())
    assert distance.max() < 0.01


def test_a_camera_at_rest_never_starts() -> None:
    system = DroidSlam(CONFIG, net=oracle.Oracle(oracle.path(1), INTRINSICS / 8))
    for n in range(6):
        system.add(n, n / 30, oracle.image(0, HEIGHT, WIDTH), INTRINSICS)
    assert [update.state for update in system.finish()] == [TrackingState.NOT_INITIALIZED]
    trajectory = system.trajectory()
    assert np.isnan(trajectory.world_from_cam).all()
    assert trajectory.state.tolist() == [TrackingState.NOT_INITIALIZED] * 6
    assert any("never started" in warning for warning in system.stats.warnings)


def test_the_global_adjustment_on_the_way_rescales_consistently() -> None:
    config = replace(CONFIG, constants=SMALL | {"backend_every": 8, "backend_steps": (8,)})
    system = DroidSlam(config, net=oracle.Oracle(oracle.path(COUNT), INTRINSICS / 8))
    published: dict[int, np.ndarray] = {}
    scales: dict[int, float] = {}
    for n in range(COUNT):
        update = system.add(n, n / 30, oracle.image(n, HEIGHT, WIDTH), INTRINSICS)
        if update.correction is not None:
            scales |= dict(zip(update.correction.index.tolist(), update.correction.scale.tolist()))
        published |= {index: system.keyframe(index).inverse_depth for index in update.keyframes}
        if len(system.video) == 8 and "global bundle adjustment" in system.stats.seconds:
            break
    assert np.mean([frame.inverse_depth.mean() for frame in system.video.frames]) == pytest.approx(1.0, rel=0.02)
    early = list(published)[:4]  # published before the map was rescaled
    for index in early:
        ratio = np.median(published[index] / system.keyframe(index).inverse_depth)
        assert scales.get(index, 1.0) == pytest.approx(ratio, rel=0.005)
    assert np.ptp(np.log([scales.get(index, 1.0) for index in early])) < 0.05
    list(system.finish())
    distance, _ = errors(system.trajectory())
    assert distance[system.trajectory().keyframe].max() < 0.008
