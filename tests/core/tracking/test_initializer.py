"""Before there is a map: keyframes are tied to each other, solved together, and go where they can't be."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.diagnosis import Diagnosis
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.initializer import InitializationConfig, Initializer
from mvsgs_core.tracking.matching.flow import LucasKanade, Matches
from tests.support.true_maps import exact_matches, image, item, matcher, true_graph, true_pose

FRAMES = (0, 4, 8, 12)
CONFIG = InitializationConfig(min_keyframes=4, max_keyframes=5)


def initializer(config: InitializationConfig = CONFIG) -> Initializer:
    graph = KeyframeGraph(item(0).intrinsics)
    return Initializer(graph, matcher(), config, 1, Diagnosis(0.2, 0.05))


def moving(config: InitializationConfig = CONFIG, frames: tuple[int, ...] = FRAMES) -> Initializer:
    """With keyframes of the room's round, each matched exactly with the one before."""
    made, true = initializer(config), true_graph(*frames)
    made.add(image(frames[0]), 3)
    for before, index in pairwise(frames):
        made.add(image(index), 3, exact_matches(true, before, true_pose(index)))
    return made


class Nothing:
    """A flow that finds no point."""

    needs_color = False

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        return Matches(np.full((len(points), 2), np.nan), np.zeros(len(points)))


def resting(count: int) -> Initializer:
    """With the same view again and again."""
    made = initializer()
    made.add(image(0, 0), 0)
    for index in range(1, count):
        view = image(0, index)
        made.add(view, 0, unmoved(view))
    return made


def unmoved(view: TrackingImage) -> Matches:
    return Matches(view.cells.points.astype(np.float64), view.cells.textured.astype(np.float64))


def test_keyframes_are_tied_both_ways_to_those_before() -> None:
    made = moving(InitializationConfig(min_keyframes=9, recent=2))
    near = {(a, b) for a in FRAMES for b in FRAMES if a != b and abs(a - b) <= 8}
    assert set(made.graph.edges) == near
    true = true_graph(*FRAMES)
    for source, to in near:
        edge = made.graph.edges[source, to]
        expected, _ = true.predict_pose(source, true_pose(to))
        seen = edge.weight > 0
        assert np.median(np.linalg.norm(expected - edge.target.T, axis=1)[seen]) < 0.5, (source, to)


def torn(before: int, frames: tuple[int, ...], config: InitializationConfig = CONFIG) -> Initializer:
    """Hardly any points are found between one of these keyframes and that before it: no fourth of the textured ones."""
    made, true = initializer(config), true_graph(*frames)
    made.add(image(frames[0]), 3)
    for last, index in pairwise(frames):
        found = exact_matches(true, last, true_pose(index))
        few = np.cumsum(found.alive) <= (29 if index == before else np.inf)
        made.matcher.flow = Nothing() if index == before else LucasKanade()
        made.add(image(index), 3, Matches(found.target, np.where(few, found.weight, 0.0)))
    return made


def test_keyframes_that_nothing_ties_to_the_newest_are_no_part_of_a_start() -> None:
    made = torn(8, (0, 4, 8, 12, 16))
    assert not made.initialize(), "three of four that are needed"
    assert made.waiting == [8, 12, 16]
    assert sorted(made.graph.keyframes) == [8, 12, 16]
    assert list(made.diagnosis.attempts) == ["matches do not tie the keyframes"]
    true = true_graph(16)
    made.add(image(20), 3, exact_matches(true, 16, true_pose(20)))
    assert made.initialize()
    assert sorted(made.graph.keyframes) == [8, 12, 16, 20]


@pytest.mark.parametrize(("before", "kept"), [(16, [0, 4, 8, 12]), (4, [4, 8, 12, 16])])
def test_at_the_end_of_a_stream_the_most_that_are_tied_make_the_map(before: int, kept: list[int]) -> None:
    made = torn(before, (0, 4, 8, 12, 16))
    assert made.initialize(forced=True)
    assert sorted(made.graph.keyframes) == kept


