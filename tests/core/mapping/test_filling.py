"""Where the filters left no depth, splats come from the depth before them, if the map shows nothing or it is likely."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.filling import continued_depth
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_maps import CONFIG, FINE, RARE, mapped, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

HOLE = slice(20, 44)  # columns of the 64 in which a filter left nothing


def with_hole(index: int, t: float, hole: slice = HOLE) -> RGBDKeyframe:
    view = rgbd_keyframe(index, pose_on_arc(t))
    depth, normals = view.depth.copy(), np.array(view.normals)
    depth[:, hole], normals[:, hole] = 0.0, 0.0
    confidence = np.where(depth > 0, 0.9, 0.2).astype(np.float32)
    return replace(view, depth=depth, normals=normals, confidence=confidence, unfiltered=view.depth)


def mapper_with(doubtful: bool, iterations: int = 30) -> OnlineMapper:
    insertion = InsertionConfig(doubtful=doubtful)
    config = MapperConfig(iterations=iterations, threads=1, insertion=insertion, density_control=RARE, device="cpu")
    return OnlineMapper(config)


def test_a_hole_of_the_filters_is_covered_sparsely() -> None:
    opacity, added = {}, {}
    for doubtful in (False, True):
        mapper = mapper_with(doubtful)
        added[doubtful] = mapper.add_keyframe(with_hole(0, 0.5))
        opacity[doubtful] = mapper.render(mapper.views[0]).opacity.numpy()[:, HOLE]
        assert mapper.log.counts["pixels_filled"] == (48 * 24 if doubtful else 0)
    assert 0 < added[True] - added[False] < 48 * 24 / 4
    assert (opacity[False] < 0.5).mean() > 0.7
    assert (opacity[True] < 0.5).mean() < 0.2


def test_a_hole_in_depth_without_that_before_the_filters_is_covered_too() -> None:
    """As a depth camera or a user's own node gives it: what surrounds the hole goes on."""
    view = replace(with_hole(0, 0.5), unfiltered=None)
    assert view.confidence is not None
    for each in (view, replace(view, confidence=None)):
        mapper = mapper_with(True)
        mapper.add_keyframe(each)
        assert mapper.log.counts["pixels_filled"] == 48 * 24
        assert (mapper.render(mapper.views[0]).opacity.numpy()[:, HOLE] < 0.5).mean() < 0.2
    shown = mapper_with(True, iterations=60)
    shown.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.5)))
    shown.add_keyframe(replace(view, index=5, image=255 - view.image, confidence=np.ones_like(view.confidence)))
    assert shown.log.counts["pixels_filled"] == 0  # its confidence says nothing of depth that is not there


def test_what_the_map_shows_is_not_filled() -> None:
    mapper = mapper_with(True, iterations=60)
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.5)))
    mapper.add_keyframe(with_hole(5, 0.5))
    assert mapper.log.counts["pixels_filled"] == 0


@pytest.mark.parametrize(("confidence", "used"), [(0.5, False), (0.7, True), (None, False)])
def test_what_the_map_shows_otherwise_is_filled_where_doubtful_depth_is_likely(
    confidence: float | None, used: bool
) -> None:
    mapper = mapper_with(True, iterations=60)
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.5)))
    view = with_hole(5, 0.5)
    other = view.image.copy()
    other[:, HOLE][:, ::4] = 255 - other[:, HOLE][:, ::4]
    sure = None if confidence is None else np.full(view.depth.shape, confidence, np.float32)
    mapper.add_keyframe(replace(view, image=other, confidence=sure))
    assert (mapper.log.counts["pixels_filled"] > 0) == used


def test_a_view_between_keyframes_with_holes_is_rendered_better() -> None:
    views = [with_hole(5 * k, t, slice(14, 50)) for k, t in enumerate((0.4, 0.5, 0.6))]
    between = rgbd_keyframe(99, pose_on_arc(0.45))
    without = mapped(views, replace(CONFIG, insertion=replace(FINE, doubtful=False)))
    filled = score(mapped(views), between)
    assert filled > score(without, between) + 5.0
    assert filled > 39.5


