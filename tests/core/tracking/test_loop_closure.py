"""Loops: a ring of cameras whose drift is known, before and after; segments that are joined; false matches."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.pose_graph import PoseGraphSolution
from mvsgs_core.tracking.graph import Edge, Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.places import loop_closure, thinning
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.places.localization import Localization
from mvsgs_core.tracking.places.loop_closure import LoopCloser, LoopConfig
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.steps import whole
from tests.support.true_maps import exact_matches, matcher, shuffled, true_graph, true_keyframe

COUNT = 24  # cameras of the ring, 3 from its center
AROUND = (*range(0, 300, 20), 298)  # keyframes of the room's round: the last one sees what the first one saw
NO_EDGE = Edge(np.zeros((2, 0)), np.zeros(0), np.zeros((2, 0)), 1.0)  # that says nothing but that it is there


def closer(graph: KeyframeGraph, config: LoopConfig | None = None) -> LoopCloser:
    """With all keyframes to be found but the newest."""
    made = LoopCloser(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), Retrieval(), config or LoopConfig())
    for index in sorted(graph.keyframes)[:-1]:
        made.add(index)
    return made


def ring() -> KeyframeGraph:
    """Cameras on a circle with their true poses and depths; their images say nothing."""
    random = np.random.default_rng(0)
    graph = KeyframeGraph(np.array([80.0, 80.0, 47.5, 31.5]))
    for n in range(COUNT):
        world = np.eye(4)
        world[:3, :3] = geometry.so3_exp(np.array([0.0, 2.0 * np.pi * n / COUNT, 0.0]))
        world[:3, 3] = world[:3, :3] @ [0.0, 0.1 * np.sin(n), 3.0]
        image = TrackingImage(n, n / 10.0, random.integers(0, 256, (64, 96), np.uint8))
        inverse_depth = random.uniform(0.2, 0.8, len(image.cells.points))
        graph.add(Keyframe(image, geometry.inverse(world), inverse_depth, 1e3 / inverse_depth**2, 0))
    return graph


def drifted(true: KeyframeGraph, growth: float, turn: float = 0.0) -> KeyframeGraph:
    """The same as an odometer sees it: each step, and the depths with it, `growth` times the one before, and turned."""
    graph = KeyframeGraph(true.intrinsics)
    order, unit, pose = sorted(true.keyframes), 1.0, np.eye(4)
    for before, index in zip([None, *order], order):
        keyframe = true.keyframes[index]
        if before is None:
            pose = keyframe.cam_from_world
        else:
            step = keyframe.cam_from_world @ true.world_from_cam(before)
            step[:3, 3] *= unit
            pose = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, turn, 0.0])) @ step @ pose
            unit *= growth
        depths, information = keyframe.inverse_depth / unit, keyframe.information * unit**2
        graph.add(replace(keyframe, cam_from_world=pose, inverse_depth=depths, information=information))
    return graph


def between(true: KeyframeGraph, graph: KeyframeGraph, source: int, to: int) -> tuple[PlaceMatch, int, float]:
    """What geometric verification would say of keyframe `source` in image `to`: the truth, in the unit of `source`."""
    unit_source, unit_to = (float(np.median(units(true, graph)[n])) for n in (source, to))
    relative = true.keyframes[to].cam_from_world @ true.world_from_cam(source)
    matches = exact_matches(true, source, true.keyframes[source].cam_from_world)
    relative[:3, 3] *= unit_source
    pose = relative @ graph.keyframes[source].cam_from_world
    return PlaceMatch(source, matches, Localization(pose, 1.0)), to, unit_to / unit_source


def units(true: KeyframeGraph, graph: KeyframeGraph) -> dict[int, np.ndarray]:
    """By keyframe: its depths over the true ones."""
    return {n: true.keyframes[n].inverse_depth / k.inverse_depth for n, k in graph.keyframes.items()}


def errors(true: KeyframeGraph, graph: KeyframeGraph) -> tuple[float, float]:
    """Largest position error after Sim(3) alignment, and the largest ratio of two keyframes' units."""
    order = sorted(graph.keyframes)
    found, wanted = (np.stack([g.world_from_cam(n)[:3, 3] for n in order]) for g in (graph, true))
    aligned = geometry.umeyama(found, wanted).apply(found)
    ratios = [float(np.median(u)) for u in units(true, graph).values()]
    return float(np.linalg.norm(aligned - wanted, axis=1).max()), max(ratios) / min(ratios)


def state(graph: KeyframeGraph) -> list[np.ndarray]:
    return [a.copy() for k in graph.keyframes.values() for a in (k.cam_from_world, k.inverse_depth, k.information)]


