"""What is kept of a frame's matches: little, and enough."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.datasets import open_dataset
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.covisibility import CovisibilityConfig
from mvsgs_core.tracking.places.localization import localize
from mvsgs_core.tracking.sample import restored, sample
from mvsgs_core.tracking.tracker import Tracker
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import tracked_room

pytestmark = pytest.mark.slow


def matches_of(reference: int, frame: int) -> tuple[Matches, np.ndarray]:
    """Noisy matches of a keyframe's points in another keyframe's image, and the pose that all of them give."""
    tracker, _, _ = tracked_room()
    graph = tracker.session.graph
    assert graph is not None
    expected, inside = graph.predict(reference, frame)
    noise = np.random.default_rng(1).normal(0, 0.5, expected.shape)
    weight = np.where(inside & graph.keyframes[reference].image.cells.textured, 1.0, 0.0)
    matches = Matches(np.where(weight[:, None] > 0, expected + noise, np.nan), weight)
    found = localize(graph, reference, matches, graph.keyframes[frame].cam_from_world, Solver(steps=8))
    return matches, found.cam_from_world


def test_a_few_points_give_the_pose_of_all() -> None:
    tracker, _, _ = tracked_room()
    graph = tracker.session.graph
    assert graph is not None
    reference, frame = sorted(graph.keyframes)[4:6]
    matches, pose = matches_of(reference, frame)
    few = restored(sample(graph, reference, matches, pose), len(matches.weight))
    assert 20 <= few.alive.sum() <= 48
    again = localize(graph, reference, few, pose, Solver(steps=8)).cam_from_world
    plain = localize(
        graph, reference, Matches(matches.target, matches.weight * few.alive), pose, Solver(steps=8)
    ).cam_from_world
    off = np.linalg.norm(geometry.se3_log(again @ geometry.inverse(pose)))
    assert off < 0.1 * np.linalg.norm(geometry.se3_log(plain @ geometry.inverse(pose)))


def test_a_camera_that_goes_to_and_fro_needs_no_memory_but_its_frames_kilobyte() -> None:
    """10,000 frames at constant keyframes are 10 MB: a tenth of the process."""
    items = list(open_dataset("synthetic", frames=30, threads=1, size=(96, 128)))
    order = [*range(30), *range(28, 0, -1)]
    tracker = Tracker(TrackerConfig(area=128 * 96, covisibility=CovisibilityConfig(min_keyframes=5)))
    sizes, keyframes = [], []
    tracemalloc.start()
    try:
        for n in range(8 * len(order) + 1):
            item = items[order[n % len(order)]]
            tracker.add(n, n / 20.0, item.image, item.intrinsics)
            if n in (4 * len(order), 8 * len(order)):
                keyframes.append(len(tracker.session.graph.keyframes))
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert keyframes[0] == keyframes[1] >= 5
    assert (sizes[1] - sizes[0]) / (4 * len(order)) < 1500, "bytes a frame"


def test_a_frame_needs_a_kilobyte() -> None:
    tracker, _, _ = tracked_room()
    graph = tracker.session.graph
    assert graph is not None
    reference, frame = sorted(graph.keyframes)[4:6]
    matches, pose = matches_of(reference, frame)
    image = graph.keyframes[frame].image
    FrameRecord(0, 0.0, TrackingState.TRACKED).follow(graph, reference, matches, pose, image)  # what images keep
    tracemalloc.start()
    try:
        records = []
        for n in range(1000, 1200):
            record = FrameRecord(n, n / 30.0, TrackingState.TRACKED)
            record.follow(graph, reference, matches, pose, image)
            records.append(record)
        gc.collect()  # what is no record's
        ours = [tracemalloc.Filter(True, where) for where in ("*/mvsgs_core/*", __file__)]  # not what NumPy's own keep
        kept = tracemalloc.take_snapshot().filter_traces(ours)
    finally:
        tracemalloc.stop()
    size = sum(trace.size for trace in kept.traces)
    assert size / len(records) > 1000, "what the filters pass"
    assert size / len(records) < 1400, "bytes, 185 of them for its light; all matches took 16,800"
