"""The readout time of a rolling shutter is found in the matches; a global shutter stays one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.camera import is_readout_time, told_readout_time
from mvsgs_core.datasets import open_dataset
from mvsgs_core.tracking.estimation import rolling_shutter
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, reproject
from mvsgs_core.tracking.estimation.rolling_shutter import camera_velocity, estimating_readout
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.steps import whole
from mvsgs_core.tracking.tracker import TrackerConfig
from tests.support.sequences import ate, track, tracked_room
from tests.support.shared_data import shared

SIZE = (120, 160)


def graph_of(
    readout_time: float, reads_columns: bool = False, count: int = 7, noise: float = 0.1
) -> tuple[KeyframeGraph, np.ndarray]:
    """Keyframes of a shaking camera whose lines are read within `readout_time` seconds, and their true poses."""
    random = np.random.default_rng(0)
    graph = KeyframeGraph(np.array([130.0, 130.0, 79.5, 59.5]))
    poses = geometry.se3_exp(random.normal(0.0, [0.1, 0.1, 0.03, 0.03, 0.03, 0.03], (count, 6)))
    for index in range(count):
        gray = random.integers(0, 255, SIZE, dtype=np.uint8)
        image = TrackingImage(index, index / 10.0, gray)
        image.velocity = np.tile(random.normal(0.0, 200.0, 2), (15, 20, 1)).astype(np.float32)
        depths = random.uniform(0.5, 1.5, 300)
        graph.add(Keyframe(image, poses[index], depths, np.full(300, 100.0), 0))
    graph.readout_time, graph.reads_columns = readout_time, reads_columns
    for a in range(count):
        for b in range(count):
            if a == b:
                continue
            keyframe, other = graph.keyframes[a], graph.keyframes[b].image
            pixels, _ = reproject(
                poses[[a, b]],
                keyframe.inverse_depth[None],
                graph.pixels(a)[None],
                graph.intrinsics,
                np.array([0]),
                np.array([1]),
            )
            target = pixels[0].T
            for _ in range(3):  # where it is seen depends on the line in which it is seen
                late = (target[:, :1] / SIZE[1] if reads_columns else target[:, 1:] / SIZE[0]) - 0.5
                target = pixels[0].T + readout_time * late * other.velocity_at(target)
            target = target + random.normal(0.0, noise, target.shape)
            inside = np.all((target > 0) & (target < [159, 119]), axis=1)
            graph.connect(a, b, Matches(target, inside.astype(np.float64), other.velocity_at(target)), 0.0)
    graph.readout_time, graph.reads_columns = 0.0, False
    return graph, poses


@pytest.mark.parametrize("reads_columns", [False, True])
@pytest.mark.parametrize("readout_time", [0.0, 0.01, 0.025, -0.01, -0.025])
def test_readout_is_found(readout_time: float, reads_columns: bool) -> None:
    graph, _ = graph_of(readout_time, reads_columns)
    assert len(graph.edges) > 20
    found = whole(estimating_readout(graph, graph.keyframes, threads=1))
    assert found.readout_time == pytest.approx(readout_time, abs=0.002)
    assert found.reads_columns == (reads_columns and readout_time != 0.0)
    assert (graph.readout_time, graph.reads_columns) == (0.0, False), "only the caller changes the graph"


def test_where_nothing_can_be_said_it_stays_what_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, _ = graph_of(0.01)
    graph.readout_time, graph.reads_columns = 0.02, True
    adjust = rolling_shutter.adjust
    monkeypatch.setattr(rolling_shutter, "adjust", lambda *given: replace(adjust(*given), failure="no"))
    assert whole(estimating_readout(graph, graph.keyframes, threads=1)) == (0.02, True)


def test_a_camera_upside_down_reads_its_last_row_first_and_is_told_so() -> None:
    assert told_readout_time(0.02) == "20.0 ms"
    assert told_readout_time(-0.0239, " a frame") == "23.9 ms a frame, the last row first"
    assert told_readout_time(0.02, reads_columns=True) == "20.0 ms, the first column first"
    assert told_readout_time(-0.02, reads_columns=True) == "20.0 ms, the last column first"
    assert [is_readout_time(s) for s in (-0.2, 0.0, 0.2, -0.21, 25.0, float("nan"))] == [True] * 3 + [False] * 3


@pytest.mark.parametrize("reads_columns", [False, True])
def test_poses_are_right_once_it_is_taken_out(reads_columns: bool) -> None:
    errors = {}
    for readout_time in (0.0, 0.025):
        graph, poses = graph_of(0.025, reads_columns)
        graph.readout_time, graph.reads_columns = readout_time, reads_columns
        indices = set(graph.keyframes)
        solver = Solver(steps=20, tolerance=0.0)
        assert not graph.optimize(indices, indices - {0, 1}, indices, solver).failure
        errors[readout_time] = max(np.abs(graph.keyframes[n].cam_from_world - poses[n]).max() for n in indices)
    assert errors[0.025] < 0.2 * errors[0.0]


def moving_keyframe(velocity: np.ndarray, outliers: float = 0.0) -> tuple[Keyframe, np.ndarray]:
    """A keyframe whose points move on the image as the camera moves; its intrinsics."""
    random = np.random.default_rng(1)
    lens = np.array([130.0, 135.0, 79.5, 59.5])
    image = TrackingImage(0, 0.0, random.integers(0, 255, SIZE, dtype=np.uint8))
    points, depth = image.cells.points, random.uniform(0.5, 3.0, 300)
    rays = np.stack([(points[:, 0] - lens[2]) / lens[0], (points[:, 1] - lens[3]) / lens[1], np.ones(300)], axis=1)
    step = 1e-6  # seconds
    now = rays * depth[:, None]
    later = (now - velocity[:3] * step) @ geometry.se3_exp(np.r_[np.zeros(3), velocity[3:] * step])[:3, :3]
    flow = (later[:, :2] / later[:, 2:] - now[:, :2] / now[:, 2:]) * lens[:2] / step
    wild = random.random(300) < outliers
    flow[wild] += random.normal(0.0, 300.0, (int(wild.sum()), 2))
    image.velocity = flow.reshape(15, 20, 2).astype(np.float32)
    return Keyframe(image, np.eye(4), 1.0 / depth, np.full(300, 1000.0), 0), lens


@pytest.mark.parametrize(("outliers", "off"), [(0.0, 1e-3), (0.3, 0.02)])
def test_the_cameras_velocity_is_found_in_the_flow(outliers: float, off: float) -> None:
    velocity = np.array([0.5, -0.3, 0.4, 0.3, -0.6, 0.2])
    keyframe, lens = moving_keyframe(velocity, outliers)
    found = camera_velocity(keyframe, lens)
    assert found is not None
    np.testing.assert_allclose(found, velocity, atol=off)


def test_without_flow_or_depth_no_velocity_is_known() -> None:
    keyframe, lens = moving_keyframe(np.ones(6))
    keyframe.information[20:] = 0.0
    assert camera_velocity(keyframe, lens) is None
    keyframe.information[:] = 1000.0
    keyframe.image.velocity = None
    assert camera_velocity(keyframe, lens) is None


@pytest.mark.slow
@pytest.mark.parametrize("turns", [1, 3])
def test_a_camera_that_is_held_upright_reads_columns(turns: int) -> None:
    """Freiburg1_xyz, whose camera reads rows within 24 ms, with every image turned: nobody tells it."""
    upright = []
    for item in open_dataset("tum", path=shared("data/tum_fr1_xyz"), size=(240, 320), stop=60):
        _, width = item.image.shape[:2]
        for _ in range(turns):
            fx, fy, cx, cy = item.intrinsics
            lens, width = np.array([fy, fx, cy, width - 1 - cx]), item.image.shape[0]
            item = replace(item, image=np.ascontiguousarray(np.rot90(item.image)), intrinsics=lens)
        upright.append(item)
    told, unaware = (track(upright, TrackerConfig(readout_time=time)) for time in (None, 0.0))
    graph = told[0].session.graph
    assert graph.reads_columns
    assert graph.readout_time == pytest.approx(0.024 if turns == 1 else -0.024, abs=0.004)
    assert ate(told[1], upright)[0] < 0.7 * ate(unaware[1], upright)[0]


@pytest.mark.slow
def test_the_synthetic_camera_has_a_global_shutter() -> None:
    tracker, _, _ = tracked_room()
    assert tracker.session.graph.readout_time == 0.0
