"""A lost camera in a map that is the truth: found where it is, not found where nothing speaks for it."""

from __future__ import annotations

import numpy as np

from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.places.relocalization import RelocalizationConfig, Relocalizer
from mvsgs_core.tracking.places.retrieval import Retrieval
from tests.support.true_maps import image, matcher, pose_error, shuffled, true_graph, true_pose

KEYFRAMES = (0, 60, 120, 180, 240)


def relocalizer(config: RelocalizationConfig | None = None) -> Relocalizer:
    graph, retrieval = true_graph(*KEYFRAMES), Retrieval()
    for number in KEYFRAMES:
        retrieval.add(number, graph.keyframes[number].image.features()[1])
    return Relocalizer(graph, matcher(), retrieval, config or RelocalizationConfig())


def noise() -> TrackingImage:
    pixels = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    return TrackingImage.of(500, 0.0, pixels, (240, 320), False)


def test_a_frame_is_found_at_its_place() -> None:
    lost = relocalizer()
    for number in KEYFRAMES:
        found = lost.relocalize(image(number + 4))
        assert found is not None
        assert found.index == number
        shift, turn = pose_error(found.localization.cam_from_world, true_pose(number + 4))
        assert shift < 0.005, "meters"
        assert turn < 0.003


def test_what_only_looks_alike_is_not_found() -> None:
    lost = relocalizer()
    assert lost.relocalize(noise()) is None
    assert lost.relocalize(shuffled(60, 500)) is None


def test_the_next_candidate_is_tried_where_the_first_is_refused() -> None:
    """The keyframe of the place has left the graph, or its depths are wrong: one beside it verifies."""
    for gone in (True, False):
        lost = relocalizer()
        neighbor = true_graph(76).keyframes[76]
        lost.graph.add(neighbor)
        lost.retrieval.add(76, neighbor.image.features()[1])
        query = image(68)
        first, second = lost.retrieval.query(query.features()[1], 2, set())
        assert {first, second} == {60, 76}
        if gone:
            lost.graph.remove(first)
        else:
            depths = lost.graph.keyframes[first].inverse_depth
            depths[:] = np.random.default_rng(0).permutation(depths)
        found = lost.relocalize(query)
        assert found is not None
        assert found.index == second


def test_only_so_many_candidates_are_tried() -> None:
    lost = relocalizer(RelocalizationConfig(max_candidates=1))
    lost.graph.remove(60)
    lost.graph.add(true_graph(64).keyframes[64])
    lost.retrieval.add(64, image(200).features()[1])  # it looks like another place: only a second try would find it
    assert lost.relocalize(image(61)) is None


def test_patience_ends_after_so_many_lost_frames_in_a_row() -> None:
    lost = relocalizer(RelocalizationConfig(patience=3))
    for _ in range(2):
        assert lost.lost(noise()) is None
    assert not lost.hopeless
    lost.found()
    for _ in range(2):
        assert lost.lost(noise()) is None
    assert not lost.hopeless
    assert lost.lost(noise()) is None
    assert lost.hopeless
    assert lost.lost(image(64)) is not None, "it is looked for all the same"
