"""The camera's photometric model: affines of exposure, vignetting, and what is none of a camera."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.photometry import IDENTITY, compose, inverse, is_exposure, is_vignetting, vignetting_factor

AFFINE = np.array([[1.3, 0.1, 0, -0.05], [0, 1.2, 0, 0.02], [0, 0, 0.8, 0.03]], np.float32)
DARK = np.array([-0.3, 0.05, -0.1])
LENS = np.array([60.0, 60.0, 39.5, 29.5])


def test_composing_does_the_first_and_then_the_second_and_the_inverse_undoes_it() -> None:
    color, other = np.array([0.2, 0.5, 0.7]), np.array([[0, 1, 0, 0.1], [1, 0, 0, 0], [0, 0, 2, -0.2]])

    def done(affine: np.ndarray, values: np.ndarray) -> np.ndarray:
        return affine[:, :3] @ values + affine[:, 3]

    np.testing.assert_allclose(done(compose(other, AFFINE), color), done(other, done(AFFINE, color)), atol=1e-7)
    np.testing.assert_allclose(compose(inverse(AFFINE), AFFINE), IDENTITY, atol=1e-7)
    many = np.stack([AFFINE, IDENTITY])
    np.testing.assert_allclose(compose(many, inverse(many)), np.stack([IDENTITY, IDENTITY]), atol=1e-7)


def test_vignetting_is_one_at_the_principal_point_the_polynomial_at_the_corners_and_the_same_at_every_size() -> None:
    factor = vignetting_factor(DARK, LENS, (60, 80))
    assert factor[29:31, 39:41].min() > 0.999
    radius = np.hypot(39.5, 29.5) / np.hypot(40.0, 30.0)
    expected = 1.0 + DARK @ radius ** np.array([2, 4, 6])
    np.testing.assert_allclose(factor[[0, 0, -1, -1], [0, -1, 0, -1]], expected, atol=1e-6)
    twice = vignetting_factor(DARK, scale_intrinsics(LENS, (60, 80), (120, 160)), (120, 160))
    np.testing.assert_allclose(twice.reshape(60, 2, 80, 2).mean(axis=(1, 3)), factor, atol=2e-4)
    off = vignetting_factor(DARK, np.array([60.0, 60.0, 9.5, 29.5]), (60, 80))  # beyond r = 1 it stays
    np.testing.assert_allclose(off[:, -5:], 1.0 + DARK.sum(), atol=1e-6)


@pytest.mark.parametrize("gain", [0.0, 1e-3, 1e3, -1e9, np.nan, np.inf])
def test_what_no_camera_has_is_told(gain: float) -> None:
    assert is_exposure(AFFINE)
    assert is_vignetting(DARK)
    assert not is_exposure(np.diag([1.0, gain, 1.0, 0.0])[:3])
    assert not is_exposure(np.hstack([np.eye(3), np.full((3, 1), 2.0 if gain == 0.0 else gain)])) or gain == 1e-3
    assert not is_vignetting(np.array([0.0, gain or -2.0, 0.0])) or gain == 1e-3