def test_a_corrected_scale_holds_for_the_filling_too() -> None:
    view = with_hole(0, 0.5)
    mapper = mapper_with(True)
    pose = view.world_from_cam.copy()
    pose[:3, 3] *= 2.0
    mapper.correct(np.array([0]), pose[None], np.array([2.0]))
    mapper.add_keyframe(view)
    plain = mapper_with(True)
    plain.add_keyframe(view)
    ratio = mapper.snapshot().splats.means.norm(dim=1) / plain.snapshot().splats.means.norm(dim=1)
    np.testing.assert_allclose(ratio.numpy(), 2.0, rtol=1e-4)


def test_depth_that_is_not_finite_is_refused_and_what_surrounds_it_goes_on() -> None:
    view = with_hole(0, 0.5)
    assert view.unfiltered is not None
    broken = view.unfiltered.copy()
    broken[:, HOLE] = np.nan
    mapper = mapper_with(True)
    mapper.add_keyframe(replace(view, unfiltered=broken))
    assert mapper.log.counts["refused_depths"] == 48 * 24
    assert mapper.log.counts["pixels_filled"] == 48 * 24
    assert torch.isfinite(mapper.state.splats.means).all()


def test_where_matching_says_nothing_what_surrounds_it_goes_on() -> None:
    """A strip that no other view sees: its depth is noise, and its confidence says so."""
    view = rgbd_keyframe(0, pose_on_arc(0.5))
    strip = np.zeros(view.depth.shape, dtype=bool)
    strip[:, 52:] = True
    random = np.random.default_rng(0)
    depth = np.where(strip, random.uniform(0.1, 20.0, strip.shape), view.depth).astype(np.float32)
    confidence = np.where(strip, 0.05, 0.9).astype(np.float32)
    nothing = np.zeros_like(view.depth)
    continued = continued_depth(depth, confidence, nothing, view.image / 255.0)
    np.testing.assert_array_equal(continued[~strip], view.depth[~strip])
    error = np.abs(continued / view.depth - 1.0)[strip]
    assert np.median(error) < 0.1 < 0.5 < np.median(np.abs(depth / view.depth - 1.0)[strip])
    filtered = np.where(strip, 0.0, view.depth).astype(np.float32)
    mapper = mapper_with(True)
    mapper.add_keyframe(replace(view, depth=filtered, normals=None, confidence=confidence, unfiltered=depth))
    opacity = mapper.render(mapper.views[0]).opacity.numpy()
    assert (opacity > 0.5).mean() > 0.99
    assert mapper.log.counts["pixels_filled"] == 48 * 12


def test_what_the_map_shows_goes_on_where_a_view_has_no_depth_at_all() -> None:
    """A camera that only turned: no neighbor has a baseline, but a part of its view is mapped."""
    first = rgbd_keyframe(0, pose_on_arc(0.5))
    mapper = mapper_with(True)
    mapper.add_keyframe(first)
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.25, 0.0]))[0]
    turned = rgbd_keyframe(5, first.world_from_cam @ turn)
    nothing = np.zeros_like(turned.depth)
    shown = mapper.add_keyframe(replace(turned, depth=nothing, normals=None, confidence=nothing, unfiltered=nothing))
    assert shown > 0
    assert (mapper.render(mapper.views[1]).opacity.numpy() > 0.5).mean() > 0.99


def test_doubtful_depth_is_mapped_where_the_filters_kept_nothing() -> None:
    view = rgbd_keyframe(0, pose_on_arc(0.5))
    low, nothing = np.full(view.depth.shape, 0.1, np.float32), np.zeros_like(view.depth)
    mapper = mapper_with(True)
    added = mapper.add_keyframe(replace(view, depth=nothing, normals=None, confidence=low, unfiltered=view.depth))
    assert 0 < added < 48 * 64 / 4
    assert mapper.frame.unit == pytest.approx(float(np.median(view.depth)))
    assert (mapper.render(mapper.views[0]).opacity.numpy() > 0.5).mean() > 0.99


def test_a_view_without_any_depth_adds_nothing_to_an_empty_map() -> None:
    view = rgbd_keyframe(0, pose_on_arc(0.5))
    nothing = np.zeros_like(view.depth)
    mapper = mapper_with(True)
    assert mapper.add_keyframe(replace(view, depth=nothing, confidence=nothing, unfiltered=nothing)) == 0
    assert not continued_depth(nothing, nothing, nothing, view.image / 255.0).any()
