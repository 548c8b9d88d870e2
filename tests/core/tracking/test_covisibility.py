"""A camera that goes around again: old keyframes are followed, and hardly any are added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.places.covisibility import CovisibilityConfig, CovisibleKeyframes
from mvsgs_core.tracking.tracker import TrackerConfig
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import ate, synthetic, track
from tests.support.true_maps import image, matcher, pose_error, shuffled, tie, true_graph, true_keyframe, true_pose

ROUND = 80  # frames of a round: every third of 240 of the room's loop


@pytest.mark.slow
def test_a_second_round_makes_few_keyframes_and_is_as_accurate() -> None:
    once = synthetic(frames=240, loop=True, stride=3)
    items = [replace(once[n % ROUND], index=n, timestamp=n / 7.0) for n in range(2 * ROUND)]
    tracker, trajectory, _ = track(items, TrackerConfig(covisibility=CovisibilityConfig(min_keyframes=24)))
    first, second = (int(half.sum()) for half in np.split(trajectory.keyframe, [ROUND]))
    assert first >= 24
    assert second <= 0.2 * first
    assert tracker.stats.skipped["keyframes spared by covisible ones"] >= 5
    assert np.isfinite(trajectory.world_from_cam).all(), "frames that see what old keyframes see have poses"
    assert (trajectory.state == TrackingState.TRACKED).all()
    assert tracker.session.publisher.published == set(trajectory.index[trajectory.keyframe].tolist()), (
        "no keyframe that was published is taken back"
    )
    error, length = ate(trajectory, items)
    assert error < 0.0003 * length
    again, length = ate(trajectory, items, trajectory.index >= ROUND)
    assert again < 0.0006 * length, "of the round that has hardly a keyframe of its own"


OLD, BETWEEN, NEWEST, FRAME = 100, 104, 108, 102
SMALL = CovisibilityConfig(min_keyframes=3, min_age=2)


def covisible(config: CovisibilityConfig = SMALL) -> CovisibleKeyframes:
    """Of three keyframes of a true map, each tied to the next; the newest is the reference."""
    graph = true_graph(OLD, BETWEEN, NEWEST)
    tie(graph, OLD, BETWEEN, NEWEST)
    made = CovisibleKeyframes(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), config, 1)
    for index in (OLD, BETWEEN, NEWEST):
        made.made(index)
    return made


@pytest.mark.slow
def test_the_nearest_old_keyframe_is_found_and_followed_for_longer() -> None:
    keyframes = covisible()
    found = keyframes.find(image(101), true_pose(101), NEWEST)
    assert found is not None
    assert found.index == OLD
    shift, turn = pose_error(found.localization.cam_from_world, true_pose(101))
    assert shift < 0.005, "meters"
    assert turn < 0.003
    assert keyframes.limit(OLD, 0.05) == SMALL.max_flow
    assert keyframes.limit(OLD, 0.5) == 0.5
    assert keyframes.limit(NEWEST, 0.05) == 0.05
    keyframes.made(112)
    assert keyframes.limit(OLD, 0.05) == 0.05


@pytest.mark.parametrize(
    "config",
    [
        replace(SMALL, min_keyframes=4),
        replace(SMALL, max_flow=0.0),
        replace(SMALL, max_flow=0.001),
        replace(SMALL, min_age=4),
        replace(SMALL, min_fraction=0.99),
        replace(SMALL, min_inliers=1.0),
        replace(SMALL, max_error=0.01),
    ],
)
def test_each_condition_binds(config: CovisibilityConfig) -> None:
    assert covisible().find(image(FRAME), true_pose(FRAME), NEWEST) is not None
    assert covisible(config).find(image(FRAME), true_pose(FRAME), NEWEST) is None


def test_keyframes_of_another_segment_are_not_covisible() -> None:
    keyframes = covisible()
    for number in (106, 107):  # so that there are enough of its own
        keyframes.graph.add(true_keyframe(number))
        keyframes.made(number)
    for number in (OLD, BETWEEN):
        keyframes.graph.keyframes[number].segment = 1
    assert keyframes.find(image(101), true_pose(101), NEWEST) is None


@pytest.mark.parametrize(("way", "found"), [((), False), ((106,), True), ((106, 107), False)])
def test_only_what_at_most_two_edges_tie_to_the_reference_is_covisible(way: tuple[int, ...], found: bool) -> None:
    keyframes = covisible(replace(SMALL, min_age=3))
    for number in (106, 107):
        keyframes.graph.add(true_keyframe(number))
        keyframes.made(number)
    keyframes.graph.edges.clear()
    if way:
        tie(keyframes.graph, OLD, *way, NEWEST)
    assert (keyframes.find(image(101), true_pose(101), NEWEST) is not None) == found


def test_a_map_that_contradicts_itself_is_not_reused() -> None:
    """Against the reference the camera is a few pixels from where the old keyframe sees it: a keyframe ties the two."""
    off = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0]))
    assert covisible().find(image(FRAME), off @ true_pose(FRAME), NEWEST) is None


def test_the_next_candidate_is_tried_where_the_nearest_does_not_verify() -> None:
    for most, wanted in ((2, BETWEEN), (1, None)):
        keyframes = covisible(replace(SMALL, max_candidates=most))
        keyframes.graph.keyframes[OLD].image = shuffled(OLD, OLD)
        found = keyframes.find(image(101), true_pose(101), NEWEST)
        assert (None if found is None else found.index) == wanted


def test_pyramids_are_kept_of_the_keyframe_that_is_followed_alone() -> None:
    keyframes = covisible()
    old = keyframes.graph.keyframes[OLD].image
    assert keyframes.find(image(101), true_pose(101), NEWEST) is not None
    assert "pyramid" in old.__dict__
    keyframes.made(112)
    assert "pyramid" not in old.__dict__
    refusing = covisible(replace(SMALL, min_fraction=0.99))
    assert refusing.find(image(101), true_pose(101), NEWEST) is None
    assert "pyramid" not in refusing.graph.keyframes[OLD].image.__dict__
