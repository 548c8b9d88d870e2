"""Exposures and vignetting that no camera has are none, for every reader: a map that is kept can be read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.stats import Stats
from mvsgs_core.tracking import photometer
from mvsgs_core.tracking.estimation import lights
from mvsgs_core.tracking.estimation.photometry import PhotometricCalibration
from mvsgs_core.tracking.known_map import load, save
from mvsgs_core.tracking.photometer import FrameLight, Photometer
from mvsgs_core.tracking.publish import Publisher
from tests.support.true_maps import true_graph

FRAMES = (0, 8)
GAINS = np.log([20.0, 1.5])  # the first is more than that of any camera


def lit() -> Photometer:
    made = Photometer(true_graph(*FRAMES), Stats())
    vignetting = np.array([0.0, -9.0, 0.0])
    made.photometry = replace(PhotometricCalibration.steady(2), gains=GAINS, vignetting=vignetting)
    made._lights = dict(zip(FRAMES, made.photometry.lights))
    return made


def test_they_are_none_and_counted_once() -> None:
    light = lit()
    for _ in range(3):
        assert light.exposure(0) is None
        np.testing.assert_allclose(light.exposure(8), 1.5 * np.eye(3, 4), rtol=1e-6)
        assert light.vignetting is None
        found = light.of_frames([FrameLight(0), FrameLight(8)], np.ones(2, bool))
        assert found is not None
        assert np.isfinite(found).all(axis=(1, 2)).tolist() == [False, True]
    assert light.stats.counts["refused_exposures"] == 2, "an exposure and the vignetting"
    assert light.stats.warnings.lines() == [f"{lights.NO_LIGHT} (2 times)"]


def test_a_map_that_is_kept_can_be_read(tmp_path: Path) -> None:
    light = lit()
    publisher = Publisher(light.graph, 0.01, light=light)
    for index in FRAMES:
        publisher.publish(index)
    save(tmp_path / "tracker.npz", light.graph, publisher, light.vignetting)
    known = load(tmp_path / "tracker.npz")
    assert list(known.exposures) == [8]
    assert not known.published_vignetting.any()


def test_exposures_that_follow_another_response_are_known_to_be_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large map the lights of old keyframes stay, and what they say of colors changes with the newest ones'."""
    light = Photometer(true_graph(0, 8, 16), Stats())
    white = np.array([[0.1, 0.0, -0.1], [-0.1, 0.0, 0.1]])
    light.photometry = replace(PhotometricCalibration.steady(2), gains=GAINS, white=white)
    light._lights = dict(zip(FRAMES, light.photometry.lights))
    was, made_of = light.exposure(8), light.known(8)
    monkeypatch.setattr(photometer, "AT_ONCE", 1)
    monkeypatch.setattr(lights, "solve_photometry", lambda *_: replace(light.photometry, response=0.3))
    light._solve([0, 8, 16], False)
    assert np.abs(light.exposure(8) - was).max() > 0.01
    assert light.known(8) is not made_of
