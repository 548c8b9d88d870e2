"""The whole system around networks that know the truth: what they say is enough to find poses and depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core import geometry
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.droid.config import DroidConfig
from mvsgs_core.droid.system import DroidSlam
from mvsgs_core.droid.video import VideoFrame
from mvsgs_core.networks.droid import Update as Revised
from mvsgs_core.tracking.publish import Publisher
from mvsgs_core.tracking.tracker import Update
from mvsgs_core.trajectory import TrackingState, Trajectory
from tests.support import droid_oracle as oracle
from tests.support.full_disk import full_after

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
    similarity = geometry.umeyama(found, truth)
    return np.linalg.norm(similarity.apply(found) - truth, axis=1), similarity.scale


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


def started(constants: dict[str, object], frames: int, net: oracle.Oracle | None = None) -> DroidSlam:
    """After the first frames of the path, without what comes at the end."""
    config = DroidConfig(constants=SMALL | constants, area=HEIGHT * WIDTH, device="cpu")  # type: ignore[arg-type]
    system = DroidSlam(config, net=net or oracle.Oracle(oracle.path(COUNT), INTRINSICS / 8))
    for n in range(frames):
        system.add(n, n / 30, oracle.image(n, HEIGHT, WIDTH), INTRINSICS)
    return system


@pytest.mark.parametrize(
    ("constants", "frames", "said"),
    [
        ({"stride": 4}, 9, "too few frames: 3 frames (of 9, stride=4) may become keyframes, of which a start takes 4"),
        ({"stride": 1}, 2, "too few frames: 2 frames may become keyframes"),
        ({"stride": 2, "filter_threshold": 50}, 9, "too little motion: 1 of 5 frames (of 9, stride=2) moved by 50"),
    ],
)
def test_what_never_started_says_what_it_lacked(constants: dict[str, object], frames: int, said: str) -> None:
    system = started(constants, frames)
    list(system.finish())
    assert said in system.nothing
    assert said in "".join(system.stats.warnings)


class Void(oracle.Oracle):
    """Its revisions are not finite."""

    def _update(self, *given: torch.Tensor, **named: torch.Tensor) -> Revised:
        update = super()._update(*given, **named)
        return update._replace(delta=torch.full_like(update.delta, torch.nan))


def test_a_network_that_gives_nothing_finite_is_named() -> None:
    system = started({"stride": 1}, 6, Void(oracle.path(COUNT), INTRINSICS / 8))
    list(system.finish())
    assert "5 network outputs were not finite, which is taken for no motion" in system.nothing


def test_intrinsics_that_change_are_warned_of() -> None:
    system = started({}, 1)
    half = np.ascontiguousarray(oracle.image(1, HEIGHT, WIDTH)[::2, ::2])
    system.add(1, 1 / 30, half, scale_intrinsics(INTRINSICS, (HEIGHT, WIDTH), half.shape[:2]))
    assert not system.stats.warnings, "the same lens at another size"
    system.add(3, 3 / 30, oracle.image(3, HEIGHT, WIDTH), INTRINSICS * [2, 2, 1, 1])
    assert any("the intrinsics change between frames" in warning for warning in system.stats.warnings)


def test_frames_lie_in_a_file_and_a_full_disk_costs_their_poses_alone() -> None:
    config = replace(CONFIG, constants=SMALL | {"warmup": 4, "backend_steps": (1,)})
    system = DroidSlam(config, net=oracle.Oracle(oracle.path(COUNT), INTRINSICS / 8))
    with full_after(0):
        system.add(0, 0.0, oracle.image(0, HEIGHT, WIDTH), INTRINSICS)
        system.add(1, 1 / 30, oracle.image(1, HEIGHT, WIDTH), INTRINSICS)
    for n in range(2, 9):
        system.add(n, n / 30, oracle.image(n, HEIGHT, WIDTH), INTRINSICS)
    assert [frame.is_there for frame in system.frames] == [False] * 2 + [True] * 7
    list(system.finish())
    trajectory = system.trajectory()
    assert trajectory.keyframe[0], "what the networks made of it was there"
    assert (trajectory.state == TrackingState.LOST).nonzero()[0].tolist() == [1]
    assert any("frames that the disk of TMPDIR had no room for" in warning for warning in system.stats.warnings)


def test_more_keyframes_than_the_published_buffer_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvsgs_core.droid.system._MANY", 2)
    system = started({"stride": 1, "filter_threshold": 0.01}, 3)
    cells = HEIGHT * WIDTH / 64
    (warning,) = system.stats.warnings
    assert f"keeps {3 * 128 * 4 * cells / 1e6:.1f} MB of each in memory" in warning
    assert len(system.video) == 3


def test_publishing_asks_for_all_keyframes_a_fixed_number_of_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not once for each keyframe: that is the square of their number, for every frame that passes the filter."""
    asked: list[int] = []
    published = vars(Publisher)["published"].fget

    def counted(publisher: Publisher) -> set[int]:
        asked[-1] += 1
        return published(publisher)

    monkeypatch.setattr(Publisher, "published", property(counted))
    for count in (50, 100):
        system = DroidSlam(CONFIG, net=oracle.Oracle(oracle.path(COUNT), INTRINSICS / 8))
        system._set_up(HEIGHT, WIDTH, INTRINSICS)
        system._states.append(TrackingState.TRACKED)
        for n in range(count):
            system.video.append(VideoFrame(n, n / 30, np.eye(4), np.ones((HEIGHT // 8, WIDTH // 8)), torch.zeros(1)))
        assert system.video.keyframes is system.video.keyframes, "it is kept, not made"
        asked.append(0)
        assert len(system._publish(count).keyframes) == count
    assert asked[0] == asked[1]
