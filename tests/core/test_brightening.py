"""How much darker an image is than what is measured in gray levels expects."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.camera import BRIGHT, brightening

RAMP = np.tile(np.arange(100, dtype=np.uint8), (50, 1))  # 0 to 99


def test_a_bright_image_stays() -> None:
    assert brightening(2 * RAMP) == 1.0
    one_window = np.zeros((50, 100), np.uint8)
    one_window[:10, :10] = 200
    assert brightening(one_window) == 1.0


def test_a_dark_one_is_brought_to_where_its_brightest_part_is_bright() -> None:
    gain = brightening(RAMP)
    assert gain == pytest.approx(BRIGHT / 98.0, rel=0.02)
    assert brightening(RAMP // 4) == pytest.approx(BRIGHT / 24.0, rel=0.05)


def test_a_black_one_shows_nothing() -> None:
    assert brightening(np.full((50, 100), 4, np.uint8)) == 1.0


def test_a_bright_text_that_is_masked_does_not_count() -> None:
    seen = np.ones(RAMP.shape, bool)
    seen[-5:] = False
    with_text = RAMP.copy()
    with_text[-5:] = 255
    assert brightening(with_text) == 1.0
    assert brightening(with_text, seen) == pytest.approx(BRIGHT / 98.0, rel=0.02)
    assert brightening(with_text, np.zeros_like(seen)) == 1.0
