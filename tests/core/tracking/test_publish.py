"""What goes out of keyframes: each once, and again only what has changed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.publish import Publisher

TOLERANCE = 0.01


@dataclass
class Keyframe:
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    inverse_depth: np.ndarray = field(default_factory=lambda: np.full(40, 0.5))
    triangulated: np.ndarray = field(default_factory=lambda: np.ones(40, bool))
    segment: int = 0

    @property
    def median_depth(self) -> float:
        return float(1.0 / np.median(self.inverse_depth))


class Map:
    def __init__(self, count: int) -> None:
        self.keyframes = {10 * n: Keyframe() for n in range(count)}

    def world_from_cam(self, index: int) -> np.ndarray:
        return self.keyframes[index].pose

    def move(self, index: int, shift: float) -> None:
        self.keyframes[index].pose = geometry.se3_exp(np.array([shift, 0, 0, 0, 0, 0])) @ self.keyframes[index].pose


def published(count: int = 3) -> tuple[Map, Publisher]:
    """All keyframes of a map, in two segments where there is a second one."""
    graph = Map(count)
    publisher = Publisher(graph, TOLERANCE, lambda index: graph.keyframes[index].segment)
    assert publisher.publish_all(sorted(graph.keyframes), settled=True) == tuple(sorted(graph.keyframes))
    return graph, publisher


def test_what_did_not_change_is_not_sent_again() -> None:
    _, publisher = published()
    assert publisher.published == {0, 10, 20}
    assert publisher.corrections() is None


def test_only_what_moved_by_more_than_the_tolerance_is_sent_and_only_once() -> None:
    graph, publisher = published()
    graph.move(10, 3.0 * TOLERANCE)  # of a depth of 2
    graph.move(20, 1.0 * TOLERANCE)
    correction = publisher.corrections()
    assert correction is not None
    assert correction.index.tolist() == [10]
    np.testing.assert_array_equal(correction.world_from_cam, [graph.world_from_cam(10)])
    assert correction.scale.tolist() == [1.0]
    assert publisher.corrections() is None
    graph.move(20, 1.5 * TOLERANCE)  # with what it had moved before, it is enough
    correction = publisher.corrections()
    assert correction is not None
    assert correction.index.tolist() == [20]


def test_a_keyframe_that_turned_is_sent() -> None:
    graph, publisher = published()
    graph.keyframes[0].pose = geometry.se3_exp(np.array([0, 0, 0, 0, 2.0 * TOLERANCE, 0]))
    graph.keyframes[10].pose = geometry.se3_exp(np.array([0, 0, 0, 0, 0.5 * TOLERANCE, 0]))
    correction = publisher.corrections()
    assert correction is not None
    assert correction.index.tolist() == [0]


def test_scales_are_depths_now_over_depths_when_first_published() -> None:
    graph, publisher = published()
    for scale in (2.0, 3.0):
        graph.keyframes[10].inverse_depth = np.full(40, 0.5 / scale)
        correction = publisher.corrections()
        assert correction is not None
        assert correction.index.tolist() == [10]
        assert correction.scale == pytest.approx([scale])


def test_depths_that_are_not_known_say_nothing_of_the_scale() -> None:
    graph, publisher = published()
    known = np.arange(40) < 30
    graph.keyframes[10].triangulated = known
    graph.keyframes[10].inverse_depth = np.where(known, 0.25, 9.0)
    correction = publisher.corrections()
    assert correction is not None
    assert correction.scale == pytest.approx([2.0])
    graph.keyframes[10].triangulated = np.arange(40) < 10  # too few to say anything
    graph.keyframes[10].inverse_depth = np.full(40, 0.1)
    assert publisher.corrections() is None


def test_a_keyframe_that_joined_another_segment_is_sent() -> None:
    graph, publisher = published()
    graph.keyframes[20].segment = 4
    correction = publisher.corrections()
    assert correction is not None
    assert correction.segment is not None
    assert (correction.index.tolist(), correction.segment.tolist()) == ([20], [4])
    assert publisher.corrections() is None
    assert publisher.highest_segment == 0, "it went out as one of segment 0"


def test_in_the_end_everything_is_sent() -> None:
    graph, publisher = published()
    graph.move(10, 0.1 * TOLERANCE)
    correction = publisher.corrections(everything=True)
    assert correction is not None
    assert correction.index.tolist() == [0, 10, 20]
    np.testing.assert_array_equal(correction.world_from_cam, [graph.world_from_cam(n) for n in (0, 10, 20)])


def test_a_keyframe_that_left_the_map_is_not_corrected() -> None:
    graph, publisher = published()
    del graph.keyframes[10]
    correction = publisher.corrections(everything=True)
    assert correction is not None
    assert correction.index.tolist() == [0, 20]


def test_keyframes_are_held_until_the_focal_length_is_settled() -> None:
    graph = Map(3)
    graph.keyframes[10].segment = 2
    publisher = Publisher(graph, TOLERANCE, lambda index: graph.keyframes[index].segment)
    assert publisher.publish_all([0], settled=False) == ()
    assert publisher.publish_all([10], settled=False) == ()
    assert (publisher.held, publisher.published) == ([0, 10], set())
    assert publisher.corrections(everything=True) is None
    assert publisher.publish_all([20], settled=True) == (0, 10, 20)
    assert (publisher.held, publisher.published) == ([], {0, 10, 20})
    assert publisher.highest_segment == 2


def test_a_tracker_with_one_segment_says_none() -> None:
    graph = Map(1)
    publisher = Publisher(graph, TOLERANCE)
    publisher.publish(0)
    correction = publisher.corrections(everything=True)
    assert correction is not None
    assert correction.segment is None


class Lamp:
    """Exposures and vignetting as a tracker knows them."""

    def __init__(self) -> None:
        self.gains: dict[int, float] = {}
        self.vignetting: np.ndarray | None = None

    def exposure(self, index: int) -> np.ndarray | None:
        gain = self.gains.get(index)
        return None if gain is None else gain * np.eye(3, 4, dtype=np.float32)

    def known(self, index: int) -> object:
        return self.gains.get(index)


def test_exposures_go_out_where_a_gray_level_changes_and_back_to_the_identity() -> None:
    graph, lamp = Map(3), Lamp()
    publisher = Publisher(graph, TOLERANCE, light=lamp)
    publisher.publish_all(sorted(graph.keyframes), settled=True)
    graph.move(0, 3.0 * TOLERANCE)
    steady = publisher.corrections()
    assert steady is not None
    assert steady.exposure is None
    lamp.gains = {0: 1.2, 10: 1.001, 20: 0.8}
    lit = publisher.corrections()
    assert lit is not None
    assert lit.index.tolist() == [0, 20]
    assert lit.vignetting is None
    np.testing.assert_allclose(lit.exposure[:, 0, 0], [1.2, 0.8])
    lamp.vignetting = np.array([-0.2, 0.0, 0.0], np.float32)
    darker = publisher.corrections()
    assert darker is not None
    assert darker.index.tolist() == [0, 10, 20]
    np.testing.assert_array_equal(darker.vignetting, lamp.vignetting)
    assert publisher.corrections() is None
    lamp.gains, lamp.vignetting = {}, None
    off = publisher.corrections()
    assert off is not None
    np.testing.assert_array_equal(off.exposure, np.tile(np.eye(3, 4, dtype=np.float32), (3, 1, 1)))
    np.testing.assert_array_equal(off.vignetting, np.zeros(3))
