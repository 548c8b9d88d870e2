"""The back end on maps whose truth is known: edges matched again, edges added, and bundle adjustment of everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.stats import Stats
from mvsgs_core.tracking import graph as keyframe_graph
from mvsgs_core.tracking.back_end import BackEnd, BackEndConfig
from mvsgs_core.tracking.edges import Edge
from mvsgs_core.tracking.estimation.bundle_adjustment import adjust
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.steps import whole
from tests.support.true_maps import exact_matches, matcher, pose_error, true_graph, true_pose

FRAMES = (0, 6, 12, 18)


def back_end(graph: KeyframeGraph, config: BackEndConfig | None = None) -> BackEnd:
    return BackEnd(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), config or BackEndConfig(), 1)


def connected() -> KeyframeGraph:
    """The truth, with exact edges between all keyframes."""
    graph = true_graph(*FRAMES)
    for a in FRAMES:
        for b in FRAMES:
            if a != b:
                graph.connect(a, b, exact_matches(graph, a, graph.keyframes[b].cam_from_world), 0.1)
    return graph


def disturbed() -> KeyframeGraph:
    """The same with wrong poses and depths, but for the first pose."""
    graph, random = connected(), np.random.default_rng(1)
    for index in FRAMES[1:]:
        keyframe = graph.keyframes[index]
        keyframe.cam_from_world = geometry.se3_exp(random.normal(0.0, 0.01, 6)) @ keyframe.cam_from_world
        keyframe.inverse_depth = keyframe.inverse_depth * np.exp(random.normal(0.0, 0.05, len(keyframe.inverse_depth)))
    return graph


def worst_pose(graph: KeyframeGraph) -> float:
    """Largest error of the cameras as seen from the first, in the distance to the last, or in radians."""

    def seen(pose: np.ndarray, last: np.ndarray, first: np.ndarray) -> np.ndarray:
        relative = pose @ geometry.inverse(first)
        relative[:3, 3] /= np.linalg.norm((last @ geometry.inverse(first))[:3, 3])
        return relative

    poses = {index: graph.keyframes[index].cam_from_world for index in FRAMES}
    found = [seen(poses[index], poses[FRAMES[-1]], poses[0]) for index in FRAMES]
    true = [seen(true_pose(index), true_pose(FRAMES[-1]), true_pose(0)) for index in FRAMES]
    return max(max(pose_error(ours, theirs)) for ours, theirs in zip(found, true))


def median_inverse_depth(graph: KeyframeGraph) -> float:
    return float(np.median([1.0 / keyframe.median_depth for keyframe in graph.keyframes.values()]))


def test_only_edges_that_the_map_contradicts_are_matched_again() -> None:
    graph = connected()
    good, bad = graph.edges[6, 0], graph.edges[6, 12]
    graph.edges[6, 12] = Edge(bad.target + 8.0, bad.weight, bad.velocity, bad.fraction)
    assert back_end(graph).rematch_edges(6) == 1
    assert graph.edges[6, 0] is good
    again, (expected, _) = graph.edges[6, 12], graph.predict(6, 12)
    seen = again.weight > 0
    assert seen.sum() > 100
    assert np.median(np.linalg.norm(expected - again.target.T, axis=1)[seen]) < 0.5


def test_an_edge_that_nothing_holds_is_matched_again() -> None:
    graph = connected()
    held = graph.edges[6, 12]
    graph.edges[6, 12] = Edge(held.target, np.zeros_like(held.weight), held.velocity, held.fraction)
    assert back_end(graph).rematch_edges(6) == 1
    assert (graph.edges[6, 12].weight > 0).sum() > 100


def test_edges_are_added_to_the_nearest_that_have_none() -> None:
    graph = true_graph(*FRAMES)
    made = back_end(graph, BackEndConfig(max_edges=2))
    assert made.extend_edges(0, segment=0) == 2
    assert set(graph.edges) == {(0, 6), (0, 12)}
    assert made.extend_edges(0, segment=0) == 0, "they are there"
    assert made.extend_edges(0, segment=1) == 0, "no keyframe of another segment"


def test_global_adjustment_finds_the_poses_and_keeps_the_scale() -> None:
    graph = disturbed()
    before, scale = worst_pose(graph), median_inverse_depth(graph)
    solutions = back_end(graph).adjust(0)
    assert [solution.failure for solution in solutions] == [""] * len(BackEndConfig().robust_scales)
    assert before > 0.03
    assert worst_pose(graph) < 0.1 * before
    assert median_inverse_depth(graph) == pytest.approx(scale, rel=1e-6)


def test_two_keyframes_are_left_alone() -> None:
    graph = true_graph(0, 6)
    graph.connect(0, 6, exact_matches(graph, 0, true_pose(6)), 0.1)
    assert back_end(graph).adjust(0) == []
    stats = Stats()
    back_end(graph).put_right(0, stats)
    assert not stats.counts


def test_background_work_is_a_step_a_time_while_some_is_left() -> None:
    graph = disturbed()
    made = back_end(graph)
    before, scale, poses = worst_pose(graph), median_inverse_depth(graph), graph.keyframes[6].cam_from_world
    whole(made.working(0))
    np.testing.assert_array_equal(graph.keyframes[6].cam_from_world, poses, "nothing is left to do")
    made.pending = 3
    for left in (2, 1, 0):
        whole(made.working(0))
        assert made.pending == left
    assert worst_pose(graph) < 0.5 * before
    assert median_inverse_depth(graph) == pytest.approx(scale, rel=1e-6)
    poses = graph.keyframes[6].cam_from_world
    whole(made.working(0))
    np.testing.assert_array_equal(graph.keyframes[6].cam_from_world, poses)


def test_background_work_that_fails_says_why_and_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    made = back_end(connected())
    made.pending = 3
    assert whole(made.working(0)) == ""
    monkeypatch.setattr(keyframe_graph, "adjust", lambda *given: replace(adjust(*given), failure="no step"))
    assert whole(made.working(0)) == "no step"
    assert made.pending == 0
    assert whole(made.working(0)) == "", "nothing is left to do"


def test_the_end_matches_again_adds_edges_and_adjusts() -> None:
    graph = disturbed()
    for pair in [pair for pair in graph.edges if abs(pair[0] - pair[1]) > 6]:
        del graph.edges[pair]
    wrong = graph.edges[6, 0]
    graph.edges[6, 0] = Edge(wrong.target + 30.0, wrong.weight, wrong.velocity, wrong.fraction)
    before, stats = worst_pose(graph), Stats()
    back_end(graph).put_right(0, stats)
    assert stats.counts["edges matched again"] >= 1
    assert stats.counts["edges by proximity"] >= 2
    assert (0, 12) in graph.edges
    assert worst_pose(graph) < 0.3 * before
    assert not stats.warnings
