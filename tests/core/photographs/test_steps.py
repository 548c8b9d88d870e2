"""Whether pictures step wide."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.sequence import ImageSequence
from mvsgs_core.photographs.steps import ENOUGH, MORE, PAIRS, Step, Steps, chosen_pairs, measure_steps
from tests.support.shared_data import shared

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
    small, lost = Step(0.95, np.radians(0.5), 3.0), Step(0.0, 0.0, 0.0)
    assert not Steps([small] * 9 + [lost]).wide
    assert Steps([small] * 5 + [lost] * 4).wide
    assert "1 of 10 steps between pictures are wide (95 % of points found, 0.5 degrees" in str(
        Steps([small] * 9 + [lost])
    )


@pytest.mark.parametrize(("count", "pairs"), [(0, 0), (1, 0), (2, 1), (9, 8), (1000, PAIRS + MORE)])
def test_pairs_are_spread_over_all(count: int, pairs: int) -> None:
    found = chosen_pairs(count)
    assert len(found) == pairs
    assert all(0 <= n < count - 1 for n in found)
    assert len(set(found)) == pairs
    spread = found[:PAIRS]
    assert spread == sorted(spread)
    assert not found or (spread[0] == 0 and spread[-1] == count - 2)


def steps_of(pictures: list[np.ndarray]) -> Steps:
    return measure_steps((pictures[n], pictures[n + 1], INTRINSICS) for n in chosen_pairs(len(pictures)))


@pytest.mark.parametrize("times", [2, 3, 5])
def test_photographs_that_were_taken_several_times_are_photographs(times: int) -> None:
    """As with a bracket of exposures: the camera stands in most steps, and each of the others is wide."""
    scenes = [texture(n) for n in range(12)]
    found = steps_of([cv2.convertScaleAbs(scene, alpha=0.6 + 0.2 * n) for scene in scenes for n in range(times)])
    assert found.wide
    assert all(step.lost for step in found.moving)
    assert f"; in {len(found.steps) - len(found.moving)} others nothing moves" in str(found)


@pytest.mark.parametrize("count", [3, 5])
def test_few_photographs_with_a_copy_are_photographs(count: int) -> None:
    scenes = [texture(n) for n in range(count)]
    assert steps_of(scenes[:1] + scenes).wide


def test_a_video_of_a_camera_that_stands_is_a_video() -> None:
    scene = texture(0)
    assert not steps_of([scene] * 40).wide
    assert not steps_of([scene] * 30 + [turned(scene, 1.0 * n) for n in range(10)]).wide
    assert not steps_of([scene] * 10 + [texture(n) for n in range(1, 5)]).wide  # it ends with something else


@pytest.mark.parametrize("still", [30, 120, 270])
def test_a_real_video_with_a_still_start_is_a_video(still: int) -> None:
    sequence = open_dataset("tum", path=shared("data/tum_fr1_xyz"))
    assert isinstance(sequence, ImageSequence)
    for start in (0, 80, 120):  # fast hands: three of the last eleven steps are wide
        records = sequence.records[start : start + 30]
        slower = open_dataset("tum", path=shared("data/tum_fr1_xyz"))
        assert isinstance(slower, ImageSequence)
        slower.records = records[:1] * still + records
        steps = measure_steps(slower.successive(chosen_pairs(len(slower)), ENOUGH))
        assert steps.moving
        assert not steps.wide
