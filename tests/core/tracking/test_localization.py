"""The pose of one frame from the known depths of a keyframe, against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import localize, located
from tests.support.true_maps import exact_matches, image, matcher, pose_error, true_graph, true_pose

REFERENCE, FRAME = 100, 104
SOLVER = Solver(steps=10, robust_scale=1.0)
AWAY = geometry.se3_exp(np.array([0.03, -0.02, 0.03, 0.02, -0.02, 0.01]))  # of the truth: where the search begins


def test_exact_matches_give_the_true_pose() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    matches = exact_matches(graph, REFERENCE, true)
    found = localize(graph, REFERENCE, matches, AWAY @ true, SOLVER)
    assert not found.failure
    assert max(pose_error(found.cam_from_world, true)) < 1e-6
    assert found.inliers == 1.0


def test_wrong_matches_are_outvoted_and_counted() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    matches = exact_matches(graph, REFERENCE, true)
    wrong = np.flatnonzero(matches.alive)[::5]
    matches.target[wrong] += [30.0, -20.0]
    found = localize(graph, REFERENCE, matches, AWAY @ true, SOLVER)
    shift, turn = pose_error(found.cam_from_world, true)
    assert shift < 0.005, "meters"
    assert turn < 0.003
    assert found.inliers == pytest.approx(1.0 - len(wrong) / matches.alive.sum(), abs=0.01)


def test_depths_that_were_never_triangulated_have_no_say() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    matches = exact_matches(graph, REFERENCE, true)
    keyframe = graph.keyframes[REFERENCE]
    keyframe.inverse_depth[::2], keyframe.information[::2] = 2.0, 0.0
    found = localize(graph, REFERENCE, matches, AWAY @ true, SOLVER)
    assert max(pose_error(found.cam_from_world, true)) < 1e-6
    assert found.inliers == 1.0


def test_of_a_map_without_triangulated_depths_all_are_taken() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    graph.keyframes[REFERENCE].information[:] = 0.0
    found = localize(graph, REFERENCE, exact_matches(graph, REFERENCE, true), AWAY @ true, SOLVER)
    assert max(pose_error(found.cam_from_world, true)) < 1e-6


def test_without_matches_there_is_no_pose() -> None:
    graph, start = true_graph(REFERENCE), true_pose(FRAME)
    none = exact_matches(graph, REFERENCE, start)
    found = localize(graph, REFERENCE, Matches(none.target, 0.0 * none.weight), start, SOLVER)
    assert "no match" in found.failure
    assert found.inliers == 0.0
    np.testing.assert_array_equal(found.cam_from_world, start)


@pytest.mark.parametrize("reads_columns", [False, True])
def test_the_rolling_shutter_is_taken_out_of_the_matches(reads_columns: bool) -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    exact = exact_matches(graph, REFERENCE, true)
    seen = exact.target + np.random.default_rng(0).normal(0.0, 2.0, exact.target.shape)
    height, width = graph.keyframes[REFERENCE].image.size
    late = (seen[:, 0] / width if reads_columns else seen[:, 1] / height) - 0.5  # readouts
    velocity = (seen - exact.target) / (0.02 * late[:, None])
    graph.readout_time, graph.reads_columns = 0.02, reads_columns
    matches = Matches(seen, exact.weight, velocity)
    found = localize(graph, REFERENCE, matches, AWAY @ true, SOLVER)
    assert max(pose_error(found.cam_from_world, true)) < 1e-6
    assert located(graph, REFERENCE, matches, true).sum() == exact.alive.sum()


def test_located_are_points_within_two_pixels() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    matches = exact_matches(graph, REFERENCE, true)
    near, far, dead = np.flatnonzero(matches.alive)[:3]
    matches.target[near] += [1.9, 0.0]
    matches.target[far] += [0.0, 2.1]
    matches.weight[dead] = 0.0
    expected = matches.alive.copy()
    expected[far] = False
    np.testing.assert_array_equal(located(graph, REFERENCE, matches, true), expected)


def test_of_a_camera_that_turned_depths_do_not_matter() -> None:
    graph = true_graph(REFERENCE)
    turned = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.01, 0.03, 0.0])) @ true_pose(REFERENCE)
    matches = exact_matches(graph, REFERENCE, turned)
    graph.keyframes[REFERENCE].inverse_depth *= 5.0
    assert located(graph, REFERENCE, matches, turned, at_infinity=True).sum() == matches.alive.sum()
    moved = true_pose(FRAME)
    assert located(graph, REFERENCE, exact_matches(graph, REFERENCE, moved), moved, at_infinity=True).mean() < 0.2


def test_matches_of_images_give_the_pose_to_millimeters() -> None:
    graph, true = true_graph(REFERENCE), true_pose(FRAME)
    guess, _ = graph.predict_pose(REFERENCE, graph.keyframes[REFERENCE].cam_from_world)
    matches, _ = matcher().match(graph.keyframes[REFERENCE].image, image(FRAME), guess, 0.0)
    found = localize(graph, REFERENCE, matches, true_pose(REFERENCE), SOLVER)
    shift, turn = pose_error(found.cam_from_world, true)
    assert shift < 0.003, "meters"
    assert turn < 0.002
    assert found.inliers > 0.7, "where objects hide others, matches are wrong"
