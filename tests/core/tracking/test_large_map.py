"""What a large map costs no more than a small one gives the same: edges at hand, fewer looks, thinning, blocks."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.stats import Stats
from mvsgs_core.tracking import local_map, photometer
from mvsgs_core.tracking.back_end import BackEnd, BackEndConfig
from mvsgs_core.tracking.edges import Edge, Edges
from mvsgs_core.tracking.estimation import lights
from mvsgs_core.tracking.estimation.bundle_adjustment import Solution
from mvsgs_core.tracking.estimation.pose_graph import (
    PoseGraphSolution,
    SimilarityEdges,
    scale_of,
    solve_pose_graph,
)
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places import thinning
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.publish import Publisher
from mvsgs_core.tracking.steps import whole
from tests.support.true_maps import matcher, tie

NO_EDGE = Edge(np.zeros((2, 0)), np.zeros(0), np.zeros((2, 0)), 1.0)
CHAIN = tuple(range(0, 54, 6))  # keyframes


def chain() -> KeyframeGraph:
    """Cameras side by side before a rough wall, with their true poses and depths; no edges."""
    random = np.random.default_rng(0)
    graph = KeyframeGraph(np.array([80.0, 80.0, 47.5, 31.5]))
    for n, index in enumerate(CHAIN):
        image = TrackingImage(index, float(n), random.integers(0, 256, (64, 96), np.uint8))
        inverse_depth = random.uniform(0.4, 0.6, len(image.cells.points))
        pose = geometry.se3_exp(np.array([-0.15 * n, 0.0, 0.0, 0.0, 0.01 * n, 0.0]))
        graph.add(Keyframe(image, pose, inverse_depth, 1e3 / inverse_depth**2, 0))
    return graph


def test_edges_of_keyframes_are_those_in_their_order() -> None:
    random, edges = np.random.default_rng(0), Edges()
    plain: dict[tuple[int, int], Edge] = {}
    for _ in range(300):
        a, b = (int(n) for n in random.choice(12, 2, replace=False))
        if (a, b) in plain and random.random() < 0.4:
            del plain[a, b], edges[a, b]
        else:
            plain[a, b] = edges[a, b] = NO_EDGE
    assert list(edges) == list(plain)
    asked = {3, 7}
    assert edges.of(asked) == [pair for pair in plain if set(pair) & asked]
    assert edges.reached(asked) == asked | {end for pair in plain if set(pair) & asked for end in pair}


def test_changes_of_edges_are_told_once() -> None:
    edges = Edges()
    edges[1, 2] = edges[5, 1] = edges[2, 3] = NO_EDGE
    changed, seen = edges.changes(0)
    assert changed == [(1, 2), (5, 1), (2, 3)]
    del edges[5, 1]
    edges[1, 2] = NO_EDGE
    changed, seen = edges.changes(seen)
    assert changed == [(1, 2), (5, 1)]
    assert edges.changes(seen) == ([], seen)


def test_keyframes_that_stayed_as_they_were_are_not_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = chain()
    publisher, looked_at = Publisher(graph, 0.01), []
    publisher.publish_all(list(CHAIN), settled=True)
    whole = graph.world_from_cam
    monkeypatch.setattr(graph, "world_from_cam", lambda index: looked_at.append(index) or whole(index))
    assert publisher.corrections() is None
    assert looked_at == list(CHAIN)
    graph.keyframes[CHAIN[3]].cam_from_world = graph.keyframes[CHAIN[3]].cam_from_world.copy()  # by too little
    looked_at.clear()
    assert publisher.corrections() is None
    assert looked_at == [CHAIN[3]]
    graph.rescale([CHAIN[5]], 1.5)
    correction = publisher.corrections()
    assert correction is not None
    assert correction.index.tolist() == [CHAIN[5]]


def test_retrieval_is_what_counting_word_by_word_gives() -> None:
    random, retrieval = np.random.default_rng(0), Retrieval()
    common = random.integers(0, 256, (60, 32), np.uint8)
    seen = {}
    for index in (9, 2, 40, 17, 5, 33):
        own = random.integers(0, 256, (40, 32), np.uint8)
        seen[index] = np.concatenate([common[random.random(60) < 0.5], own])
        retrieval.add(index, seen[index])
    asked = np.concatenate([common, random.integers(0, 256, (20, 32), np.uint8)])
    words = {index: set(np.unique(retrieval._words(d)).tolist()) for index, d in seen.items()}
    scores = dict.fromkeys(seen, 0.0)
    for word in np.unique(retrieval._words(asked)).tolist():
        having = [index for index in seen if word in words[index]]
        for index in having:
            scores[index] += float(np.log(1.0 + len(seen) / len(having)))
    order = sorted(seen, key=lambda index: (-scores[index], index))
    assert retrieval.query(asked, 4, set()) == order[:4]
    assert retrieval.query(asked, 4, {order[0], 77}) == order[1:5]
    usual = {order[1], 78}
    wanted = [index for index in order if scores[index] >= 0.5 * scores[order[1]]]
    assert retrieval.query(asked, 9, {order[1]}, usual) == [index for index in wanted if index != order[1]]


def test_only_of_many_keyframes_those_out_of_reach_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = chain()
    maps = LocalMap(graph, matcher(), LocalMapConfig(), 1)
    others = list(CHAIN[:-1])
    before = maps.nearby(CHAIN[-1], others, 3)
    assert before
    graph.keyframes[CHAIN[0]].cam_from_world = geometry.se3_exp(np.array([0, 0, 0, 0, np.pi, 0.0]))
    monkeypatch.setattr(local_map, "FEW", 4)
    asked: list[int] = []
    monkeypatch.setattr(maps, "graph_flow", lambda index, candidates: asked.extend(candidates) or {})
    maps.nearby(CHAIN[-1], others, 3)
    assert CHAIN[0] not in asked
    assert set(before) <= set(asked)


def flickering(steady: int = 0) -> tuple[KeyframeGraph, np.ndarray]:
    """Keyframes of one view whose light changes, but for so many newest ones, with edges between neighbors; and their
    log gains (K,)."""
    random, graph = np.random.default_rng(3), KeyframeGraph(np.array([80.0, 80.0, 47.5, 31.5]))
    scene = cv2.GaussianBlur(random.uniform(0, 255, (32, 48, 3)).astype(np.float32), (5, 5), 0)
    scene = cv2.normalize(scene, None, 60.0, 130.0, cv2.NORM_MINMAX)
    rough, gains = random.integers(0, 256, (64, 96), np.uint8), 0.35 * np.sin(1.3 * np.arange(20))
    gains[20 - steady :] = gains[19 - steady]
    for n, gain in enumerate(gains):
        noise = random.normal(0.0, 1.0 if steady else 0.0, scene.shape)
        half = np.rint(scene * np.exp(gain) + noise).astype(np.uint8)
        image = TrackingImage(n, float(n), rough, half_color=half)
        count = len(image.cells.points)
        graph.add(Keyframe(image, np.eye(4), np.full(count, 0.5), np.full(count, 1e3), 0))
    for a, b in [pair for n in range(19) for pair in ((n, n + 1), (n + 1, n), (max(n - 1, 0), n + 1))]:
        points = graph.keyframes[a].points
        assert graph.connect(a, b, Matches(points.copy(), np.ones(len(points))), 0.1)
    return graph, gains


@pytest.mark.parametrize("at_once", [300, 9])
def test_exposures_of_many_keyframes_are_solved_for_the_newest(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photometer, "AT_ONCE", at_once)
    graph, gains = flickering()
    growing = KeyframeGraph(graph.intrinsics)
    light, solved = photometer.Photometer(growing, Stats()), []
    solve = lights.solve_photometry
    monkeypatch.setattr(lights, "solve_photometry", lambda e, n, known: solved.append(n) or solve(e, n, known))
    for index, keyframe in graph.keyframes.items():
        growing.add(keyframe)
        growing.edges |= {pair: graph.edges[pair] for pair in graph.edges if max(pair) == index}
        light.update()
    light.update(at_the_end=True)
    assert max(solved) == min(at_once, len(gains))
    found = [np.log(np.trace(light.exposure(index)[:, :3]) / 3) for index in growing.keyframes]
    off = np.array(found) - (gains - gains.mean())
    assert np.abs(off - off.mean()).max() < 0.02


def log_gains(light: photometer.Photometer, graph: KeyframeGraph) -> np.ndarray:
    """(K,) by the exposures of the keyframes, which are all known."""
    exposures = [light.exposure(index) for index in graph.keyframes]
    return np.array([np.nan if e is None else np.log(np.trace(e[:, :3]) / 3) for e in exposures])


@pytest.mark.parametrize("steady", [False, True], ids=["changing", "steady newest"])
@pytest.mark.parametrize("at_once", [300, 9])
def test_the_light_of_a_map_that_is_taken_up_is_that_of_the_run_before(
    at_once: int, steady: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What frames are found to look like is told against the map's colors: the mean is over all keyframes."""
    monkeypatch.setattr(photometer, "AT_ONCE", at_once)
    graph, gains = flickering(steady=9 if steady else 0)
    light = photometer.Photometer(graph, Stats())
    light.take_up()
    assert light.varies
    np.testing.assert_allclose(log_gains(light, graph), gains - gains.mean(), atol=0.03)
    index = max(graph.keyframes) + 1
    keyframe = graph.keyframes[index - 1]
    graph.add(
        Keyframe(replace(keyframe.image, index=index), np.eye(4), keyframe.inverse_depth, keyframe.information, 0)
    )
    points = keyframe.points
    assert graph.connect(index - 1, index, Matches(points.copy(), np.ones(len(points))), 0.1)
    before = log_gains(light, graph)[:-1]
    light.update()
    after = log_gains(light, graph)
    np.testing.assert_allclose(after[:-1], before, atol=1e-3)
    assert after[-1] == pytest.approx(before[-1], abs=0.02)


