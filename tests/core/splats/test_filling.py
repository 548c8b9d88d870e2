"""Where the filters left no depth and the map shows nothing, sparse splats come from the depth before them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import camera
from mvsgs_core.splats.filling import fill_points
from mvsgs_core.splats.insertion import InsertionConfig
from mvsgs_core.splats.keyframes import PosedView
from mvsgs_core.splats.mapper import MapperConfig, OnlineMapper
from mvsgs_core.splats.training import TrainingConfig
from tests.core.splats.test_mapper import CONFIG, mapped, score
from tests.core.splats.tiny_scene import pose_on_arc, posed_view

HOLE = slice(20, 44)  # columns of the 64 in which a filter left nothing


def with_hole(index: int, t: float) -> PosedView:
    view = posed_view(index, pose_on_arc(t))
    depth, normals = view.depth.copy(), np.array(view.normals)
    depth[:, HOLE], normals[:, HOLE] = 0.0, 0.0
    confidence = np.where(depth > 0, 0.9, 0.2).astype(np.float32)
    return replace(view, depth=depth, normals=normals, confidence=confidence, unfiltered=view.depth)


def mapper_with(fill: int) -> OnlineMapper:
    config = MapperConfig(training=TrainingConfig(threads=1), insertion=InsertionConfig(fill=fill))
    return OnlineMapper(config)


def test_a_point_stands_for_its_cell() -> None:
    view = posed_view(0, pose_on_arc(0.4), (30, 41))  # neither side is a multiple of 4
    colors = view.image / 255.0
    empty = np.zeros((30, 41), dtype=bool)
    empty[4:12, 8:16] = True
    confidence = np.full((30, 41), 0.5, dtype=np.float32)
    points = fill_points(view.depth, confidence, view.intrinsics, colors, empty, 4)
    assert len(points) == 4
    centers = camera.project(points.positions, view.intrinsics)
    np.testing.assert_allclose(centers, [[9.5, 5.5], [13.5, 5.5], [9.5, 9.5], [13.5, 9.5]], atol=1e-3)
    np.testing.assert_allclose(points.colors[0], colors[4:8, 8:12].mean(axis=(0, 1)))
    np.testing.assert_allclose(points.spacing, 4 * points.positions[:, 2] / view.intrinsics[0])
    assert not points.normals.any()


def test_the_most_confident_depth_of_a_cell_is_taken_and_never_one_that_is_not_empty() -> None:
    depth, confidence = np.full((4, 8), 2.0), np.full((4, 8), 0.3)
    depth[1, 2], confidence[1, 2] = 3.0, 0.4
    depth[2, 3], confidence[2, 3] = 5.0, 0.9  # not empty
    depth[3, 3], confidence[3, 3] = 0.0, 0.9  # unknown
    empty = np.ones((4, 8), dtype=bool)
    empty[2, 3] = False
    empty[:, 4:] = np.arange(16).reshape(4, 4) < 7  # less than half
    intrinsics = np.array([10.0, 10.0, 3.5, 1.5])
    points = fill_points(depth, confidence, intrinsics, np.zeros((4, 8, 3)), empty, 4)
    assert points.positions[:, 2].tolist() == [3.0]
    assert len(fill_points(0.0 * depth, confidence, intrinsics, np.zeros((4, 8, 3)), empty, 4)) == 0


def test_a_hole_of_the_filters_is_covered_sparsely() -> None:
    opacity = {}
    for fill in (0, 4):
        mapper = mapper_with(fill)
        mapper.add_view(with_hole(0, 0.5))
        opacity[fill] = mapper.render(mapper.views[0]).opacity.numpy()[:, HOLE]
        assert mapper.log.counts.get("filled", 0) == (12 * 6 if fill else 0)
    assert mapper.state.splats.opacity_logits[-72:].sigmoid().detach().numpy() == pytest.approx(0.4)
    assert (opacity[0] < 0.5).mean() > 0.8
    assert (opacity[4] < 0.5).mean() < 0.2


def test_what_the_map_shows_is_not_filled() -> None:
    mapper = mapper_with(4)
    mapper.add_view(posed_view(0, pose_on_arc(0.5)))
    mapper.add_view(with_hole(5, 0.5))
    assert mapper.log.counts["filled"] == 0


def test_a_view_between_keyframes_with_holes_is_rendered_better() -> None:
    views = [with_hole(5 * k, t) for k, t in enumerate((0.4, 0.5, 0.6))]
    between = posed_view(99, pose_on_arc(0.45))
    without = mapped(views, replace(CONFIG, insertion=InsertionConfig(fill=0)))
    assert score(mapped(views), between) > score(without, between) + 2.0


def test_a_corrected_scale_holds_for_the_filling_too() -> None:
    view = with_hole(0, 0.5)
    mapper = mapper_with(4)
    pose = view.world_from_cam.copy()
    pose[:3, 3] *= 2.0
    mapper.correct(np.array([0]), pose[None], np.array([2.0]))
    mapper.add_view(view)
    plain = mapper_with(4)
    plain.add_view(view)
    ratio = mapper.snapshot().splats.means.norm(dim=1) / plain.snapshot().splats.means.norm(dim=1)
    np.testing.assert_allclose(ratio.numpy(), 2.0, rtol=1e-4)


def test_depth_that_is_not_finite_is_refused_and_fills_nothing() -> None:
    view = with_hole(0, 0.5)
    assert view.unfiltered is not None
    broken = view.unfiltered.copy()
    broken[:, HOLE] = np.nan
    mapper = mapper_with(4)
    mapper.add_view(replace(view, unfiltered=broken))
    assert mapper.log.counts["filled"] == 0
    assert mapper.log.counts["refused_depths"] == 48 * 24