def test_a_closed_loop_takes_a_steady_drift_of_scale_away() -> None:
    """The pose graph shares the error evenly among the steps, which is the truth here."""
    true = ring()
    graph = drifted(true, 1.01)
    position, ratio = errors(true, graph)
    assert position > 0.2
    assert ratio == pytest.approx(1.01 ** (COUNT - 1))
    certain = [k.information * k.inverse_depth**2 for k in graph.keyframes.values()]
    closure = closer(graph).close(*between(true, graph, 0, COUNT - 1))
    assert (closure.source, closure.to) == (0, COUNT - 1)
    assert closure.moved
    assert closure.joined is None
    assert not closure.failure
    position, ratio = errors(true, graph)
    assert position < 0.03
    assert ratio < 1.01
    assert (0, COUNT - 1) in graph.edges
    for keyframe, before in zip(graph.keyframes.values(), certain):  # what was known of the depths still is
        np.testing.assert_allclose(keyframe.information * keyframe.inverse_depth**2, before)
        np.testing.assert_allclose(
            keyframe.cam_from_world[:3, :3] @ keyframe.cam_from_world[:3, :3].T, np.eye(3), atol=1e-9
        )


def test_a_closed_loop_takes_drift_of_direction_and_scale_down() -> None:
    true = ring()
    graph = drifted(true, 0.99, turn=0.01)
    position, ratio = errors(true, graph)
    closer(graph).close(*between(true, graph, 0, COUNT - 1))
    after, ratio_after = errors(true, graph)
    assert after < 0.15 * position
    assert ratio_after - 1.0 < 0.1 * (ratio - 1.0)


def test_the_maps_unit_does_not_matter() -> None:
    positions = []
    for unit in (1.0, 1000.0):
        true = ring()
        true.rescale(true.keyframes, unit)
        graph = drifted(true, 0.99, turn=0.01)
        assert closer(graph).close(*between(true, graph, 0, COUNT - 1)).moved
        positions.append(np.stack([graph.world_from_cam(n)[:3, 3] / unit for n in graph.keyframes]))
    np.testing.assert_allclose(positions[0], positions[1], atol=1e-4)


