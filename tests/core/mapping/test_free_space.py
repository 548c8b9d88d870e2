"""Splats in the air: what keyframes' depth says of a place, and what is taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.array_file import Arrays
from mvsgs_core.mapping.checkpoints.state import copy_of, pack, unpack
from mvsgs_core.mapping.free_space import in_the_air, surface_of
from mvsgs_core.mapping.keyframes import CELLS, RGBDKeyframe, TrainingView, training_view
from mvsgs_core.stats import Stats
from tests.support.small_maps import CONFIG, mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (96, 144)
INTRINSICS = np.array([120.0, 120.0, 71.5, 47.5])


def view_of(index: int, depth: np.ndarray, shift: float = 0.0) -> TrainingView:
    pose = np.eye(4)
    pose[0, 3] = shift
    image = np.zeros((*SIZE, 3), np.uint8)
    view = training_view(RGBDKeyframe(index, image, INTRINSICS, pose, depth), pose, None, torch.device("cpu"))
    return replace(view, surface=surface_of(depth))


def wall(depth: float) -> np.ndarray:
    return np.full(SIZE, depth, np.float32)


def found(splats: list[list[float]], views: list[TrainingView]) -> list[bool]:
    result: list[bool] = in_the_air(torch.tensor(splats), views, 0.1).tolist()
    return result


def test_a_cell_has_the_nearest_the_farthest_and_how_much_is_known() -> None:
    depth = np.random.default_rng(0).uniform(1.0, 9.0, (50, 97)).astype(np.float32)
    depth[np.random.default_rng(1).random(depth.shape) < 0.4] = 0.0
    surface = surface_of(depth)
    rows, columns = (np.arange(size) * CELLS // size for size in depth.shape)
    for row, column in [(0, 0), (3, 7), (20, 31), (47, 47)]:
        cell = depth[np.ix_(rows == row, columns == column)]
        known = cell[cell > 0]
        wanted = [known.min(), known.max()] if len(known) else [0.0, 0.0]
        np.testing.assert_allclose(surface[:2, row, column], wanted, rtol=1e-3)
        assert surface[2, row, column] == pytest.approx(np.mean(cell > 0), abs=1e-3)


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (48, 48), (480, 640)])
def test_depth_of_any_size_has_a_surface(size: tuple[int, int]) -> None:
    surface = surface_of(np.full(size, 70000.0, np.float32))
    assert surface.shape == (3, CELLS, CELLS)
    assert np.isfinite(surface).all()
    assert (surface[0] == np.finfo(np.float16).max).all()
    assert (surface[2] == 1.0).all()


def test_a_splat_before_a_wall_is_in_the_air_and_one_on_it_or_behind_it_is_not() -> None:
    views = [view_of(0, wall(4.0)), view_of(1, wall(4.0), 0.3)]
    splats = [[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, 3.8], [0.0, 0.0, 6.0], [0.0, 0.0, -2.0], [9.0, 0.0, 4.0]]
    assert found(splats, views) == [True, False, False, False, False, False]


def test_more_keyframes_must_see_past_it_than_see_it() -> None:
    near = view_of(0, wall(2.0))
    assert found([[0.0, 0.0, 2.0]], [near, view_of(1, wall(4.0))]) == [False]
    assert found([[0.0, 0.0, 2.0]], [near, view_of(1, wall(4.0)), view_of(2, wall(4.0))]) == [True]


def test_beside_an_edge_and_where_depth_is_hardly_known_nothing_is_said() -> None:
    edge = wall(4.0)
    edge[:, :72] = 2.0
    beside, far = ([2.0 * (at - 71.5) / 120.0, 0.0, 2.0] for at in (73.0, 120.0))  # the first in the cell beside it
    assert found([beside, far], [view_of(0, edge)]) == [False, True]
    hardly = np.where(np.random.default_rng(0).random(SIZE) < 0.2, 4.0, 0.0).astype(np.float32)
    assert found([[0.0, 0.0, 2.0]], [view_of(0, hardly)]) == [False]
    assert found([[0.0, 0.0, 2.0]], [view_of(0, 0.0 * wall(1.0))]) == [False]


def test_a_surface_follows_the_scale_of_its_keyframe() -> None:
    view = view_of(0, wall(4.0))
    view.rescale(0.25)
    assert found([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]], [view]) == [True, False]
    view.rescale(1e9)
    assert view.surface is not None
    assert np.isfinite(view.surface).all()


@pytest.mark.parametrize("margin", [0.1, 0.0])
def test_the_refinement_begins_without_them(margin: float) -> None:
    views = [rgbd_keyframe(k, pose_on_arc(k / 4)) for k in range(4)]
    config = replace(CONFIG, density_control=replace(CONFIG.density_control, in_the_air=margin))
    mapper = mapped(views, config)
    means, before = mapper.state.splats.means.data, len(mapper.state)
    first = torch.from_numpy(mapper.views[0].local_from_cam[:3, 3]).to(means)
    means[:20] = 0.5 * (means[:20] + first)  # halfway to the first camera
    mapper.refine(0, 60)
    removed = mapper.log.counts.get("in the air", 0.0)
    assert len(mapper.state) == before - removed
    assert removed >= 15 if margin else removed == 0


def test_a_checkpoint_keeps_what_keyframes_see() -> None:
    mapper = mapped([rgbd_keyframe(k, pose_on_arc(k / 4)) for k in range(3)], CONFIG)
    mapper.views[1].surface = None
    meta, arrays = pack(copy_of(mapper, Stats(), {}, mapper.photometry.copy()), "map", ["image"] * 3, [])

    def image(name: str) -> tuple[torch.Tensor, None]:
        return torch.zeros((48, 64, 3), dtype=torch.uint8), None

    again = unpack(meta, Arrays(arrays).of("map"), CONFIG, Stats(), {}, mapper.photometry.copy(), image)
    assert again.views[1].surface is None
    for k in (0, 2):
        surface = mapper.views[k].surface
        assert surface is not None
        assert surface[2].all()
        np.testing.assert_array_equal(again.views[k].surface, surface)
