"""tracker=photographs: messages in, messages out, on real photographs; and the part of the core that makes them."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

import msgs
from msgs import (
    CameraPose,
    Frame,
    Keyframe,
    Poses,
    Request,
    TrackedFrame,
    TrackerPhase,
    TrackingState,
    Trajectory,
)
from mvsgs_core import geometry
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.export.source_camera import PHOTOGRAPHS
from mvsgs_core.held_out import is_held_out
from mvsgs_core.photographs.config import PhotographsConfig
from nodes import handlers, outputs
from nodes.photographs_tracker import KEPT, PhotographsTracker
from tests.support.photograph_ring import position_error
from tests.support.shared_data import shared


@functools.cache
def fountain() -> tuple[Item, ...]:
    return tuple(open_dataset("images", path=shared("data/strecha/fountain-P11"), size=240_000))


def run(
    items: Sequence[Item], factor: float = 1.0, guessed: bool = False
) -> tuple[PhotographsTracker, list[msgs.Message], list[Frame]]:
    """The node on these photographs, by their order; factor: on their focal lengths."""
    node = PhotographsTracker()
    frames = [
        Frame(n, n / 30.0, item.image, item.intrinsics * [factor, factor, 1.0, 1.0], guessed)
        for n, item in enumerate(items)
    ]
    sent = [m for frame in frames for m in node.on_frame(frame)]
    assert not sent  # nothing is known before the last one
    return node, list(node.on_end()), frames


@functools.cache
def solved() -> tuple[PhotographsTracker, list[msgs.Message], list[Frame]]:
    return run(fountain())


def cam_from_world(items: Sequence[Item]) -> np.ndarray:
    return geometry.inverse(np.stack([item.world_from_cam for item in items if item.world_from_cam is not None]))


def test_contract() -> None:
    assert handlers(PhotographsTracker).keys() == {Frame, Request}
    assert set(outputs(PhotographsTracker)) == {
        Keyframe, Poses, TrackedFrame, CameraPose, TrackerPhase, Trajectory, Request,
    }  # fmt: skip
    assert not PhotographsTracker.in_stream_order


@pytest.mark.slow
def test_all_photographs_have_poses_and_those_held_out_are_no_keyframes() -> None:
    _, sent, frames = solved()
    *keyframes, trajectory = sent
    assert isinstance(trajectory, Trajectory)
    assert all(isinstance(m, Keyframe) for m in keyframes)
    indices = [m.index for m in keyframes if isinstance(m, Keyframe)]
    assert sorted(indices) == [n for n in range(len(frames)) if not is_held_out(n)]
    assert trajectory.index.tolist() == list(range(len(frames)))
    assert trajectory.index[trajectory.keyframe].tolist() == sorted(indices)
    assert set(trajectory.state.tolist()) == {TrackingState.TRACKED}
    assert set(trajectory.segment.tolist()) == {0}
    found = geometry.inverse(trajectory.world_from_cam)
    assert position_error(found, cam_from_world(fountain())) < 0.003
    for m in keyframes:
        assert isinstance(m, Keyframe)
        np.testing.assert_array_equal(m.world_from_cam, trajectory.world_from_cam[m.index])
        assert m.exposure is not None
        assert trajectory.exposure is not None
        np.testing.assert_array_equal(m.exposure, trajectory.exposure[m.index])
    assert trajectory.exposure is not None
    assert np.isfinite(trajectory.exposure).all()  # of those held out, too


@pytest.mark.slow
def test_coarse_depth_fits_the_poses() -> None:
    """Points of a keyframe fall on points of its neighbors of the same depth."""
    _, sent, frames = solved()
    keyframes = [m for m in sent if isinstance(m, Keyframe)]
    for m in keyframes:
        assert m.inverse_depth.dtype == m.inverse_depth_weight.dtype == np.float32
        known = m.inverse_depth > 0
        assert known.sum() > 50
        np.testing.assert_array_equal(known, m.inverse_depth_weight > 0)
        assert m.inverse_depth_weight.max() <= 1
        assert m.image.shape == frames[m.index].image.shape
    assert 0.5 < 1.0 / np.median(keyframes[0].inverse_depth[keyframes[0].inverse_depth > 0]) < 2.0  # the unit
    here, there = keyframes[0], keyframes[1]
    rows, columns = here.inverse_depth.shape
    size = (frames[0].image.shape[0], frames[0].image.shape[1])
    fx, fy, cx, cy = scale_intrinsics(here.intrinsics, size, (rows, columns))
    v, u = np.nonzero(here.inverse_depth)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))], axis=1) / here.inverse_depth[v, u][:, None]
    moved = geometry.inverse(there.world_from_cam) @ here.world_from_cam
    seen = rays @ moved[:3, :3].T + moved[:3, 3]
    x = np.rint(fx * seen[:, 0] / seen[:, 2] + cx).astype(int)
    y = np.rint(fy * seen[:, 1] / seen[:, 2] + cy).astype(int)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows) & (seen[:, 2] > 0)
    other = there.inverse_depth[y[inside], x[inside]]
    both = other > 0
    assert both.sum() > 30
    assert np.median(np.abs(other[both] * seen[inside][both, 2] - 1.0)) < 0.03


@pytest.mark.slow
def test_any_order_and_an_unknown_focal_length() -> None:
    order = np.random.default_rng(0).permutation(len(fountain()))
    items = [fountain()[n] for n in order]
    node, sent, _ = run(items, factor=0.8, guessed=True)
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    assert np.isfinite(trajectory.world_from_cam).all()
    assert position_error(geometry.inverse(trajectory.world_from_cam), cam_from_world(items)) < 0.004
    assert abs(0.8 * trajectory.focal_factor - 1.0) < 0.02
    keyframe = next(m for m in sent if isinstance(m, Keyframe))
    assert abs(keyframe.intrinsics[0] / items[keyframe.index].intrinsics[0] - 1.0) < 0.03
    assert node.stats.counts["keyframes"] == sum(isinstance(m, Keyframe) for m in sent)
    assert node.stats.values[PHOTOGRAPHS][0] == trajectory.focal_factor


def test_photographs_of_nothing_say_so() -> None:
    node = PhotographsTracker()
    (trajectory,) = list(node.on_end())
    assert isinstance(trajectory, Trajectory)
    assert len(trajectory.index) == 0
    random = np.random.default_rng(0)
    node = PhotographsTracker()
    for n in range(3):
        image = random.integers(0, 256, (120, 160, 3), np.uint8)
        assert not list(node.on_frame(Frame(n, float(n), image, np.array([120.0, 120.0, 79.5, 59.5]))))
    (trajectory,) = list(node.on_end())
    assert isinstance(trajectory, Trajectory)
    assert set(trajectory.state.tolist()) == {TrackingState.LOST}
    assert np.isnan(trajectory.world_from_cam).all()
    assert "no photograph has a pose, of 3" in node.stats.values["nothing"]


@pytest.mark.slow
def test_three_photographs_are_enough() -> None:
    _, sent, _ = run(fountain()[:3])
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    assert trajectory.keyframe.all()
    assert np.isfinite(trajectory.world_from_cam).all()


def test_fewer_than_three_photographs_say_so() -> None:
    node, _, _ = run(fountain()[:2])
    assert "no photograph has a pose, of 2: 3 or more of one scene are needed" in node.stats.values["nothing"]


def zoomed(item: Item, crop: float) -> Item:
    """As taken with 1 / crop times the focal length."""
    height, width = item.image.shape[:2]
    rows, columns = round(0.5 * (1.0 - crop) * height), round(0.5 * (1.0 - crop) * width)
    inner = item.image[rows : height - rows, columns : width - columns]
    return replace(item, image=cv2.resize(inner, (width, height), interpolation=cv2.INTER_LANCZOS4))


@pytest.mark.slow
def test_each_part_has_its_own_lens() -> None:
    """Of two cameras: the keyframes of each are as its own lens sees; the trajectory has the larger part's."""
    other = open_dataset("images", path=shared("data/strecha/Herz-Jesus-P8"), size=240_000, stop=5)
    node, sent, frames = run([*fountain()[:6], *(zoomed(item, 0.72) for item in other)])
    *keyframes, trajectory = sent
    assert isinstance(trajectory, Trajectory)
    assert "the photographs fall into 2 parts that share too little" in node.stats.warnings
    focal: dict[int, list[float]] = {0: [], 1: []}
    for m in keyframes:
        assert isinstance(m, Keyframe)
        focal[m.segment].append(m.intrinsics[0] / frames[m.index].intrinsics[0])
    factors = [float(np.median(focal[part])) for part in (0, 1)]
    assert abs(factors[trajectory.segment[1]] - 1.0) < 0.05
    assert abs(factors[trajectory.segment[-1]] * 0.72 - 1.0) < 0.05
    assert abs(trajectory.focal_factor / factors[0] - 1.0) < 0.05
    assert any("by the photographs, the focal length is" in w for w in node.stats.warnings) == (
        trajectory.segment[-1] == 0
    )