def drifting(count: int, growth: float) -> tuple[np.ndarray, np.ndarray, SimilarityEdges]:
    """A round of cameras, as it is and as odometry whose scale drifts sees it, with the edge that closes it."""
    turn = geometry.so3_exp(np.array([0.0, 2.0 * np.pi / count, 0.0]))
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = turn, [0.0, 0.0, -2.0 * np.sin(np.pi / count)]
    true, seen = [np.eye(4)], [np.eye(4)]
    for n in range(1, count):
        longer = step.copy()
        longer[:3, 3] *= growth ** (n / count)
        true.append(step @ true[-1])
        seen.append(longer @ seen[-1])
    poses = np.stack(seen)
    source, to = np.arange(count - 1), np.arange(1, count)
    loop = np.diag([growth, growth, growth, 1.0]) @ true[-1]  # its own unit is longer
    relative = np.concatenate([poses[to] @ geometry.inverse(poses[source]), [loop]])
    edges = SimilarityEdges(
        np.append(source, 0), np.append(to, count - 1), relative, np.tile([0.01, 0.005, 0.01], (count, 1))
    )
    return np.stack(true), poses, edges


def places(similarities: np.ndarray) -> np.ndarray:
    return np.stack([np.linalg.inv(s)[:3, 3] for s in similarities])


