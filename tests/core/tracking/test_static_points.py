"""What moves is told from what stands by all matches of a point, and has no part in poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bench.moving import with_person
from mvsgs_core import geometry
from mvsgs_core.tracking.assessment import tell_what_moves
from mvsgs_core.tracking.edges import Edge
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solver, adjust
from mvsgs_core.tracking.estimation.static_points import STILL, static_weights
from mvsgs_core.tracking.estimation.structure_from_motion import EPIPOLAR, PAIRS, ReconstructionCriteria, reconstructing
from mvsgs_core.tracking.estimation.two_view_starts import two_view_poses, widest_pairs
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import localize
from mvsgs_core.tracking.steps import whole
from mvsgs_core.tracking.tracker import Tracker
from tests.support.keyframe_graphs import noisy, scene
from tests.support.sequences import ate, synthetic
from tests.support.true_maps import exact_matches, matcher, pose_error, tie, true_graph, true_pose

MOVED = 3.0  # pixels from one keyframe to the next
FRAMES = (0, 4, 8, 12, 16)


def walking(share: float = 0.2) -> tuple[Graph, np.ndarray]:
    """A graph in which some points move upward, and which those are: (M,) bool."""
    graph, _, _ = scene(k=5, m=100, noise=0.03)
    moves = np.arange(100) < 100 * share
    target = graph.target.copy()
    target[:, 1] -= np.where(moves, MOVED * (graph.to - graph.source)[:, None], 0.0)
    return replace(graph, target=target), moves


def test_points_that_move_weigh_little_and_those_that_stand_much() -> None:
    graph, moves = walking()
    weights = static_weights(graph)
    assert weights.shape == graph.inverse_depth.shape
    assert (weights[:, moves] < STILL).mean() > 0.95
    assert (weights[:, ~moves] > 0.8).all()


def test_one_wrong_match_of_many_condemns_no_point_and_no_match_says_nothing() -> None:
    graph, _, _ = scene(k=8, m=50)
    information = np.zeros_like(graph.information)
    information[:, [0, 2]] = 1.0
    target = graph.target.copy()
    first = np.flatnonzero(graph.source == 0)
    target[first[0], :, 0] += 3.0
    information[first, :, 1] = 0.0
    weights = static_weights(replace(graph, information=information, target=target))
    assert weights[0, 0] == pytest.approx((1 / (1 + 18 / 7)) ** 2)
    assert weights[0, 0] > STILL / 2
    assert np.isnan(weights[0, 1])
    assert weights[1, 1] == pytest.approx(1.0)


def test_the_weights_themselves_are_left_out_of_the_residuals() -> None:
    graph, _ = walking()
    known = static_weights(graph)
    assert np.array_equal(static_weights(replace(graph, static=known)), known)


@pytest.mark.parametrize("device", ["cpu", "torch"])
def test_a_weight_is_a_factor_on_the_information_of_all_matches_of_a_point(device: str) -> None:
    graph = noisy()
    static = np.random.default_rng(2).uniform(0.0, 1.0, graph.inverse_depth.shape)
    solver = Solver(steps=4, tolerance=0.0, device=device)
    weighed = adjust(replace(graph, static=static), solver)
    same = adjust(replace(graph, information=graph.information * static[graph.source][:, None]), solver)
    plain = adjust(graph, solver)
    assert np.array_equal(weighed.cam_from_world, same.cam_from_world)
    assert np.array_equal(weighed.inverse_depth, same.inverse_depth)
    assert not np.array_equal(weighed.cam_from_world, plain.cam_from_world)
    with pytest.raises(ValueError, match=r"Graph\.static"):
        adjust(replace(graph, static=static[:1]), solver)


def circling(*frames: int) -> KeyframeGraph:
    """Keyframes of the room with edges between all of them, exact ones."""
    graph = true_graph(*frames)
    for a in frames:
        for b in frames:
            if a != b:
                assert graph.connect(a, b, exact_matches(graph, a, true_pose(b)), 0.1)
    return graph


def in_a_corner(graph: KeyframeGraph, index: int) -> np.ndarray:
    """(M,) bool: points of a keyframe in a third of the image."""
    keyframe = graph.keyframes[index]
    return np.asarray(keyframe.points[:, 0] < keyframe.image.size[1] / 3)


def with_a_moving_corner(*frames: int) -> KeyframeGraph:
    """The same, where a third of the image moves along, and up and down, as a person would."""
    graph = circling(*frames)
    for (a, b), edge in list(graph.edges.items()):
        weight = edge.weight.astype(np.float64)
        target = np.where(weight > 0, edge.target, np.nan).T.astype(np.float64)
        target[:, 0] += np.where(in_a_corner(graph, a), 0.5 * (b - a), 0.0)
        bobbing = 4.0 * (np.cos(b / 3.0) - np.cos(a / 3.0))
        target[:, 1] += np.where(in_a_corner(graph, a), bobbing, 0.0)
        graph.connect(a, b, Matches(target, weight), 0.1)
    return graph


@pytest.mark.parametrize("moving", [False, True])
def test_two_views_give_all_keyframes_a_pose_also_where_something_moves(moving: bool) -> None:
    """Of those that are tried one at least, in which the most stands still."""
    graph = with_a_moving_corner(*FRAMES) if moving else circling(*FRAMES)
    true = np.stack([true_pose(n) @ geometry.inverse(true_pose(0)) for n in FRAMES])
    length = np.linalg.norm(true[-1, :3, 3])
    worst = []
    for pair in widest_pairs(graph, list(FRAMES), PAIRS):
        assert abs(pair[0] - pair[1]) >= 12
        for epipolar in EPIPOLAR:
            poses = two_view_poses(graph, list(FRAMES), pair, epipolar)
            assert poses is not None
            assert np.allclose(poses[0], np.eye(4))
            poses[:, :3, 3] *= length / np.linalg.norm(poses[-1, :3, 3])
            worst.append(np.max([pose_error(found, wanted) for found, wanted in zip(poses, true)], axis=0))
    apart, turned = min(worst, key=lambda each: float(each[0]))
    assert apart < (0.03 if moving else 0.005) * length
    assert turned < 0.003


def test_two_views_of_too_few_points_give_no_pose() -> None:
    graph = circling(*FRAMES)
    edge = graph.edges[0, 16]
    weight = np.where(np.cumsum(edge.found) <= 3, edge.weight, 0.0)
    graph.edges[0, 16] = Edge(edge.target, weight, edge.velocity, edge.fraction)
    assert graph.edges[0, 16].found.sum() == 3, "OpenCV asks for five"
    assert two_view_poses(graph, list(FRAMES), (0, 16)) is None


def test_a_keyframe_that_has_no_pose_of_its_own_is_put_where_the_time_puts_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def asserts(*arguments: object, **options: object) -> None:
        raise cv2.error("SQPnP: assertion failed")

    monkeypatch.setattr(cv2, "solvePnPRansac", asserts)
    poses = two_view_poses(circling(*FRAMES), list(FRAMES), (0, 16))
    assert poses is not None
    twist = geometry.se3_log(poses[-1])
    for index, pose in zip(FRAMES, poses):
        np.testing.assert_allclose(pose, geometry.se3_exp(index / FRAMES[-1] * twist), atol=1e-9)


@pytest.mark.slow
def test_a_start_is_not_bent_by_what_moves_where_the_calibration_is_known() -> None:
    graph = with_a_moving_corner(*FRAMES)
    errors = {}
    for weighing in (False, True):
        graph.weighing = weighing
        found = whole(reconstructing(graph, list(FRAMES), ReconstructionCriteria(), 1))
        true = np.stack([true_pose(n) for n in FRAMES])
        here, there = (geometry.inverse(poses)[:, :3, 3] for poses in (found.cam_from_world, true))
        aligned = geometry.umeyama(here, there).apply(here)
        errors[weighing] = float(np.abs(aligned - there).max())
        if weighing:
            assert found.failure == ""
            corner = np.stack([in_a_corner(graph, n) for n in FRAMES])
            seen = found.static < 1.0
            assert np.median(found.static[seen & corner]) < STILL
            assert np.median(found.static[seen & ~corner]) > 0.9
        else:
            assert (found.static == 1.0).all()
    assert errors[True] < 0.2 * errors[False]


def test_a_start_of_which_most_moves_is_none() -> None:
    graph = circling(*FRAMES)
    graph.weighing = True
    assert whole(reconstructing(graph, list(FRAMES), ReconstructionCriteria(), 1)).failure == ""
    refused = whole(reconstructing(graph, list(FRAMES), ReconstructionCriteria(min_still=1.01), 1)).failure
    assert "stand still" in refused
    assert "%" in refused


def test_points_that_move_have_no_part_in_a_frames_pose() -> None:
    graph = true_graph(0)
    true = true_pose(4)
    matches = exact_matches(graph, 0, true)
    moves = in_a_corner(graph, 0)
    target = matches.target + np.where(moves[:, None], [4.0, 1.0], 0.0)
    wrong = Matches(target, matches.weight)
    graph.keyframes[0].static = np.where(moves, 0.0, 1.0)
    found = localize(graph, 0, wrong, true_pose(0), Solver(steps=8))
    assert pose_error(found.cam_from_world, true)[0] < 1e-6
    assert found.inliers == 1.0
    graph.keyframes[0].static = np.ones(len(moves))
    assert localize(graph, 0, wrong, true_pose(0), Solver(steps=8)).inliers < 0.9


def test_points_that_move_speak_neither_for_nor_against_a_keyframe_unless_they_are_many() -> None:
    graph = true_graph(0, 4)
    tie(graph, 0, 4)
    local_map = LocalMap(graph, matcher(), LocalMapConfig(), 1)
    edge = graph.edges[0, 4]
    found = np.flatnonzero(edge.found)
    target = np.where(edge.found, edge.target, np.nan).T.astype(np.float64)
    for share, agreement in ((0.15, 1.0), (0.4, 0.75)):  # of all but a fifth .6 agree
        some = np.random.default_rng(1).permutation(found)[: round(share * len(found))]
        off = target.copy()
        off[some] += 10.0
        graph.connect(0, 4, Matches(off, edge.weight.astype(np.float64)), 0.1)
        static = np.ones(len(target))
        static[some] = 0.0
        graph.keyframes[0].static = np.ones(len(target))
        assert local_map.agreement(4) == pytest.approx(1.0 - share, abs=0.01)
        graph.keyframes[0].static = static
        assert local_map.agreement(4) == pytest.approx(agreement, abs=0.01)


@pytest.mark.slow
def test_a_person_who_walks_through_the_picture_does_not_take_the_camera_along() -> None:
    items = [replace(item, depth=None) for item in synthetic(frames=60)]
    shown, wheres = with_person(items, 0.35, 60)
    assert 0.05 < np.mean(wheres) < 0.35
    for given in (items, shown):
        tracker = Tracker()
        for item in given:
            tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        list(tracker.finish())
        error, length = ate(tracker.trajectory(), items)
        assert error < 0.003 * length
        assert tracker.stats.values["points that stand still"].endswith("% of those seen again")
    assert tracker.stats.counts["points that move, or contradict the map"] > 500


def test_nothing_is_said_of_what_moves_where_nothing_was_weighed() -> None:
    tracker = Tracker()
    tell_what_moves(tracker.stats, true_graph(0, 4))
    assert "points that stand still" not in tracker.stats.values
