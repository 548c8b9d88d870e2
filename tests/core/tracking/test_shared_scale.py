"""Whether keyframes share one scale: by points that three of them see, and a start that lacks them gets weak edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.shared_scale import SHARED, share_scale
from tests.support.sequences import ate, track
from tests.support.shared_data import shared
from tests.support.true_maps import exact_matches, tie, true_graph

pytestmark = pytest.mark.slow


def found_in(graph: KeyframeGraph, source: int, to: int, points: np.ndarray) -> None:
    """An edge along which these points (M,) bool alone were found."""
    matches = exact_matches(graph, source, graph.keyframes[to].cam_from_world)
    some: Matches = replace(matches, weight=np.where(points, matches.weight, 0.0))
    assert graph.connect(source, to, some, 0.0)


def test_distances_are_tied_by_points_that_three_keyframes_see() -> None:
    for common, tied in ((SHARED - 1, False), (SHARED, True)):
        graph = true_graph(0, 4, 8)
        both = np.ones(len(graph.keyframes[4].points), bool)
        for to in (0, 8):
            both &= exact_matches(graph, 4, graph.keyframes[to].cam_from_world).alive
        number = np.cumsum(both) * both
        first, last = number.max() // 2, number.max()
        found_in(graph, 4, 0, (number > 0) & (number <= first))
        found_in(graph, 4, 8, (number > first - common) & (number <= last))
        assert share_scale(graph, [0, 4, 8]) == tied
        assert not share_scale(graph, [0, 4, 8, 12])


def test_ties_reach_from_keyframe_to_keyframe() -> None:
    graph = true_graph(0, 4, 8, 12)
    for start in (0, 4, 8):
        tie(graph, start, start + 4)
        tie(graph, start + 4, start)
    assert share_scale(graph, [0, 4, 8, 12])
    del graph.edges[8, 4]  # of 8's points those found in 12 alone are left, and 4's points are not found in 12
    assert share_scale(graph, [0, 4, 8])
    assert not share_scale(graph, [0, 4, 8, 12])
    assert not share_scale(graph, [0, 4, 12])


@pytest.mark.parametrize("start", [1, 2])
def test_a_start_while_the_head_turns_has_one_scale(start: int) -> None:
    """7.5 frames a second: without weak edges a part was 8 or 19 cm off, as of two scales."""
    items = list(open_dataset("tum", path=shared("data/hololens_000"), start=start, stride=4))
    _, trajectory, _ = track(items)
    for segment in np.unique(trajectory.segment[trajectory.segment >= 0]):
        error, _ = ate(trajectory, items, trajectory.segment == segment)
        assert error < 0.04, "meters"