def test_thinned_pose_graph_closes_a_loop_as_the_whole_one(monkeypatch: pytest.MonkeyPatch) -> None:
    true, poses, edges = drifting(90, 1.3)
    whole = solve_pose_graph(poses, edges, {0})
    monkeypatch.setattr(thinning, "MAX_NODES", 60)
    monkeypatch.setattr(thinning, "THINNED", 24)
    thin = thinning.solve_thinned(poses, edges)
    assert not thin.failure
    np.testing.assert_allclose(thin.similarities[0], poses[0], atol=1e-12)
    before, closed, thinned = (np.linalg.norm(places(s) - places(true), axis=1).max()
                               for s in (poses, whole.similarities, thin.similarities))  # fmt: skip
    assert closed < 0.01 * before
    assert thinned < 0.05 * before
    np.testing.assert_allclose(scale_of(thin.similarities), scale_of(whole.similarities), rtol=0.02)
    steps = np.linalg.norm(np.diff(places(thin.similarities), axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.1 * steps.mean()  # no seam at a node


@pytest.mark.parametrize("reached_across", [False, True])
def test_thinned_pose_graph_gives_a_step_that_nobody_measured_the_loops_error(
    reached_across: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thinning, "MAX_NODES", 60)
    monkeypatch.setattr(thinning, "THINNED", 24)
    true, poses, edges = drifting(90, 1.0)
    poses[45:] = poses[45:] @ geometry.se3_exp(np.array([0.3, 0.1, -0.2, 0.0, 0.05, 0.0]))
    source, to = (np.insert(ends, -1, end) for ends, end in ((edges.source, 43), (edges.to, 46)))
    sigma = np.insert(edges.sigma, -1, edges.sigma[0] if reached_across else 1e9, axis=0)
    sigma[44] *= 1e3
    relative = np.concatenate([poses[to[:-1]] @ geometry.inverse(poses[source[:-1]]), edges.relative[-1:]])
    thin = thinning.solve_thinned(poses, SimilarityEdges(source, to, relative, sigma))
    before, after = (np.linalg.norm(places(s) - places(true), axis=1).max() for s in (poses, thin.similarities))
    assert not thin.failure
    assert (after < 0.05 * before) != reached_across  # where an edge reaches across, it is a step as any other


def test_a_thinned_pose_graph_is_small_however_many_steps_nobody_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    true, poses, edges = drifting(900, 1.3)
    edges.sigma[1:-1:3] *= 1e3
    solved: list[int] = []

    def spied(poses: np.ndarray, *rest: Any) -> PoseGraphSolution:
        solved.append(len(poses))
        return solve_pose_graph(poses, *rest)

    monkeypatch.setattr(thinning, "solve_pose_graph", spied)
    thin = thinning.solve_thinned(poses, edges)
    assert not thin.failure
    assert max(solved) <= thinning.MAX_NODES
    assert (
        np.linalg.norm(places(thin.similarities) - places(true), axis=1).max()
        < 0.5 * np.linalg.norm(places(poses) - places(true), axis=1).max()
    )


def test_neighbors_that_no_match_ties_are_joined_only_where_nothing_else_does() -> None:
    """Else what lies between them is known without them, and was never measured."""
    assert thinning.joining(6, {(0, 1), (1, 2), (3, 4), (4, 5)}) == {(2, 3)}
    assert thinning.joining(6, {(0, 1), (1, 2), (3, 4), (4, 5), (0, 5)}) == set()
    assert thinning.joining(3, set()) == {(0, 1), (1, 2)}


def disturbed() -> KeyframeGraph:
    graph, random = chain(), np.random.default_rng(1)
    for apart in (1, 2):
        for first in range(apart):
            tie(graph, *CHAIN[first::apart])
            tie(graph, *CHAIN[first::apart][::-1])
    for index in CHAIN[1:]:
        keyframe = graph.keyframes[index]
        keyframe.cam_from_world = geometry.se3_exp(random.normal(0.0, 0.003, 6)) @ keyframe.cam_from_world
    return graph


def residual(graph: KeyframeGraph) -> float:
    """Mean pixels between where edges found points and where the map says they are."""
    errors = []
    for (a, b), edge in graph.edges.items():
        seen = edge.weight > 0
        errors.append(np.linalg.norm(graph.predict(a, b)[0] - edge.target.T, axis=1)[seen])
    return float(np.nanmean(np.concatenate(errors)))


def test_a_large_map_is_adjusted_in_blocks_of_bounded_size(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, sizes = disturbed(), []
    at_once = KeyframeGraph.optimize

    def optimize(self: KeyframeGraph, indices: set[int], poses: set[int], *rest: object) -> Solution:
        sizes.append(len(poses))
        return at_once(self, indices, poses, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(KeyframeGraph, "optimize", optimize)
    back = BackEnd(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), BackEndConfig(max_keyframes=5), 1)
    before = residual(graph)
    back.pending = 1
    assert whole(back.working(0)) == ""
    assert residual(graph) < before
    back.adjust(0)
    assert max(sizes) <= 5
    assert residual(graph) < 0.2 * before


def test_blocks_hold_every_keyframe_and_overlap_by_half() -> None:
    graph = chain()
    back = BackEnd(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), BackEndConfig(max_keyframes=6), 1)
    for count in (6, 7, 9, 10, 23):
        members = list(range(count))
        blocks = back._blocks(members)
        assert sorted({k for block in blocks for k in block}) == members
        assert max(map(len, blocks)) <= 6
        assert all(len(set(a) & set(b)) == 3 for a, b in pairwise(blocks))
