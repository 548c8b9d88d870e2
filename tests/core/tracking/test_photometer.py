"""Exposures that the tracker finds on the synthetic room, against those of its camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mvsgs_core.scene.difficulties import Difficulties, Sensor
from mvsgs_core.tracking.estimation.response import MIDDLE
from mvsgs_core.tracking.tracker import Tracker
from tests.support.sequences import synthetic, track

pytestmark = pytest.mark.slow

LEVELS = np.linspace(0.1, 0.85, 40)
DIFFICULT: dict[str, Any] = {"exposure": 1.0, "white_balance": 0.3, "vignetting": 0.5, "response": 0.15, "noise": 1.5}


def transfers(sensor: Sensor, frames: np.ndarray, mean_of: np.ndarray) -> np.ndarray:
    """(N, 3, L) what LEVELS of the mean camera of the keyframes `mean_of` become in the frames: the truth."""
    light = np.geomspace(1e-4, 4.0, 4000)

    def logs(frame: int) -> np.ndarray:
        return np.asarray(np.log(sensor.gain(frame) * sensor.white(frame)))

    def levels(gain: float) -> np.ndarray:
        return np.asarray(np.interp(light * gain, np.linspace(0.0, 4.0, sensor.STEPS + 1), sensor.curve) / 255.0)

    mean = np.mean([logs(int(k)) for k in mean_of], axis=0)
    at = [np.interp(LEVELS, levels(np.exp(mean[c])), light) for c in range(3)]
    return np.array(
        [[np.interp(at[c], light, levels(np.exp(logs(int(f))[c]))) for c in range(3)] for f in frames]
    )  # fmt: skip


def errors(tracker: Tracker, sensor: Sensor, which: np.ndarray) -> np.ndarray:
    """Of each chosen frame the median relative error of the gray levels that its exposure gives."""
    trajectory = tracker.trajectory()
    assert trajectory.exposure is not None
    affine = trajectory.exposure[which].astype(np.float64)
    slope, offset = np.einsum("ncc->nc", affine[:, :, :3]), affine[:, :, 3]
    found = slope[..., None] * LEVELS + offset[..., None]
    true = transfers(sensor, trajectory.index[which], trajectory.index[trajectory.keyframe])
    shown = (true > 0.05) & (true < 0.9)
    return np.array([np.median(np.abs(f / t - 1.0)[s]) for f, t, s in zip(found, true, shown)])


@pytest.mark.parametrize("options", [{"exposure": 1.0}, DIFFICULT], ids=["exposure", "all"])
def test_exposures_of_keyframes_and_frames_are_the_cameras_to_a_percent(options: dict[str, Any]) -> None:
    tracker, trajectory, updates = track(synthetic(frames=80, **options))
    sensor = Sensor(Difficulties(**options), 0)
    keyframe = trajectory.keyframe
    assert np.isfinite(trajectory.exposure).all()
    assert np.median(errors(tracker, sensor, keyframe)) < 0.01
    assert np.median(errors(tracker, sensor, ~keyframe)) < 0.01
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


@pytest.mark.parametrize("options", [{}, {"noise": 3.0, "motion_blur": 0.5}], ids=["clean", "noise"])
def test_steady_light_has_no_exposure(options: dict[str, Any]) -> None:
    tracker, trajectory, updates = track(synthetic(frames=80, **options))
    assert trajectory.exposure is None
    assert trajectory.vignetting is None
    for update in updates:
        assert all(tracker.exposure(index) is None for index in update.keyframes)
        assert update.correction is None or update.correction.exposure is None
