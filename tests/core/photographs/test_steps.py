"""Whether pictures step wide."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvsgs_core.photographs.steps import PAIRS, Step, Steps, chosen_pairs, measure_steps

INTRINSICS = np.array([300.0, 300.0, 159.5, 119.5])


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(cv2.normalize(smooth, np.empty(0), 0, 255, cv2.NORM_MINMAX))


def turned(image: np.ndarray, degrees: float) -> np.ndarray:
    """As the same camera sees it that turned about its vertical axis."""
    camera = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
    turn = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    return np.asarray(cv2.warpPerspective(image, camera @ turn @ np.linalg.inv(camera), (320, 240)))


def test_pictures_of_nothing_in_common_are_wide_and_a_turn_is_not() -> None:
    first = texture(0)
    apart = measure_steps([(first, texture(1), INTRINSICS)])
    assert apart.wide
    assert apart.steps[0].lost
    turn = measure_steps([(first, turned(first, 1.0), INTRINSICS)])
    assert not turn.wide
    assert turn.steps[0].found > 0.8


def test_pictures_of_nothing_tell_nothing() -> None:
    blank = np.full((240, 320, 3), 128, np.uint8)
    found = measure_steps([(blank, texture(0), INTRINSICS)] * 3)
    assert found.steps == []
    assert not found.wide


def test_one_step_that_is_lost_makes_a_video_no_photographs() -> None:
    small, lost = Step(0.95, np.radians(0.5)), Step(0.0, 0.0)
    assert not Steps([small] * 9 + [lost]).wide
    assert Steps([small] * 5 + [lost] * 4).wide
    assert "1 of 10 steps between pictures are wide (95 % of points found, 0.5 degrees" in str(
        Steps([small] * 9 + [lost])
    )


@pytest.mark.parametrize(("count", "pairs"), [(0, 0), (1, 0), (2, 1), (9, 8), (1000, PAIRS)])
def test_pairs_are_spread_over_all(count: int, pairs: int) -> None:
    found = chosen_pairs(count)
    assert len(found) == pairs
    assert all(0 <= n < count - 1 for n in found)
    assert not found or (found[0] == 0 and found[-1] == count - 2)
