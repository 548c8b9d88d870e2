"""Photometry of graphs of images whose gains, lifts, white balance and vignetting are known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from mvsgs_core.tracking.estimation.gray_levels import (
    BESIDE,
    Levels,
    Samples,
    backward,
    log_ratio_moments,
    surrounded,
)
from mvsgs_core.tracking.estimation.photometry import PhotometricCalibration, PhotometricEdges, solve_photometry
from mvsgs_core.tracking.estimation.response import MIDDLE, affine, vignetting_polynomial
from mvsgs_core.tracking.image import CELL, TrackingImage

POINTS = 400


@dataclass
class Camera:
    """Images of random surfaces, each seen by neighbors in a loop."""

    count: int = 24
    gain: float = 0.0  # amplitude of the drift
    response: float = 0.0
    lift: float = 0.0  # amplitude of what the lifts have of their own
    white: float = 0.0
    vignetting: float = 0.0
    of_light: bool = False  # the vignetting is of the light: the response makes gray levels of it
    dark_known: bool = True  # the edges are looked at with the vignetting in hand
    noise: float = 1.0 / 255.0

    def __post_init__(self) -> None:
        n = np.arange(self.count)
        self.gains = self.gain * np.sin(0.7 * n) - np.mean(self.gain * np.sin(0.7 * n))
        own = self.lift * np.cos(1.9 * n)
        self.lifts = self.response * self.gains + own - own.mean()
        tint = self.white * np.sin(0.4 * n)[:, None] * [1.0, 0.0, -1.0]
        self.whites = tint - tint.mean(axis=0)

    def edges(self, wrong: int = 0) -> PhotometricEdges:
        """To the next three images, the last ones' to the first; of `wrong` edges all levels are those of a lie."""
        random = np.random.default_rng(3)
        pairs = [(a, (a + k) % self.count) for a in range(self.count) for k in (1, 2, 3)]
        pairs = [(min(p), max(p)) for p in pairs]
        radius = np.linspace(0.0, 1.0, 33)
        dark = np.linalg.lstsq(
            np.stack([radius**2, radius**4, radius**6], axis=1), np.log1p(-self.vignetting * radius**2)
        )
        moments = []
        for n, (a, b) in enumerate(pairs):
            surface = random.uniform(0.12, 0.7, (POINTS, 3))
            radii = random.uniform(0.0, 1.0, (2, POINTS))
            seen = [self._seen(surface, i, r, random) for i, r in zip((a, b), radii)]
            if n % 11 == 5 and n // 11 < wrong:
                seen[1] = Samples(seen[1].level * 1.3, seen[1].spread)
            powers = [np.stack([r**2, r**4, r**6], axis=1) for r in radii]
            found = log_ratio_moments(seen[0], seen[1], (powers[0], powers[1]), dark[0] * self.dark_known)
            assert found is not None
            moments.append(found)
        source, to = np.array(pairs).T
        return PhotometricEdges(source, to, np.array(moments))

    def _seen(self, surface: np.ndarray, index: int, radius: np.ndarray, random: np.random.Generator) -> Samples:
        white = self.whites[index]
        slope, offset = affine(self.gains[index] + white, self.lifts[index] + self.response * white)
        dark = (1.0 - self.vignetting * radius**2)[:, None]
        level = (surface * slope + offset) * (1.0 if self.of_light else dark)
        if self.of_light:
            slope, offset = affine(np.log(dark), self.response * np.log(dark))
            level = level * slope + offset
        noisy = level + self.noise * random.standard_normal(level.shape)
        return Samples(np.where((noisy > 0.03) & (noisy < 0.95), noisy, np.nan), np.full(len(level), 1.0 / 255.0))


@pytest.mark.parametrize("noise", [0.2, 1.0, 4.0])
def test_a_steady_camera_is_exactly_steady(noise: float) -> None:
    found = solve_photometry(Camera(noise=noise / 255.0).edges(), 24)
    assert not found.varies
    assert not found.lifts.any()
    assert not found.vignetting.any()


@pytest.mark.parametrize("wrong", [0, 6])
def test_gains_response_and_vignetting_are_found_with_wrong_edges_too(wrong: int) -> None:
    camera = Camera(gain=0.3, response=0.3, vignetting=0.3)
    found = solve_photometry(camera.edges(wrong), camera.count)
    assert np.abs(found.gains - camera.gains).max() < 0.01
    assert abs(found.gains.mean()) < 1e-9
    assert abs(found.response - 0.3) < 0.02
    assert not found.own_lifts
    radius = np.linspace(0.0, 1.0, 21)
    assert found.vignetting_response == 0.0
    brightness = 1.0 + np.stack([radius**2, radius**4, radius**6], axis=1) @ vignetting_polynomial(
        found.vignetting, 0.0
    )
    np.testing.assert_allclose(brightness, 1.0 - 0.3 * radius**2, atol=0.01)
    assert not found.white.any()


