"""Edges of the map: those that the map says can be seen along."""

from __future__ import annotations

from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from tests.support.true_maps import matcher, true_graph


def test_an_edge_along_which_too_little_is_seen_is_not_matched() -> None:
    graph, search = true_graph(0, 4, 150), matcher()
    local_map = LocalMap(graph, search, LocalMapConfig(), 1)
    assert not local_map.match_edge(0, 150), "the other side of the room"
    assert search.calls == 0
    assert local_map.match_edge(0, 4)
    assert search.calls == 1
