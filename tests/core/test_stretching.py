"""Gray levels of dark and hazy images are spread to where others have them."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.camera import CONTRAST, stretching

RAMP = np.tile(np.arange(100, dtype=np.uint8), (50, 1))  # 0 to 99


def contrast(image: np.ndarray) -> float:
    low, high = np.quantile(image, [0.01, 0.99])
    return float(high - low)


def test_an_image_with_contrast_stays() -> None:
    assert stretching(2 * RAMP) is None
    assert stretching(RAMP + np.uint8(120)) is None


@pytest.mark.parametrize("image", [RAMP // 8, RAMP // 8 + np.uint8(180), RAMP // 3 + np.uint8(40)])
def test_a_dark_one_and_a_hazy_one_get_it(image: np.ndarray) -> None:
    table = stretching(image)
    assert table is not None
    assert contrast(table[image]) == pytest.approx(CONTRAST, rel=0.15)
    assert (np.diff(table.astype(int)) >= 0).all()
    assert table[image].min() > 0


def lamp(image: np.ndarray, part: float) -> np.ndarray:
    """The image with a light in it that covers so much of it."""
    lit = image.copy()
    lit[:, : round(part * image.shape[1])] = 255
    return lit


@pytest.mark.parametrize("part", [0.01, 0.02, 0.05, 0.07])
def test_a_light_in_a_dark_place_changes_little_of_the_rest(part: float) -> None:
    dark = np.random.default_rng(0).permutation((RAMP // 4).ravel()).reshape(RAMP.shape)
    table, without = stretching(lamp(dark, part)), stretching(dark)
    assert table is not None
    assert without is not None
    np.testing.assert_allclose(table[:25].astype(int), without[:25].astype(int), atol=3)


def test_a_light_in_a_place_that_is_not_dark_changes_nothing() -> None:
    for image in (RAMP // 2 + np.uint8(40), 2 * RAMP):
        assert stretching(lamp(image, 0.05)) is None


def test_a_black_one_and_a_flat_one_show_nothing() -> None:
    assert stretching(RAMP // 15) is None
    assert stretching(lamp(RAMP // 15, 0.03)) is None
    assert stretching(np.full((50, 100), 90, np.uint8) + RAMP // 50) is None


def test_what_is_masked_does_not_count() -> None:
    seen = np.ones(RAMP.shape, bool)
    seen[-5:] = False
    with_text = RAMP // 8
    with_text[-5:] = 255
    assert stretching(with_text) is None
    table, without = stretching(with_text, seen), stretching((RAMP // 8)[:-5])
    assert table is not None
    assert without is not None
    np.testing.assert_array_equal(table, without)
    assert stretching(with_text, np.zeros_like(seen)) is None