def test_edges_of_the_graph_hold_the_ring_together() -> None:
    """Two halves, each rigid by its edges: the drift between them is all in one step, and goes where nothing holds."""
    true = ring()
    graph = drifted(true, 1.01)
    plain = drifted(true, 1.01)
    for a in range(COUNT // 2):
        for b in range(a + 2, COUNT // 2):
            graph.edges[a, b] = NO_EDGE
    for each in (graph, plain):
        closer(each).close(*between(true, each, 0, COUNT - 1))
    spread = [np.log([float(np.median(units(true, g)[n])) for n in (0, COUNT // 2 - 1)]) for g in (graph, plain)]
    steps = [abs(float(s[1] - s[0])) for s in spread]
    assert steps[0] > 3.0 * steps[1], "what edges hold is not bent"


def test_a_step_that_no_match_ties_takes_the_loops_error() -> None:
    """As where the camera was lost and found again: what lies between two such keyframes was never measured."""
    true, gap = ring(), COUNT // 2
    graph = drifted(true, 1.0)
    graph.edges.update({(n, n + 1): NO_EDGE for n in range(COUNT - 1) if n != gap})
    shift = geometry.se3_exp(np.array([0.3, 0.1, -0.2, 0.0, 0.05, 0.0]))
    for n in range(gap + 1, COUNT):
        graph.keyframes[n].cam_from_world = graph.keyframes[n].cam_from_world @ shift
    position, _ = errors(true, graph)
    assert position > 0.1
    closer(graph).close(*between(true, graph, 0, COUNT - 1))
    assert errors(true, graph)[0] < 0.02 * position


def test_a_loop_that_the_map_agrees_with_only_adds_an_edge() -> None:
    graph = ring()
    before = state(graph)
    closure = closer(graph).close(*between(graph, graph, 0, COUNT - 1))
    assert not closure.moved
    assert not closure.failure
    assert (0, COUNT - 1) in graph.edges
    for a, b in zip(before, state(graph)):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("shift", "turn", "scale"), [(0.05, 0.0, 1.0), (0.0, 0.04, 1.0), (0.0, 0.0, 1.08)])
def test_each_kind_of_disagreement_moves_the_map(shift: float, turn: float, scale: float) -> None:
    true = ring()
    unit = true.keyframes[COUNT - 1].median_depth
    for factor, moved in ((1.0, True), (0.5, False)):
        graph = drifted(true, 1.0)
        found, _, _ = between(true, graph, 0, COUNT - 1)
        off = geometry.se3_exp(factor * np.array([shift * unit, 0.0, 0.0, 0.0, turn, 0.0]))
        found = replace(found, localization=Localization(off @ found.localization.cam_from_world, 1.0))
        assert closer(graph).close(found, COUNT - 1, scale**factor).moved == moved


@pytest.mark.parametrize(("failure", "said"), [("the matrix is singular", "singular"), ("", "not finite")])
def test_a_loop_that_cannot_be_closed_changes_nothing_and_says_why(
    failure: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = ring()
    graph = drifted(true, 1.01)
    broken = PoseGraphSolution(np.full((COUNT, 4, 4), np.nan), 1.0, 1.0, 3, failure)
    monkeypatch.setattr(loop_closure, "solve_thinned", lambda *_: broken)
    before = state(graph)
    closure = closer(graph).close(*between(true, graph, 0, COUNT - 1))
    assert said in closure.failure
    assert not closure.moved
    assert not graph.edges
    for a, b in zip(before, state(graph)):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("source", "to"), [(1, COUNT - 2), (COUNT - 2, 1)])
def test_two_segments_become_one_map_with_the_frame_and_unit_of_the_older(source: int, to: int) -> None:
    """The second half of the ring lies anywhere, in a unit of its own; either half may be found from the other."""
    true, graph = ring(), ring()
    half, unit = COUNT // 2, 3.7
    away = geometry.se3_exp(np.array([5.0, -2.0, 1.0, 0.3, -1.0, 0.5]))
    for n in range(half, COUNT):
        keyframe = graph.keyframes[n]
        pose = keyframe.cam_from_world.copy()
        pose[:3, 3] *= unit
        graph.add(
            replace(
                keyframe,
                cam_from_world=pose @ away,
                inverse_depth=keyframe.inverse_depth / unit,
                information=keyframe.information * unit**2,
                segment=1,
            )
        )
    closure = closer(graph).close(*between(true, graph, source, to))
    assert closure.joined == 1
    assert closure.moved
    assert {k.segment for k in graph.keyframes.values()} == {0}
    for n, keyframe in true.keyframes.items():
        np.testing.assert_allclose(graph.keyframes[n].cam_from_world, keyframe.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(graph.keyframes[n].inverse_depth, keyframe.inverse_depth, rtol=1e-9)
        np.testing.assert_allclose(graph.keyframes[n].information, keyframe.information, rtol=1e-9)


@pytest.mark.slow
def test_a_round_through_the_room_is_closed_by_its_images() -> None:
    true = true_graph(*AROUND)
    graph = drifted(true, 1.01, turn=0.005)
    position, ratio = errors(true, graph)
    closure = whole(closer(graph).searching(298))
    assert closure is not None
    assert (closure.source, closure.to) == (0, 298)
    assert closure.moved
    assert {(0, 298), (298, 0)} <= graph.edges.keys()
    after, ratio_after = errors(true, graph)
    assert after < 0.25 * position
    assert ratio_after - 1.0 < 0.15 * (ratio - 1.0)


@pytest.mark.slow
def test_a_second_segment_is_joined_by_its_images() -> None:
    true = true_graph(0, 4, 8, 2, 6)
    graph = true_graph(0, 4, 8)
    for number in (2, 6):
        graph.add(true_keyframe(number, unit=2.0, segment=1))
    closure = whole(closer(graph).searching(6)) or whole(closer(graph).searching(2))
    assert closure is not None
    assert closure.joined == 1
    position, ratio = errors(true, graph)
    assert position < 0.01, "meters"
    assert ratio < 1.02


def test_a_false_match_is_refused() -> None:
    """The newest image shows the tiles of the first one, elsewhere: retrieval proposes it, its geometry contradicts."""
    graph = true_graph(*AROUND)
    graph.keyframes[298].image = shuffled(0, 298)
    made, before = closer(graph), state(graph)
    assert made.retrieval.query(graph.keyframes[298].image.features()[1], 1, set()) == [0]
    assert whole(made.searching(298)) is None
    assert not graph.edges
    for a, b in zip(before, state(graph)):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("tied", "source"), [((), 0), ((0, 298), 20), ((0, 280, 298), 20)])
def test_what_edges_tie_already_is_no_loop(tied: tuple[int, ...], source: int) -> None:
    graph = true_graph(*AROUND)
    for pair in pairwise(tied):
        graph.edges[pair] = NO_EDGE
    closure = whole(closer(graph).searching(298))
    assert closure is not None
    assert closure.source == source


def test_rotations_stay_rotations_over_many_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a large map, which is solved by some of its keyframes, and whose loops say now more, now less."""
    monkeypatch.setattr(thinning, "MAX_NODES", COUNT // 2)
    monkeypatch.setattr(thinning, "THINNED", COUNT // 3)
    true, graph = ring(), ring()
    closing = closer(graph)
    for n in range(60):
        found, index, scale = between(true, graph, 0, COUNT - 1)
        assert closing.close(found, index, scale * (1.1 if n % 2 else 1.0 / 1.1)).moved
    rotations = np.stack([k.cam_from_world[:3, :3] for k in graph.keyframes.values()])
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-14)


def test_what_is_near_in_time_is_no_loop() -> None:
    assert whole(closer(true_graph(*AROUND), LoopConfig(min_gap=len(AROUND))).searching(298)) is None
