"""A camera that zooms is told of: nothing else shows it, and one focal length for all frames bends the map."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.datasets.lens import guess_lens
from mvsgs_core.tracking.estimation.zoom import ALONE, CLEAR, PART, Part, Zoom, clear_zoom, find_zoom
from mvsgs_core.tracking.tracker import Tracker
from tests.support.sequences import members_of, synthetic, tracked_room
from tests.support.shared_data import shared

pytestmark = pytest.mark.slow

FOCAL = Tracker().config.focal


def zoomed(item: Item, times: float) -> Item:
    (height, width), (x, y) = item.image.shape[:2], item.intrinsics[2:]
    turn = np.array([[times, 0.0, (1.0 - times) * x], [0.0, times, (1.0 - times) * y]])
    image = cv2.warpAffine(item.image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return replace(item, image=image)


def test_a_zoom_while_it_films_is_told_and_when() -> None:
    tracker, times = Tracker(), 1.3
    items = [zoomed(item, 1.0 + (times - 1.0) * np.clip((n - 35) / 10, 0, 1)) for n, item in enumerate(room())]
    for item in items:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    list(tracker.finish())
    (warning,) = [w for w in tracker.stats.warnings if "zoomed" in w]
    assert "poses and map are bent" in warning
    assert "px in the original images" in warning
    (first, last), (later, end) = (tuple(map(int, found)) for found in re.findall(r"frames (\d+) to (\d+)", warning))
    assert first < last < later < end
    assert first < 35
    assert end > 45
    values = tracker.stats.values
    assert values["zoom"] == pytest.approx(times, rel=0.15)
    assert "zoomed" in values["focal_doubt"]
    assert not any("contradict" in w or "all keyframes" in w for w in tracker.stats.warnings), "nothing else is blamed"


def room() -> tuple[Item, ...]:
    return synthetic(frames=80)


def test_a_camera_that_does_not_zoom_is_not_said_to() -> None:
    tracker = tracked_room()[0]
    graph, members = tracker.session.graph, members_of(tracker)
    assert len(members) >= 2 * PART
    before = {index: graph.keyframes[index].cam_from_world.copy() for index in members}
    assert find_zoom(graph, members, FOCAL, 1) is None
    assert "zoom" not in tracker.stats.values
    assert find_zoom(graph, members[: 2 * PART - 1], FOCAL, 1) is None, "too few to tell"
    assert find_zoom(graph, [-1 - n for n in range(2 * PART)], FOCAL, 1) is None, "of a map that it goes on with"
    assert all(np.array_equal(graph.keyframes[index].cam_from_world, pose) for index, pose in before.items())


@pytest.mark.parametrize("guessed", [True, False])
def test_a_camera_that_moves_straight_ahead_at_first_is_not_said_to_zoom(guessed: bool) -> None:
    """Its first keyframes want 1.2 times the focal length of the others: by 3 deviations, and there are no more."""
    tracker = Tracker()
    for item in open_dataset("tum", path=shared("data/tum_fr1_xyz"), stride=2, stop=48):
        guess = np.array(guess_lens(item.image.shape[:2]).intrinsics)
        tracker.add(item.index, item.timestamp, item.image, guess if guessed else item.intrinsics, guessed)
    list(tracker.finish())
    assert "zoom" not in tracker.stats.values
    assert not any("zoomed" in warning for warning in tracker.stats.warnings)


def parts(*factors: float, certain: bool = True) -> list[Part]:
    return [Part((10 * n, 10 * n + 9), factor, 0.01, certain) for n, factor in enumerate(factors)]


def test_two_parts_alone_must_be_surer() -> None:
    sigma = Zoom(*parts(1.0, 1.0)).sigma
    clear, sure, surer = np.exp([0.5 * (CLEAR + ALONE) * sigma, 1.1 * ALONE * sigma, 2.1 * ALONE * sigma])
    assert clear_zoom(parts(1.0, clear)) is None
    assert clear_zoom(parts(1.0, sure)) is not None
    assert clear_zoom(parts(1.0, sure, certain=False)) is None
    assert clear_zoom(parts(1.0, surer, certain=False)) is not None


def test_two_other_parts_are_needed_that_say_the_same() -> None:
    clear = np.exp(0.5 * (CLEAR + ALONE) * Zoom(*parts(1.0, 1.0)).sigma)
    assert clear_zoom(parts(1.0, 1.0, 1.0, clear, certain=False)) is None, (
        "one that differs from all may be wrong alone"
    )
    assert clear_zoom(parts(1.0, 1.0, clear, clear, certain=False)) is not None
    assert clear_zoom(parts(1.0, clear, clear, 1.0, certain=False)) is None, "it would have zoomed in and out"
    assert clear_zoom([]) is None
