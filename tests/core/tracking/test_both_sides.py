"""Frames between two keyframes are posed from both, where both agree on a pose."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.both_sides import WAITING, BothSides
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import FrameRecord, followed_pose
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.places.localization import localize
from mvsgs_core.trajectory import TrackingState
from tests.support.true_maps import exact_matches, image, matcher, pose_error, shuffled, true_graph, true_pose

BEFORE, FRAME, AFTER = 0, 4, 8
SOLVER = Solver(steps=8)


def followed(graph: KeyframeGraph, frame: TrackingImage, off: float = 0.01) -> FrameRecord:
    """A frame that was found against the keyframe before it, by matches that are off to one side: the pose is, too."""
    start = geometry.se3_exp(np.array([off, 0.0, 0.0, 0.0, 0.0, 0.0])) @ true_pose(FRAME)
    record = FrameRecord(frame.index, 0.0, TrackingState.TRACKED)
    record.follow(graph, BEFORE, exact_matches(graph, BEFORE, start), start, frame)
    return record


def shift(record: FrameRecord, graph: KeyframeGraph) -> float:
    """Meters that its pose is off."""
    pose = followed_pose(record, graph, SOLVER)
    assert pose is not None
    return pose_error(geometry.inverse(pose), true_pose(FRAME))[0]


def settled(graph: KeyframeGraph, frame: TrackingImage) -> tuple[FrameRecord, int]:
    sides, record = BothSides(graph, matcher(), 1), followed(graph, frame)
    sides.add(frame, record)
    return record, sum(job() for job in sides.settle([BEFORE, AFTER]))


def test_depths_of_one_keyframe_that_are_off_hurt_less_with_both() -> None:
    graph = true_graph(BEFORE, AFTER)
    graph.keyframes[BEFORE].inverse_depth = 1.06 * graph.keyframes[BEFORE].inverse_depth
    guess, _ = graph.predict_pose(BEFORE, true_pose(FRAME))
    matches, _ = matcher().match(graph.keyframes[BEFORE].image, image(FRAME), guess, 0.0)
    alone = localize(graph, BEFORE, matches, true_pose(FRAME), SOLVER)
    record, posed = settled(graph, image(FRAME))
    assert posed == 1
    assert record.after == AFTER
    assert shift(record, graph) < 0.7 * pose_error(alone.cam_from_world, true_pose(FRAME))[0]


def test_the_pose_is_found_anew_by_the_image() -> None:
    graph = true_graph(BEFORE, AFTER)
    before = shift(followed(graph, image(FRAME)), graph)
    record, _ = settled(graph, image(FRAME))
    assert before > 0.009
    assert shift(record, graph) < 0.003


def test_it_follows_either_keyframe_where_the_other_is_gone() -> None:
    graph = true_graph(BEFORE, AFTER)
    record, _ = settled(graph, image(FRAME))
    graph.remove(AFTER)
    assert shift(record, graph) < 0.004


def test_an_image_that_does_not_show_the_place_keeps_the_pose() -> None:
    graph = true_graph(BEFORE, AFTER)
    record, posed = settled(graph, shuffled(FRAME, FRAME))
    assert posed == 0
    assert record.after is None
    assert shift(record, graph) > 0.009


def test_a_keyframe_of_another_segment_says_nothing() -> None:
    graph = true_graph(BEFORE, AFTER)
    graph.keyframes[AFTER].segment = 1
    record, posed = settled(graph, image(FRAME))
    assert posed == 0
    assert record.after is None


def test_frames_after_the_last_keyframe_and_forgotten_ones_keep_their_pose() -> None:
    graph = true_graph(BEFORE, AFTER)
    sides, late = BothSides(graph, matcher(), 1), image(FRAME, AFTER + 1)
    record = followed(graph, late)
    sides.add(late, record)
    assert sides.settle([BEFORE, AFTER]) == []
    sides.add(image(FRAME), followed(graph, image(FRAME)))
    sides.forget()
    assert sides.settle([BEFORE, AFTER]) == []
    assert record.after is None


def test_a_frame_that_is_followed_anew_has_one_keyframe_again() -> None:
    graph = true_graph(BEFORE, AFTER)
    record, _ = settled(graph, image(FRAME))
    record.follow(graph, AFTER, exact_matches(graph, AFTER, true_pose(FRAME)), true_pose(FRAME), image(FRAME))
    assert (record.reference, record.after, record.points_after) == (AFTER, None, b"")


def test_images_that_wait_are_bounded_and_spread() -> None:
    sides, record = BothSides(true_graph(BEFORE), matcher(), 1), FrameRecord(0, 0.0, TrackingState.TRACKED)
    for index in range(5 * WAITING):
        sides.add(image(FRAME, index), record)
        assert len(sides._waiting) <= WAITING
    indices = list(sides._waiting)
    assert (indices[0], indices[-1]) == (0, 5 * WAITING - 1)
    assert np.diff(indices).max() <= 10


@pytest.mark.slow
def test_a_frame_that_two_keyframes_see_needs_two_kilobytes() -> None:
    graph, frame = true_graph(BEFORE, AFTER), image(FRAME)
    matches = [exact_matches(graph, index, true_pose(FRAME)) for index in (BEFORE, AFTER)]

    def both(index: int) -> FrameRecord:
        record = FrameRecord(index, 0.0, TrackingState.TRACKED)
        record.follow(graph, BEFORE, matches[0], true_pose(FRAME), frame)
        record.follow_both(graph, matches[0], AFTER, matches[1], true_pose(FRAME))
        return record

    for index in range(100):  # what images and NumPy keep
        both(index)
    tracemalloc.start()
    try:
        records = [both(index) for index in range(1000, 1100)]
        size, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert size / len(records) < 1750, "bytes"
