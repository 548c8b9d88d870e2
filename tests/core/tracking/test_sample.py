"""What is kept of a frame's matches: little, and enough."""

from __future__ import annotations

import gc
import tracemalloc
from types import SimpleNamespace
from typing import Any

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
from mvsgs_core.tracking.sample import _packed, restored, sample
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
    few = restored(sample(graph, reference, matches, pose), graph.keyframes[reference])
    assert 20 <= few.alive.sum() <= 48
    again = localize(graph, reference, few, pose, Solver(steps=8)).cam_from_world
    plain = localize(
        graph, reference, Matches(matches.target, matches.weight * few.alive), pose, Solver(steps=8)
    ).cam_from_world
    off = np.linalg.norm(geometry.se3_log(again @ geometry.inverse(pose)))
    assert off < 0.1 * np.linalg.norm(geometry.se3_log(plain @ geometry.inverse(pose)))


@pytest.mark.parametrize(("size", "each"), [((240, 320), 10), ((240, 464), 10), ((2048, 2064), 12)])
def test_points_come_back_where_they_were(size: tuple[int, int], each: int) -> None:
    """Of large images, too, whose cells are more than two bytes count; and of those just beside an image."""
    cells = size[0] // 8 * size[1] // 8
    keyframe: Any = SimpleNamespace(image=SimpleNamespace(size=size), inverse_depth=np.ones(cells))
    chosen = np.array([0, 17, cells // 2, cells - 1])
    target = np.array([[-3.27, -0.4], [100.123, 55.567], [size[1] + 7.3, 3.0], [1e9, -1e9]])
    packed = _packed(chosen, target, np.full((4, 2), 0.25), keyframe)
    assert len(packed) == 4 * each
    found = restored(packed, keyframe)
    assert np.flatnonzero(found.alive).tolist() == chosen.tolist()
    assert np.abs(found.target[chosen[:3]] - target[:3]).max() <= 2.0 ** -(8 if max(size) < 464 else 5)
    np.testing.assert_array_equal(np.sign(found.target[cells - 1] - [size[1], 0]), [1, -1], "far out stays out")
    assert found.velocity is not None
    assert (found.velocity[chosen] == 0.25).all()


def test_a_camera_that_goes_to_and_fro_needs_no_memory_but_its_frames_kilobyte() -> None:
    """10,000 frames at constant keyframes are 10 MB: a tenth of the process. Once what is kept of the newest frames and
    for the keyframes, which is bounded, has grown to that."""
    items = list(open_dataset("synthetic", frames=30, threads=1, size=(96, 128)))
    order = [*range(30), *range(28, 0, -1)]
    tracker = Tracker(TrackerConfig(area=128 * 96, covisibility=CovisibilityConfig(min_keyframes=5)))
    sizes, keyframes = [], []
    tracemalloc.start()
    try:
        for n in range(16 * len(order) + 1):
            item = items[order[n % len(order)]]
            tracker.add(n, n / 20.0, item.image, item.intrinsics)
            if n in (8 * len(order), 16 * len(order)):
                keyframes.append(len(tracker.session.graph.keyframes))
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert keyframes[0] == keyframes[1] >= 5
    assert (sizes[1] - sizes[0]) / (8 * len(order)) < 1200, "bytes a frame"


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
    assert size / len(records) < 1200, "bytes, 257 of them for its light; all matches took 16,800"
