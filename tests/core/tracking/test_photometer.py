"""Exposures that the tracker finds on the synthetic room, against those of its camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from msgs import Frame, GroundTruth, Keyframe, Message, Poses, Trajectory
from mvsgs_core.scene.difficulties import Difficulties, Sensor
from mvsgs_core.tracking.estimation.response import MIDDLE
from mvsgs_core.tracking.tracker import Tracker
from mvsgs_core.trajectory import Trajectory as CoreTrajectory
from nodes.posed_tracker import PosedTracker
from tests.support.sequences import synthetic, track

pytestmark = pytest.mark.slow

AnyTrajectory = Trajectory | CoreTrajectory
LEVELS = np.linspace(0.1, 0.85, 40)
DIFFICULT: dict[str, Any] = {"exposure": 1.0, "white_balance": 0.3, "vignetting": 0.5, "response": 0.15, "noise": 1.5}


def errors(trajectory: AnyTrajectory, sensor: Sensor, which: np.ndarray) -> np.ndarray:
    """Of each chosen frame the median relative error of the gray levels that its exposure gives."""
    assert trajectory.exposure is not None
    affine = trajectory.exposure[which].astype(np.float64)
    slope, offset = np.einsum("ncc->nc", affine[:, :, :3]), affine[:, :, 3]
    found = slope[..., None] * LEVELS + offset[..., None]
    mean = trajectory.index[trajectory.keyframe].tolist()
    true = np.array([sensor.transferred(LEVELS, int(frame), mean) for frame in trajectory.index[which]])
    shown = (true > 0.05) & (true < 0.9)
    return np.array([np.median(np.abs(f / t - 1.0)[s]) for f, t, s in zip(found, true, shown)])


@pytest.mark.parametrize("options", [{"exposure": 1.0}, DIFFICULT], ids=["exposure", "all"])
def test_exposures_of_keyframes_and_frames_are_the_cameras_to_a_percent(options: dict[str, Any]) -> None:
    tracker, trajectory, updates = track(synthetic(frames=80, **options)[:50])
    sensor = Sensor(Difficulties(**options), 0)
    keyframe = trajectory.keyframe
    assert np.isfinite(trajectory.exposure).all()
    assert np.median(errors(trajectory, sensor, keyframe)) < 0.01
    assert np.median(errors(trajectory, sensor, ~keyframe)) < 0.01
    last = updates[-1].correction
    assert last is not None
    np.testing.assert_array_equal(last.exposure, trajectory.exposure[np.isin(trajectory.index, last.index)])
    if options is not DIFFICULT:
        assert tracker.vignetting is None
        return
    falloff = sensor.falloff(60, 80)  # of light; of gray levels by the response, at mid gray
    true = np.interp(falloff * 0.3, np.linspace(0.0, 4.0, sensor.STEPS + 1), sensor.curve)
    v, u = np.mgrid[:60, :80]
    square = ((u - 39.5) ** 2 + (v - 29.5) ** 2) / (0.25 * (60**2 + 80**2))
    found = 1.0 + np.stack([square, square**2, square**3], axis=-1) @ tracker.vignetting
    assert np.median(np.abs(found / (true / true.max()) - 1.0)) < 0.02
    response = tracker.session.photometer.photometry.response
    assert MIDDLE * response / (1.0 - response) == pytest.approx(0.15, abs=0.05)


def test_given_poses_have_exposures_too_and_every_change_is_sent() -> None:
    items = synthetic(frames=80, exposure=1.0)[:50]
    node = PosedTracker()
    sent: list[Message] = []
    for item in items:
        sent += node.on_frame(Frame(item.index, item.timestamp, item.image, item.intrinsics))
        truth = GroundTruth(item.index, item.timestamp, item.image, item.intrinsics, item.world_from_cam, None)
        sent += node.on_ground_truth(truth)
    sent += node.on_end()
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    assert trajectory.exposure is not None
    known = np.isfinite(trajectory.exposure).all(axis=(1, 2))  # but the first, which is held out and before the map
    assert known[1:].all()
    assert np.median(errors(trajectory, Sensor(Difficulties(exposure=1.0), 0), known)) < 0.01
    newest = {m.index: m.exposure for m in sent if isinstance(m, Keyframe)}
    for poses in (m for m in sent if isinstance(m, Poses)):
        assert poses.exposure is not None
        assert np.isin(poses.index, list(newest)).all()
        newest |= dict(zip(poses.index.tolist(), poses.exposure, strict=True))
    for index, affine in newest.items():
        np.testing.assert_allclose(affine, trajectory.exposure[index], atol=1.5 / 255.0)


def test_a_robots_exposures_say_what_the_exponent_is() -> None:
    sensor = Sensor(Difficulties(exposure=1.0), 0)
    tracker = Tracker()
    for item in synthetic(frames=80, exposure=1.0)[:30]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics, exposure=sensor.gain(item.index))
    list(tracker.finish())
    keyframes = sorted(tracker.session.graph.keyframes)
    assert all(k.image.exposure == sensor.gain(i) for i, k in tracker.session.graph.keyframes.items())
    assert np.median(errors(tracker.trajectory(), sensor, tracker.trajectory().keyframe)) < 0.01
    assert len(keyframes) > 3


def test_exposures_that_the_images_contradict_are_said_and_change_nothing() -> None:
    tracker = Tracker()
    for item in synthetic(frames=80, exposure=1.0)[:30]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics, exposure=0.01)
    list(tracker.finish())
    found = tracker.trajectory()
    assert np.median(errors(found, Sensor(Difficulties(exposure=1.0), 0), found.keyframe)) < 0.01
    assert any("exposures that came with the images" in warning for warning in tracker.stats.warnings)


@pytest.mark.parametrize(
    "options", [{}, {"noise": 3.0, "motion_blur": 0.5, "stop": 30, "size": (120, 160)}], ids=["clean", "noise"]
)
def test_steady_light_has_no_exposure(options: dict[str, Any]) -> None:
    tracker, trajectory, updates = track(synthetic(frames=80, **options))
    assert trajectory.exposure is None
    assert trajectory.vignetting is None
    for update in updates:
        assert all(tracker.exposure(index) is None for index in update.keyframes)
        assert update.correction is None or update.correction.exposure is None
