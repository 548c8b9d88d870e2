"""Exposure of frames between keyframes."""

from __future__ import annotations

import numpy as np

from mvsgs_core.evaluation.exposure import between_keyframes
from mvsgs_core.mapping.exposure import IDENTITY


def test_exposure_is_linear_between_keyframes_and_holds_beyond_them() -> None:
    affines = np.stack([IDENTITY, 2.0 * IDENTITY])
    affines[1, 2, 3] = 0.5
    found = between_keyframes(np.array([-1.0, 0.0, 0.25, 1.0, 9.0]), np.array([0.0, 1.0]), affines)
    assert found is not None
    np.testing.assert_allclose(found[:, 0, 0], [1.0, 1.0, 1.25, 2.0, 2.0])
    np.testing.assert_allclose(found[:, 2, 3], [0.0, 0.0, 0.125, 0.5, 0.5])
    np.testing.assert_array_equal(found[:, 0, 1:], 0.0)


def test_a_map_without_exposures_has_none() -> None:
    assert between_keyframes(np.arange(3.0), np.arange(2.0), np.stack([IDENTITY, IDENTITY])) is None
    assert between_keyframes(np.arange(3.0), np.empty(0), np.empty((0, 3, 4))) is None