@pytest.mark.parametrize(("dark_known", "off"), [(True, 0.02), (False, 0.04)])
def test_vignetting_of_the_light_follows_the_response(dark_known: bool, off: float) -> None:
    """Also where nothing is known of it when the edges are looked at: what it changes there is no outlier. Their gray
    levels are then not those of the middle of the image, which the response is off by."""
    camera = Camera(gain=0.3, response=0.3, vignetting=0.5, of_light=True, dark_known=dark_known)
    found = solve_photometry(camera.edges(), camera.count)
    assert abs(found.vignetting_response - 0.3) < off
    radius = np.linspace(0.0, 1.0, 21)
    logarithm = np.stack([radius**2, radius**4, radius**6], axis=1) @ found.vignetting
    np.testing.assert_allclose(np.exp(logarithm), 1.0 - 0.5 * radius**2, rtol=0.006)
    for level in (0.2, 0.4, 0.7):
        (slope, offset), dark = affine(logarithm, found.vignetting_response * logarithm), np.log(1 - 0.5 * radius**2)
        true_slope, true_offset = affine(dark, 0.3 * dark)
        np.testing.assert_allclose(
            level * slope + offset, level * true_slope + true_offset, rtol=0.005, atol=0.15 * off
        )
    middle = 1.0 + np.stack([radius**2, radius**4, radius**6], axis=1) @ vignetting_polynomial(found.vignetting, 0.3)
    slope, offset = affine(logarithm, 0.3 * logarithm)
    np.testing.assert_allclose(middle, slope + offset / MIDDLE, rtol=0.005)


def test_lifts_of_their_own_and_white_balance_are_found() -> None:
    camera = Camera(gain=0.2, lift=0.06, white=0.08)
    found = solve_photometry(camera.edges(), camera.count)
    assert found.own_lifts
    assert np.abs(found.gains - camera.gains).max() < 0.01
    assert np.abs(found.white - camera.whites).max() < 0.01
    assert np.abs(found.lifts - camera.lifts).max() < 0.02  # gain and lift do not commute


def test_the_uncertainty_is_that_of_the_errors() -> None:
    camera = Camera(gain=0.2, noise=4.0 / 255.0)
    found = solve_photometry(camera.edges(), camera.count)
    off = (found.gains - camera.gains) / found.sigma
    assert 0.3 < np.sqrt(np.mean(off**2)) < 2.0


def test_parts_without_edges_between_them_have_a_gauge_each() -> None:
    camera = Camera(gain=0.3)
    edges = camera.edges()
    inside = (edges.source < 12) == (edges.to < 12)
    cut = PhotometricEdges(edges.source[inside], edges.to[inside], edges.moments[inside])
    found = solve_photometry(cut, camera.count)
    for part in (slice(0, 12), slice(12, 24)):
        true = camera.gains[part] - camera.gains[part].mean()
        assert np.abs(found.gains[part] - true).max() < 0.01


def test_known_exposures_hold_what_few_matches_leave_open() -> None:
    camera = Camera(gain=0.5, count=21)
    edges = camera.edges()
    inside = (edges.source < 12) == (edges.to < 12)  # two parts, which only their exposures compare
    cut = PhotometricEdges(edges.source[inside], edges.to[inside], edges.moments[inside])
    known = camera.gains / 0.45 + 3.0
    known[5] = np.nan
    found = solve_photometry(cut, camera.count, known)
    assert np.abs(found.gains - camera.gains).max() < 0.02
    alone = solve_photometry(cut, camera.count)
    assert np.abs(alone.gains - camera.gains).max() > 0.03


@pytest.mark.parametrize("abrupt", [False, True])
def test_known_exposures_that_the_images_contradict_leave_them_alone(abrupt: bool) -> None:
    """Clouds pass while the camera's exposure stays; abrupt: one is over a third of the stream."""
    camera, n = Camera(count=30), np.arange(30)
    cloud = np.where((n >= 10) & (n < 20), 0.35, 0.0) if abrupt else 0.2 * np.sin(2.0 * np.pi * n / 30)
    camera.gains = cloud - cloud.mean()
    found = solve_photometry(camera.edges(), camera.count, np.full(30, np.log(0.01)))
    assert found.varies
    assert np.abs(found.gains - camera.gains).max() < 0.01
    assert "do not fit what the images show" in found.warning


def test_rounded_exposures_are_no_contradiction() -> None:
    camera = Camera(gain=0.3)
    exposures = np.round(camera.gains / 0.45 * 6.0) / 6.0
    found = solve_photometry(camera.edges(), camera.count, exposures)
    assert np.abs(found.gains - camera.gains).max() < 0.01
    assert 0.0 < found.known_off < 0.03
    assert found.warning == ""


