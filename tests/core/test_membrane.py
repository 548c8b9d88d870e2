"""A sheet through known pixels: linear in its values, goes on beyond them, breaks at the image's edges."""

from __future__ import annotations

import numpy as np

from mvsgs_core.membrane import membrane


def test_the_nearest_known_values_go_on() -> None:
    weight = np.zeros((20, 60))
    weight[:, :30] = 1.0
    sheet = membrane(np.where(weight > 0, 3.0, 99.0), weight, np.zeros((20, 60), np.uint8), 200.0, 5.0)
    np.testing.assert_allclose(sheet, 3.0, rtol=1e-4)


def test_the_sheet_breaks_at_an_edge_of_the_image() -> None:
    guide = np.zeros((20, 60, 3), np.uint8)
    guide[:, 30:] = 200
    values = np.where(np.arange(60) < 30, 1.0, 2.0)[None].repeat(20, axis=0)
    weight = np.zeros((20, 60))
    weight[:, :20] = weight[:, 40:] = 1.0
    sheet = membrane(values, weight, guide, 200.0, 5.0)
    np.testing.assert_allclose(sheet, values, atol=0.01)
    smooth = membrane(values, weight, np.zeros_like(guide), 200.0, 5.0)
    assert 1.2 < smooth[10, 30] < 1.8


def test_without_any_weight_there_is_nothing() -> None:
    assert not membrane(np.ones((8, 8)), np.zeros((8, 8)), np.zeros((8, 8), np.uint8), 200.0, 5.0).any()
