"""Edges of the map: those that the map says can be seen along."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from tests.support.true_maps import matcher, pose_error, tie, true_graph, true_pose


def test_an_edge_along_which_too_little_is_seen_is_not_matched() -> None:
    graph, search = true_graph(0, 4, 150), matcher()
    local_map = LocalMap(graph, search, LocalMapConfig(), 1)
    assert not local_map.match_edge(0, 150), "the other side of the room"
    assert search.calls == 0
    assert local_map.match_edge(0, 4)
    assert search.calls == 1


@pytest.mark.parametrize("unit", [1.0, 2000.0])
def test_what_is_a_thousand_times_as_far_as_what_set_the_unit_is_solved_as_well(unit: float) -> None:
    """As the ground below a drone did that took off."""
    graph = true_graph(0, 4, 8, unit=1.0 / unit)
    tie(graph, 0, 4, 8)
    tie(graph, 8, 4, 0)
    true = {index: graph.keyframes[index].inverse_depth for index in (0, 4, 8)}
    moved = np.eye(4)
    moved[:3, 3] = [0.01 * unit, 0.0, 0.0]
    graph.keyframes[4].cam_from_world = moved @ graph.keyframes[4].cam_from_world
    for keyframe in graph.keyframes.values():
        keyframe.inverse_depth = 1.1 * keyframe.inverse_depth
    assert not graph.optimize((0, 4, 8), {4}, {0, 4, 8}, Solver(steps=30, tolerance=1e-6)).failure
    assert pose_error(graph.keyframes[4].cam_from_world, true_pose(4, 1.0 / unit))[0] < 1e-3 * unit, "a millimeter"
    for index, depths in true.items():
        assert np.median(np.abs(graph.keyframes[index].inverse_depth / depths - 1.0)) < 1e-3
