"""An old keyframe in an image: found where it is, with the true pose, and refused where it only looks alike."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch, relative_scale, verify_place
from mvsgs_core.tracking.places.localization import Localization
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from tests.support.true_maps import (
    exact_matches,
    image,
    matcher,
    pose_error,
    shuffled,
    true_graph,
    true_keyframe,
    true_pose,
)

PLACE, FRAME, ELSEWHERE = 100, 106, 200
CRITERIA = PoseCriteria()


def seen(graph: KeyframeGraph, pose: np.ndarray) -> tuple[Matches, Localization]:
    """Exact matches of the place's points, with the pose that they have."""
    return exact_matches(graph, PLACE, pose), Localization(pose, 1.0)


@pytest.mark.parametrize("unit", [1.0, 2.5])
def test_a_place_is_found_with_its_pose_in_the_maps_unit(unit: float) -> None:
    found = verify_place(true_graph(PLACE, unit=unit), matcher(), PLACE, image(FRAME), CRITERIA)
    assert found is not None
    assert found.index == PLACE
    shift, turn = pose_error(found.localization.cam_from_world, true_pose(FRAME, unit))
    assert shift * unit < 0.005, "meters"
    assert turn < 0.003


def test_another_place_is_refused() -> None:
    assert verify_place(true_graph(PLACE), matcher(), PLACE, image(ELSEWHERE), CRITERIA) is None


def test_the_same_features_in_other_places_are_refused() -> None:
    assert verify_place(true_graph(PLACE), matcher(), PLACE, shuffled(PLACE, FRAME), CRITERIA) is None


def test_points_that_opencv_has_no_pose_for_are_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def asserts(*_: object, **__: object) -> None:
        raise cv2.error("sqpnp.cpp: (-215:Assertion failed) ++num_null_vectors_ <= 6")

    monkeypatch.setattr(cv2, "solvePnPRansac", asserts)
    assert verify_place(true_graph(PLACE), matcher(), PLACE, image(FRAME), CRITERIA) is None


def test_a_match_that_the_maps_depths_contradict_is_refused() -> None:
    graph = true_graph(PLACE)
    depths = graph.keyframes[PLACE].inverse_depth
    depths[:] = np.random.default_rng(0).permutation(depths)
    assert verify_place(graph, matcher(), PLACE, image(110), CRITERIA) is None


def test_a_place_whose_depths_are_not_known_is_refused() -> None:
    graph = true_graph(PLACE)
    graph.keyframes[PLACE].information[60:] = 0.0
    assert verify_place(graph, matcher(), PLACE, image(FRAME), CRITERIA) is None


def test_exact_matches_meet_the_criteria_and_each_criterion_binds() -> None:
    graph, pose = true_graph(PLACE), true_pose(FRAME)
    matches, found = seen(graph, pose)
    accept = CRITERIA.accept
    assert accept(graph, PLACE, matches, found)
    assert not accept(graph, PLACE, matches, replace(found, failure="the matrix is singular"))
    number = int(matches.alive.sum())

    few = Matches(matches.target, matches.weight * (np.arange(len(matches.weight)) % 10 == 0))
    assert not accept(graph, PLACE, few, found), "a tenth of the points"
    assert replace(CRITERIA, min_fraction=0.05, min_matches=20).accept(graph, PLACE, few, found)
    assert not replace(CRITERIA, min_fraction=0.05, min_matches=number // 5).accept(graph, PLACE, few, found)

    for wrong, wanted in ((0.2, True), (0.4, False)):
        target = matches.target.copy()
        some = np.random.default_rng(0).random(len(target)) < wrong
        target[some] += [5.0, 0.0]
        assert accept(graph, PLACE, Matches(target, matches.weight), found) == wanted

    corner = matches.alive & (matches.target < [80.0, 60.0]).all(axis=1)  # a sixteenth of the image
    there = Matches(matches.target, matches.weight * corner)
    loose = replace(CRITERIA, min_fraction=0.0, min_matches=5)
    assert corner.sum() >= 5
    assert not loose.accept(graph, PLACE, there, found)
    assert replace(loose, min_area=0.02).accept(graph, PLACE, there, found)


def test_against_a_keyframe_without_depths_only_a_rotation_is_certain() -> None:
    graph = true_graph(PLACE)
    graph.keyframes[PLACE].information[:] = 0.0
    turned = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.01, 0.03, 0.0])) @ true_pose(PLACE)
    assert CRITERIA.accept(graph, PLACE, *seen(graph, turned))
    assert not CRITERIA.accept(graph, PLACE, *seen(graph, true_pose(FRAME)))


@pytest.mark.parametrize("unit", [0.5, 1.7])
def test_two_keyframes_of_one_place_tell_the_ratio_of_their_units(unit: float) -> None:
    graph = true_graph(PLACE)
    graph.add(true_keyframe(FRAME, unit))
    place = PlaceMatch(PLACE, *seen(graph, true_pose(FRAME)))
    assert relative_scale(graph, place, FRAME) == pytest.approx(1.0 / unit, rel=0.01)
    graph.keyframes[FRAME].information[19:] = 0.0
    assert relative_scale(graph, place, FRAME) is None


def test_the_points_of_a_large_image_are_not_all_compared_at_once() -> None:
    """14,400 of 1280x720 pixels took 6 GB."""
    count, known = 3000, 2400
    points = np.random.default_rng(0).uniform(0.0, 640.0, (count, 2)).astype(np.float32)
    keyframe = SimpleNamespace(triangulated=np.arange(count) < known, points=points, inverse_depth=np.ones(count))
    graph: Any = SimpleNamespace(
        keyframes={0: keyframe, 1: SimpleNamespace(**vars(keyframe) | {"inverse_depth": np.full(count, 0.5)})},
        world_from_cam=lambda _: np.eye(4),
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
    )
    matches = Matches(points.astype(np.float64), np.ones(count))
    place = PlaceMatch(0, matches, Localization(np.eye(4), 1.0))
    tracemalloc.start()
    scale = relative_scale(graph, place, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert scale == 2.0
    assert peak < 50e6, "bytes"
