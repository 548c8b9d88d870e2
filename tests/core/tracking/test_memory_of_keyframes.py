"""What a keyframe of the tracker keeps once the camera has gone on: nothing of others, nothing that was lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.back_end import BackEnd, BackEndConfig
from mvsgs_core.tracking.edges import Edge
from mvsgs_core.tracking.image import RecentImages
from mvsgs_core.tracking.keyframes import Keyframe
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.photometer import Photometer
from mvsgs_core.tracking.publish import Publisher
from tests.support.true_maps import matcher, tie, true_graph

FRAMES = tuple(range(0, 24, 6))


def random_edge(points: int = 99) -> tuple[np.ndarray, np.ndarray, np.ndarray, Edge]:
    """Target, weight and velocity as an edge keeps them, and the edge; a third of the points is found."""
    random = np.random.default_rng(0)
    weight = np.where(random.random(points) < 1 / 3, random.uniform(0.1, 1.0, points), 0.0).astype(np.float16)
    target = np.where(weight > 0, random.uniform(0.0, 320.0, (2, points)), 0.0).astype(np.float32)
    velocity = np.where(weight > 0, random.normal(0.0, 5.0, (2, points)), 0.0).astype(np.float16)
    return target, weight, velocity, Edge(target, weight, velocity, 0.4)


def test_an_edge_gives_back_to_the_bit_what_was_found_and_keeps_no_more() -> None:
    target, weight, velocity, edge = random_edge()
    for given, kept in ((target, edge.target), (weight, edge.weight), (velocity, edge.velocity)):
        assert kept.dtype == given.dtype
        np.testing.assert_array_equal(kept, given)
    assert edge.matches == np.count_nonzero(weight)
    kept = [edge._found, edge._target, edge._weight, edge._velocity]
    assert all(values.base is None for values in kept)
    assert sum(values.nbytes for values in kept) == -(-len(weight) // 8) + 14 * edge.matches


def test_a_keyframe_keeps_nothing_of_those_that_it_was_solved_with() -> None:
    graph = true_graph(*FRAMES)
    for a in FRAMES:
        for b in FRAMES:
            if a != b:
                tie(graph, a, b)
    maps = LocalMap(graph, matcher(), LocalMapConfig(), 1)
    publisher = Publisher(graph, 0.01)
    publisher.publish_all(list(FRAMES), settled=True)
    before = graph.keyframes[FRAMES[-1]].inverse_depth
    assert not maps.adjust_window(FRAMES[-1]).failure
    graph.rescale(FRAMES, 2.0)  # so that all have moved, and go out
    assert publisher.corrections() is not None
    for keyframe in graph.keyframes.values():
        assert keyframe.inverse_depth is not before
        assert all(a.base is None for a in (keyframe.inverse_depth, keyframe.information, keyframe.cam_from_world))
        looked_at = publisher._published[keyframe.index].looked_at
        assert any(part is keyframe.inverse_depth for part in looked_at)  # and not what it was before


def computed(keyframe: Keyframe) -> bool:
    return "pyramid" in keyframe.image.__dict__


def test_keyframes_outside_the_window_forget_what_was_computed_of_them() -> None:
    graph = true_graph(*FRAMES)
    maps = LocalMap(graph, matcher(), LocalMapConfig(window=2), 1)
    for a, b in ((0, 6), (6, 12), (12, 18)):
        assert maps.match_edge(a, b)
    assert all(map(computed, graph.keyframes.values()))
    maps.release_images(0)
    assert [index for index in FRAMES if computed(graph.keyframes[index])] == [12, 18]
    assert maps.match_edge(18, 0)  # an old one is seen again
    maps.release_images(0)
    assert [index for index in FRAMES if computed(graph.keyframes[index])] == [12, 18]


def test_of_frames_that_are_gone_nothing_is_kept() -> None:
    graph, match = true_graph(*FRAMES), matcher()
    keyframe = graph.keyframes[FRAMES[0]].image
    for index in range(100, 110):
        match.match(keyframe, replace(keyframe, index=index), keyframe.cells.points, 0.0)
    assert list(match.used) == [keyframe.index]
    maps = LocalMap(graph, match, LocalMapConfig(), 1)
    maps.release_images_but({keyframe.index})
    assert "pyramid" in keyframe.__dict__
    maps.release_images_but(set())
    assert "pyramid" not in keyframe.__dict__
    assert len(match.used) == 0


def test_the_end_of_a_stream_computes_of_few_images_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecentImages, "LIMIT", 2)
    graph = true_graph(*FRAMES)
    back = BackEnd(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), BackEndConfig(), 1)
    stats = Stats()
    back.put_right(0, stats)
    assert stats.counts["edges by proximity"] >= len(FRAMES)
    assert sum(map(computed, graph.keyframes.values())) <= 2


def test_light_is_compared_of_few_images_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecentImages, "LIMIT", 2)
    graph = true_graph(*FRAMES)
    tie(graph, *FRAMES)
    Photometer(graph, Stats()).update()
    assert sum("levels" in keyframe.image.__dict__ for keyframe in graph.keyframes.values()) == 2