def test_enough_keyframes_are_solved_and_become_the_map() -> None:
    made = moving()
    assert made.waiting == list(FRAMES)
    assert made.initialize()
    assert made.waiting == []
    graph = made.graph
    assert {keyframe.segment for keyframe in graph.keyframes.values()} == {3}
    found = np.stack([graph.world_from_cam(index) for index in FRAMES])
    true = np.stack([geometry.inverse(true_pose(index)) for index in FRAMES])
    similarity = geometry.umeyama(found[:, :3, 3], true[:, :3, 3])
    length = np.linalg.norm(true[-1, :3, 3] - true[0, :3, 3])
    errors = np.linalg.norm(similarity.apply(found[:, :3, 3]) - true[:, :3, 3], axis=1)
    assert errors.max() < 0.02 * length
    depths = true_graph(*FRAMES)
    for index in FRAMES:
        keyframe = graph.keyframes[index]
        ratio = similarity.scale * depths.keyframes[index].inverse_depth / keyframe.inverse_depth
        assert keyframe.triangulated.mean() > 0.3
        assert abs(np.median(ratio[keyframe.triangulated]) - 1.0) < 0.03


def test_what_kept_an_earlier_segment_from_starting_is_no_reason() -> None:
    made = torn(8, (0, 4, 8, 12, 16))
    made.initialize()
    made.abandon()
    assert made.diagnosis.attempts
    assert made.diagnosis.max_waiting == 5
    made.add(image(20), 4)
    assert made.diagnosis.attempts == {}
    assert made.diagnosis.max_waiting == 1


def test_fewer_keyframes_are_not_tried() -> None:
    made = moving(frames=FRAMES[:3])
    assert not made.initialize()
    assert made.waiting == list(FRAMES[:3])
    assert made.diagnosis.attempts == {}
    assert made.initialize(forced=True), "the end of the stream does with three"


def test_a_resting_camera_gives_no_map_and_the_oldest_keyframe_goes() -> None:
    made = resting(5)
    assert not made.initialize()
    assert made.waiting == [1, 2, 3, 4]
    assert sorted(made.graph.keyframes) == [1, 2, 3, 4]
    assert all({a, b} <= {1, 2, 3, 4} for a, b in made.graph.edges)
    assert list(made.diagnosis.attempts) == ["no parallax"]
    np.testing.assert_array_equal(made.graph.keyframes[4].cam_from_world, np.eye(4))


def test_what_is_abandoned_leaves_nothing_behind() -> None:
    made = moving()
    made.abandon()
    assert made.waiting == []
    assert made.graph.keyframes == {}
    assert made.graph.edges == {}


@pytest.mark.parametrize(("since", "flow"), [(0, 0.035), (20, 0.0175), (400, 0.035 / 3)])
def test_a_slow_camera_makes_keyframes_earlier(since: int, flow: float) -> None:
    assert initializer().flow(since) == pytest.approx(flow)


@pytest.mark.parametrize(("found", "tied"), [(0.2, True), (0.1, False)])
def test_few_matches_are_edges_where_the_scale_is_open_without(found: float, tied: bool) -> None:
    made, true = initializer(), true_graph(*FRAMES)
    made.matcher.flow = Nothing()
    made.add(image(FRAMES[0]), 3)
    for before, index in pairwise(FRAMES):
        all_of_them = exact_matches(true, before, true_pose(index))
        textured = image(before).cells.textured
        few = np.cumsum(all_of_them.alive) <= found * textured.sum()
        made.add(image(index), 3, Matches(all_of_them.target, np.where(few, all_of_them.weight, 0.0)))
    assert not made.graph.edges, "fewer than a quarter"
    made.initialize()
    assert set(made.graph.edges) == (set(pairwise(FRAMES)) if tied else set())
    assert made.waiting == (list(FRAMES) if tied else [FRAMES[-1]])
    assert not made._weak
