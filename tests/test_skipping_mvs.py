"""Stereo that passes over what the map explains: what comes back from the mapper, through the nodes."""

from __future__ import annotations

import numpy as np

from msgs import Depth, Keyframe, MapView, Poses
from nodes import handlers, outputs
from nodes.skipping_mvs import SkippingMvs
from tests.support.keyframe_messages import SIZE, keyframe
from tests.support.plane_scene import look, true_depth


def node() -> SkippingMvs:
    return SkippingMvs(
        SkippingMvs.Config(area=SIZE[0] * SIZE[1], device="cpu", threads=1, lag=0, skip_explained=0.7)
    )  # fmt: skip


def shown(index: int, scale: float = 1.0) -> MapView:
    """A perfect map."""
    k = keyframe(index)
    pose = k.world_from_cam.copy()
    pose[:3, 3] *= scale
    depth = (scale * true_depth(k.world_from_cam, SIZE)).astype(np.float32)
    return MapView(index, 0, scale, pose, k.intrinsics, k.image, depth)


def test_contract() -> None:
    assert set(handlers(SkippingMvs)) == {Keyframe, Poses, MapView}
    assert set(outputs(SkippingMvs)) == {Depth, Poses}


def test_a_keyframe_that_the_map_explains_gets_no_depth_and_is_counted() -> None:
    mvs = node()
    depths = [d for i in (0, 1) for d in mvs.on_keyframe(keyframe(i))]
    assert list(mvs.on_map_view(shown(1))) == []
    depths += [d for i in (2, 3) for d in mvs.on_keyframe(keyframe(i))]
    depths += list(mvs.on_end())
    assert [d.index for d in depths] == [0, 1, 2, 3]
    assert [bool((d.depth > 0).any()) for d in depths] == [False, True, False, True]  # the first had no neighbor
    assert mvs.stats.skipped["keyframes that the map explains"] == 1
    assert not any("MapView" in w for w in mvs.stats.warnings)


def test_what_the_map_shows_moves_with_the_tracker() -> None:
    mvs = node()
    list(mvs.on_keyframe(keyframe(0)))
    list(mvs.on_map_view(shown(0, scale=2.0)))
    list(mvs.on_poses(Poses(1, np.array([0]), look(0.0)[None], np.array([1.0]))))
    (depth,) = mvs.on_keyframe(keyframe(1))
    assert not (depth.depth > 0).any()


def test_a_silent_mapper_is_reported() -> None:
    mvs = node()
    list(mvs.on_keyframe(keyframe(0)))
    list(mvs.on_end())
    assert any("mapper.map_views=true" in w for w in mvs.stats.warnings)
