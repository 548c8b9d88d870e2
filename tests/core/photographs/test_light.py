"""Exposures of photographs, from gray levels at their matches."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from mvsgs_core.photographs.features import Features
from mvsgs_core.photographs.light import Light, Look
from mvsgs_core.photographs.two_views import TwoViews
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.photometry import PhotometricCalibration

COUNT = 6
INTRINSICS = np.array([300.0, 300.0, 159.5, 119.5])
MAPPED = np.arange(COUNT) < COUNT - 1  # the last one is held out


def solved(gains: np.ndarray, held_out: np.ndarray | None = None) -> Light:
    """Of photographs of one scene, the last one shifted, whose channels (P, 3) have these gains."""
    random = np.random.default_rng(0)
    noise = cv2.GaussianBlur(random.integers(0, 256, (240, 330, 3)).astype(np.uint8), (0, 0), 6.0)
    scene = cv2.normalize(noise, np.empty(0), 60, 170, cv2.NORM_MINMAX).astype(np.float64)
    light, features = Light(Stats()), []
    at = random.uniform(20.0, 220.0, (400, 2))
    for n, gain in enumerate(gains):
        image = np.clip(scene[:, n : n + 320] * gain + random.normal(0.0, 1.0, (240, 320, 3)), 0.0, 255.0)
        if held_out is not None and n == COUNT - 1:
            image = image * held_out
        light.looks.append(Look.of(image.astype(np.uint8), INTRINSICS, 0.0, 320 * 240))
        features.append(Features(at - [n, 0.0], np.zeros((400, 128), np.float32), np.ones(400), np.zeros(400)))
    matches = np.stack([np.arange(len(at))] * 2, axis=1)
    pairs = {(i, j): TwoViews(matches, np.eye(3), 0.0) for i in range(COUNT) for j in range(i + 1, COUNT)}
    light.solve(features, pairs, MAPPED, np.ones(COUNT, bool))
    return light


def slopes(light: Light) -> np.ndarray:
    found = light.exposures()
    assert found is not None
    return np.log(found[:, range(3), range(3)])


def test_gains_and_white_balance_are_found_and_the_held_out_one_too() -> None:
    gains = np.exp(np.random.default_rng(1).normal(0.0, 0.15, (COUNT, 1)) + [[0.0, 0.0, 0.0]] * COUNT)
    gains[2] *= [1.1, 1.0, 0.9]
    found = slopes(solved(gains))
    off = found - np.log(gains)
    assert np.abs(off - off[MAPPED].mean(axis=0)).max() < 0.03


def test_a_held_out_photograph_changes_nothing() -> None:
    gains = np.exp(np.linspace(-0.3, 0.3, COUNT))[:, None] * np.ones(3)
    one, other = solved(gains), solved(gains, held_out=np.array([0.5, 0.7, 0.6]))
    assert np.array_equal(slopes(one)[MAPPED], slopes(other)[MAPPED])
    assert not np.allclose(slopes(one)[~MAPPED], slopes(other)[~MAPPED])


def test_a_steady_camera_has_no_exposures() -> None:
    assert solved(np.ones((COUNT, 3))).exposures() is None


def test_exposures_and_a_vignetting_of_no_camera_are_none_and_counted_once() -> None:
    light = Light(Stats())
    light.looks = [Look.of(np.zeros((48, 64, 3), np.uint8), INTRINSICS, 0.0, 48 * 64)] * 2
    gains, vignetting = np.log([20.0, 1.5]), np.array([0.0, -9.0, 0.0])
    light.photometry = replace(PhotometricCalibration.steady(2), gains=gains, vignetting=vignetting)
    light._lights = dict(enumerate(light.photometry.lights))
    for _ in range(2):
        found = light.exposures()
        assert found is not None
        assert np.isfinite(found).all(axis=(1, 2)).tolist() == [False, True]
        assert light.exposure(0) is None
        assert light.vignetting is None
    assert light.stats.counts["refused_exposures"] == 2, "an exposure and the vignetting"