@pytest.mark.slow
def test_a_focal_length_that_the_photographs_contradict_is_told_of() -> None:
    told = "by the photographs, the focal length is"
    assert not any(told in w for w in solved()[0].stats.warnings)
    node, _, _ = run(fountain(), factor=0.6)
    assert any(told in w and "times the one that is said to be known" in w for w in node.stats.warnings)


def test_numbers_of_which_nothing_can_come_are_refused() -> None:
    with pytest.raises(ValueError, match=r"tracker\.features=10"):
        PhotographsConfig(features=10)
    with pytest.raises(ValueError, match=r"tracker\.neighbors=1"):
        PhotographsConfig(neighbors=1)


def test_lenses_that_differ_take_no_more_memory_and_are_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with intrinsics of each photograph."""
    node = PhotographsTracker()
    monkeypatch.setattr(node.core, "keyframe_lens", lambda index: (1.0, -0.1, 0.0))
    image = np.zeros((48, 64, 3), np.uint8)
    for n in range(10):
        lens = node._undistortion(Frame(n, float(n), image, np.array([60.0 + n, 60.0 + n, 31.5, 23.5]), False))
        assert lens.image(image).shape == image.shape
    assert len(node._lenses) == KEPT
    assert sum("distorted" in text for text in node.stats.warnings) == 1


def test_the_lens_that_is_told_is_the_one_to_give_in_pixels_of_the_original_photographs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Read with it, the photographs come as they leave here."""
    node = PhotographsTracker()
    monkeypatch.setattr(node.core, "keyframe_lens", lambda index: (1.2, -0.1, 0.02))
    original, size, delivered = np.array([150.0, 150.0, 95.5, 71.5]), (144, 192), (48, 64)
    image, came = np.zeros((*delivered, 3), np.uint8), scale_intrinsics(original, size, delivered)
    found = node._undistortion(Frame(0, 0.0, image, came, True, original_intrinsics=original))
    (warning,) = node.stats.warnings
    intrinsics, distortion = ([float(v) for v in text.split(",")] for text in re.findall(r"=\[(.+?)\]", warning))
    assert intrinsics == [180.0, 180.0, 95.5, 71.5]
    lens, _ = lens_from_option(intrinsics, distortion, size)
    read = Framing(delivered).image(np.zeros((*size, 3), np.uint8), lens, delivered)[1]
    np.testing.assert_allclose(read, found.intrinsics, rtol=0.01)
