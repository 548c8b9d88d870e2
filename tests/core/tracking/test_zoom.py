"""A camera that zooms is told of: nothing else shows it, and one focal length for all frames bends the map."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.tracking.estimation.zoom import PART, find_zoom
from mvsgs_core.tracking.tracker import Tracker
from tests.support.sequences import synthetic, tracked_room

pytestmark = pytest.mark.slow

PROBE = Tracker().config.focal.probe


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
    assert f"px in images of {items[0].image.shape[1]}x{items[0].image.shape[0]}" in warning
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
    graph, members = tracker.session.graph, tracker.session.members
    assert len(members) >= 2 * PART
    before = {index: graph.keyframes[index].cam_from_world.copy() for index in members}
    assert find_zoom(graph, members, PROBE, 1) is None
    assert "zoom" not in tracker.stats.values
    assert find_zoom(graph, members[: 2 * PART - 1], PROBE, 1) is None, "too few to tell"
    assert find_zoom(graph, [-1 - n for n in range(2 * PART)], PROBE, 1) is None, "of a map that it goes on with"
    assert all(np.array_equal(graph.keyframes[index].cam_from_world, pose) for index, pose in before.items())