def test_no_edges_say_nothing() -> None:
    nothing = PhotometricEdges(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 9, 9)))
    assert not solve_photometry(nothing, 5).varies


def test_an_edge_seen_from_its_other_end_says_the_same() -> None:
    edges = Camera(gain=0.3, count=4).edges()
    turned = PhotometricEdges(edges.to, edges.source, np.array([backward(m) for m in edges.moments]))
    there, back = solve_photometry(edges, 4), solve_photometry(turned, 4)
    np.testing.assert_allclose(there.gains, back.gains, atol=1e-9)


def test_a_step_to_a_frame_is_that_of_the_solution() -> None:
    camera = Camera(gain=0.3, lift=0.05, white=0.08, vignetting=0.2)
    edges = camera.edges()
    found = solve_photometry(edges, camera.count)
    a, b = int(edges.source[10]), int(edges.to[10])
    gain, lift, *white = found.step(edges.moments[10, :, :2])
    assert gain == pytest.approx(camera.gains[b] - camera.gains[a], abs=0.01)
    assert lift == pytest.approx(camera.lifts[b] - camera.lifts[a], abs=0.01)
    np.testing.assert_allclose(white, camera.whites[b] - camera.whites[a], atol=0.01)


def test_affines_are_the_levels_that_the_model_gives() -> None:
    gain, lift = 0.4, 0.12
    level, steps = 0.2, 20000
    for _ in range(steps):  # dI = (g I + h (m - I)) dt
        level += (gain * level + lift * (MIDDLE - level)) / steps
    slope, offset = affine(np.array(gain), np.array(lift))
    assert 0.2 * slope + offset == pytest.approx(level, rel=1e-4)
    matrix = PhotometricCalibration.steady(1).affine(np.array([gain, lift, 0.1, 0.0, -0.1]))
    assert matrix.shape == (3, 4)
    assert matrix.dtype == np.float32
    assert np.log(matrix[0, 0] / matrix[1, 1]) == pytest.approx(0.1, abs=1e-6)


def test_levels_leave_out_what_the_sensor_cannot_show_and_know_flat_places() -> None:
    half = np.full((16, 24, 3), 128, np.uint8)
    half[:, :8] = 255
    half[:, 8:16:2] = 90
    levels = Levels(half)
    there = levels.at(np.array([[4.5, 8.5], [22.5, 8.5], [40.5, 8.5], [-9.0, 3.0]]))
    assert np.isnan(there.level[[0, 3]]).all()
    np.testing.assert_allclose(there.level[2], 128 / 255, atol=1e-6)
    assert there.spread[1] > 0.05 > 1e-4 > there.spread[2]
    places = levels.flattest(8)
    assert places.shape == (4 * 6, 2)
    cell = np.floor((places + 0.5) / 8).astype(int)
    np.testing.assert_array_equal(cell, [(u, v) for v in range(4) for u in range(6)])


def test_a_sky_behind_roofs_that_come_nearer_says_nothing() -> None:
    random, (height, width) = np.random.default_rng(4), (240, 320)
    v, u = np.mgrid[: height + 8, :width]
    fronts = cv2.GaussianBlur(random.uniform(0.0, 255.0, v.shape), (0, 0), 1.5)
    fronts = np.clip(115.0 + 3.0 * (fronts - fronts.mean()), 20.0, 220.0)
    fronts[v < 100 + 12 * np.sin(0.1 * u)] = 0.0
    sky = 150.0 + 0.5 * v

    def image(rise: int) -> TrackingImage:
        near = fronts[rise : rise + height]
        gray = np.where(near > 0.0, near, sky[:height]).astype(np.uint8)
        return TrackingImage.of(rise, 0.0, np.dstack([gray] * 3), (height, width), color=False)

    before, after = image(0), image(8)
    points, (places, samples) = before.cells.points, before.flat_places
    assert before.levels is not None
    assert after.levels is not None
    found = before.cells.textured & (points[:, 1] > 85.0)
    chosen = surrounded(places, points, found, (height // CELL, width // CELL))
    behind = places[:, 1] < 100 + 12 * np.sin(0.1 * places[:, 0]) - 2.0
    assert (found & behind).sum() > 20
    assert (chosen & behind).sum() < 0.2 * (found & behind).sum()
    assert (chosen & ~behind).sum() > 0.5 * (found & ~behind).sum()
    assert not (chosen & ~found).any()
    gains = []
    nowhere = np.zeros((int(found.sum()), 3))
    there = after.levels.at(places[found] - [0.0, 8.0])
    for doubt in (None, np.where(chosen[found], 0.0, BESIDE)):
        moments = log_ratio_moments(samples[found], there, (nowhere, nowhere), np.zeros(3), doubt)
        assert moments is not None
        gains.append(float(moments[0, 0, 8] / moments[0, 0, 0]))
    assert gains[0] < -0.005
    assert abs(gains[1]) < 0.001
