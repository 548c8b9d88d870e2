"""What previews show of keyframes whose depth is still to come: never in the map, gone when the depth is there."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import preview_arrays
from mvsgs_core.mapping.provisional import CoarseKeyframe, Provisional
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

LIMIT = 4000


def coarse(index: int, t: float, known: slice = slice(None), **changes: object) -> CoarseKeyframe:
    """A keyframe of the tiny scene with inverse depth on every 4th pixel, of the columns `known`."""
    view = rgbd_keyframe(index, pose_on_arc(t))
    inverse, weight = 1.0 / view.depth[2::4, 2::4], np.zeros_like(view.depth[2::4, 2::4])
    weight[:, known] = 1.0
    values: dict[str, object] = {
        "index": index, "image": view.image, "intrinsics": view.intrinsics, "world_from_cam": view.world_from_cam,
        "scale": 1.0, "inverse_depth": inverse.astype(np.float32), "weight": weight,
    }  # fmt: skip
    return CoarseKeyframe(**(values | changes))  # type: ignore[arg-type]


@pytest.fixture
def mapper() -> OnlineMapper:
    mapper = OnlineMapper(MapperConfig(threads=1, device="cpu"))
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.0)))
    return mapper


def coverage(mapper: OnlineMapper, splats: Splats | None, view: CoarseKeyframe) -> float:
    """Share of the keyframe's pixels above half opacity, by the map and these splats."""
    shown = mapper.state.detached().tensors()
    if splats is not None:
        shown = {name: torch.cat([value, getattr(splats, name)]) for name, value in shown.items()}
    size = view.image.shape[0], view.image.shape[1]
    render = rasterize(Splats(**shown), mapper.frame.local(view.world_from_cam), view.intrinsics, size)
    return float((render.opacity.numpy() > 0.5).mean())


def test_a_new_keyframes_area_is_shown_at_once_and_the_map_is_left_alone(mapper: OnlineMapper) -> None:
    provisional, view = Provisional(LIMIT), coarse(5, 1.0, slice(0, 10))  # the tracker knows 10 of 16 columns
    before = mapper.state.splats.means.detach().clone()
    assert coverage(mapper, None, view) < 0.9
    provisional.see(view)
    splats = provisional.splats(mapper, {0})
    assert splats is not None
    assert coverage(mapper, splats, view) > 0.99
    assert len(splats) <= LIMIT // 4
    torch.testing.assert_close(mapper.state.splats.means.detach(), before)
    arrays = preview_arrays(mapper, LIMIT, splats)
    assert len(splats) < len(arrays["means"]) <= LIMIT
    np.testing.assert_allclose(arrays["means"][-len(splats) :], splats.means.numpy() * mapper.frame.unit, rtol=1e-5)


def test_it_is_gone_when_the_keyframes_own_depth_comes(mapper: OnlineMapper) -> None:
    provisional = Provisional(LIMIT)
    provisional.see(coarse(5, 1.0))
    provisional.came(5)
    assert provisional.splats(mapper, {0}) is None
    provisional.see(coarse(5, 1.0))  # late, by the best-effort topic
    assert provisional.splats(mapper, {0}) is None


def test_corrections_move_it(mapper: OnlineMapper) -> None:
    provisional, view = Provisional(LIMIT), coarse(5, 1.0)
    provisional.see(view)
    first = provisional.splats(mapper, {0})
    moved = view.world_from_cam.copy()
    moved[:3, 3] = 2.0 * moved[:3, 3] + 1.0
    provisional.correct(np.array([5]), moved[None], np.array([2.0]), np.array([3], dtype=np.int32))
    assert provisional.splats(mapper, {0}) is None  # it belongs to another part of the map now
    second = provisional.splats(mapper, {3})
    assert first is not None
    assert second is not None

    def in_camera(splats: Splats, pose: np.ndarray) -> np.ndarray:
        local = mapper.frame.local(pose)
        return np.asarray((splats.means.numpy() - local[:3, 3]) @ local[:3, :3])

    np.testing.assert_allclose(
        in_camera(second, moved), 2.0 * in_camera(first, view.world_from_cam), rtol=1e-3, atol=1e-4
    )


def test_what_is_no_camera_or_no_map_shows_nothing(mapper: OnlineMapper) -> None:
    provisional = Provisional(LIMIT)
    provisional.see(coarse(5, 1.0, world_from_cam=np.full((4, 4), np.nan)))
    assert provisional.splats(mapper, {0}) is None
    provisional.see(coarse(6, 1.0))
    assert provisional.splats(OnlineMapper(mapper.config), {0}) is None


def test_the_oldest_are_dropped_and_the_budget_holds(mapper: OnlineMapper) -> None:
    provisional = Provisional(LIMIT, time_fraction=0.0)  # no time: the newest keyframe alone
    for index in range(1, 30):
        provisional.see(coarse(index, 1.0))
    assert len(provisional._waiting) == 8
    provisional.splats(mapper, {0})
    assert [waiting.view.index for waiting in provisional._waiting if waiting.points is not None] == [29]
    few = Provisional(40)
    few.see(coarse(1, 1.0))
    splats = few.splats(mapper, {0})
    assert splats is not None
    assert 0 < len(splats) <= 10
