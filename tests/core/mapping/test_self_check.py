"""What a map says of itself: how well it explains its images, and why not better."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core import camera
from mvsgs_core.datasets import open_dataset
from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.self_check import MAX_NOISE, SelfCheck, check, noise_of
from tests.support.shared_data import shared
from tests.support.small_maps import CONFIG
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def picture(seed: int = 0) -> np.ndarray:
    """(96, 128, 3) in 0.2..0.8: smooth structure, and edges."""
    generator = np.random.default_rng(seed)
    image = cv2.resize(generator.random((8, 10, 3)).astype(np.float32), (128, 96), interpolation=cv2.INTER_CUBIC)
    image[30:60, 40:90] = 0.9
    return np.clip(0.2 + 0.6 * image, 0.0, 1.0).astype(np.float32)


def known(found: SelfCheck | None) -> SelfCheck:
    assert found is not None
    return found


def test_a_map_without_keyframes_says_nothing() -> None:
    assert check([]) is None


def test_a_good_map_gets_no_warning() -> None:
    image = picture()
    found = known(check([(image + np.float32(0.01), image, None)]))
    assert found.psnr == pytest.approx(40.0, abs=0.1)
    assert found.warning is None


def test_noise_is_measured_and_blamed() -> None:
    generator = np.random.default_rng(1)
    pairs = [
        (picture(k), picture(k) + generator.normal(0.0, 20.0 / 255.0, (96, 128, 3)).astype(np.float32), None)
        for k in (1, 2)
    ]
    found = known(check(pairs))
    assert found.noise == pytest.approx(20.0, rel=0.1)
    assert noise_of(picture()) < 2.0
    assert found.warning is not None
    assert "noise of 20 of 255" in found.warning
    assert "exposure" not in found.warning


def test_noise_is_told_where_the_map_fits_it_too() -> None:
    """As a map does with too few views: its keyframes look good, and others don't."""
    generator = np.random.default_rng(2)

    def fitted(level: float) -> SelfCheck:
        image = picture() + generator.normal(0.0, level / 255.0, (96, 128, 3)).astype(np.float32)
        return known(check([(image + np.float32(0.02), image, None)]))

    noisy = fitted(12.0)
    assert noisy.psnr > 30.0
    assert noisy.noise_limit == pytest.approx(20.0 * np.log10(255.0 / 12.0), abs=0.7)
    assert noisy.warning is not None
    assert "noise of 12 of 255" in noisy.warning
    assert f"{noisy.noise_limit:.1f} dB" in noisy.warning
    assert fitted(4.0).warning is None
    assert fitted(0.0).warning is None
    assert known(check([(np.zeros((8, 8, 3)), np.zeros((8, 8, 3)), None)])).noise_limit == float("inf")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "folder"),
    [("tum", "tum_fr1_xyz"), ("seven_scenes", "seven_scenes_redkitchen"), ("icl_nuim", "icl_nuim_of_kt0")],
)
def test_clean_real_video_raises_no_alarm_at_any_size(name: str, folder: str) -> None:
    image = next(iter(open_dataset(name, path=shared(f"data/{folder}"), stop=1))).image
    for size in ((480, 640), (180, 240), (120, 160)):
        small = camera.resize_image(image, size).astype(np.float32) / 255.0
        found = known(check([(small, small, None)]))
        assert found.noise < 0.5 * MAX_NOISE
        assert found.warning is None


def test_exposure_is_blamed_where_a_gain_and_an_offset_bring_the_render_to_the_image() -> None:
    found = known(check([(picture(), 0.7 * picture() + 0.02, None)]))
    assert found.psnr < 25.0
    assert found.steady_psnr > 60.0
    assert found.warning is not None
    assert "changes of exposure that nobody knows" in found.warning


def test_other_errors_are_told_without_a_guess() -> None:
    found = known(check([(np.roll(picture(), 30, axis=1), picture(), None)]))
    assert found.warning is not None
    assert "motion, blur, wrong poses or too few iterations" in found.warning


def test_pixels_that_do_not_count_say_nothing() -> None:
    """Neither good nor bad: of an image of which two thirds are masked the rest tells what the whole would."""
    noisy = picture() + np.random.default_rng(3).normal(0.0, 20.0 / 255.0, (96, 128, 3)).astype(np.float32)
    image, mask = np.full_like(noisy, 0.5), np.zeros((96, 128), bool)
    mask[:, 40:80] = True
    image[mask] = noisy[mask]
    render = np.where(mask[..., None], 0.7 * picture(), image)  # as the map shows what it was not trained on: anyhow
    parts = 0.7 * picture()[:, 40:80], noisy[:, 40:80], None
    found, expected = known(check([(render, image, mask)])), known(check([parts]))
    assert found.psnr == pytest.approx(expected.psnr)
    assert found.steady_psnr == pytest.approx(expected.steady_psnr)
    assert found.noise == pytest.approx(20.0, rel=0.15)
    assert check([(render, image, np.zeros((96, 128), bool))]) is None
    assert noise_of(image, np.eye(96, 128, dtype=bool)) == 0.0


def test_a_map_is_judged_by_what_it_was_trained_on() -> None:
    """The masked part of a keyframe is not taken for a perfect render."""
    given = rgbd_keyframe(0, pose_on_arc(0.0))
    mask = np.ones(given.image.shape[:2], bool)
    mask[:, : mask.shape[1] // 2] = False
    mapper = OnlineMapper(CONFIG)
    mapper.add_keyframe(replace(given, mask=mask))
    (view,) = mapper.views
    assert view.valid is not None
    render, image = mapper.render(view).color.clamp(0.0, 1.0).numpy(), view.target.numpy()
    assert known(mapper.self_check()).psnr == pytest.approx(psnr(render, image, view.valid.numpy()))
