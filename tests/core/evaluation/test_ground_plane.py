"""Where up is, of a camera that turned and of one that did not."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.evaluation.ground_plane import ground_axes, up_direction
from mvsgs_core.geometry import so3_exp

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # looks along y of a world whose z is up


def held(pitch: float, yaws: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) of a camera that looks down by `pitch` and turns, held level but for a trembling hand."""
    rng = np.random.default_rng(0)
    shaking = so3_exp(rng.normal(0.0, 0.02, (len(yaws), 3)))
    return (
        np.stack([so3_exp(np.array([0, 0, yaw])) @ LEVEL @ so3_exp(np.array([-pitch, 0, 0])) for yaw in yaws]) @ shaking
    )


@pytest.mark.parametrize("pitch", [0.0, 0.5, 1.3])
def test_up_is_normal_to_the_x_axes_of_a_camera_that_turned(pitch: float) -> None:
    tilt = so3_exp(np.array([0.4, -0.7, 0.2]))  # the map's frame is any
    found = up_direction(tilt @ held(pitch, np.linspace(0.0, 2.0, 40)))
    assert np.degrees(np.arccos(found @ tilt[:, 2])) < 1.5


def test_up_in_the_image_is_up_where_the_camera_did_not_turn() -> None:
    assert np.degrees(np.arccos(up_direction(held(0.0, np.zeros(20)))[2])) < 1.5


def test_axes_are_right_and_ahead_of_the_first_view() -> None:
    right, ahead = ground_axes(held(0.3, np.linspace(0.0, 2.0, 40)))
    assert right @ [1.0, 0.0, 0.0] > 0.99
    assert ahead @ [0.0, 1.0, 0.0] > 0.99
    assert abs(right @ ahead) < 1e-9


def test_what_is_up_in_the_image_of_a_camera_that_looks_down_is_ahead() -> None:
    _, ahead = ground_axes(held(1.5, np.linspace(0.0, 2.0, 40)))
    assert ahead @ [0.0, 1.0, 0.0] > 0.99
