"""Messages that make a small map."""

from __future__ import annotations

import numpy as np

from msgs import FusedKeyframe, Keyframe
from nodes.mapper import Mapper
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def view_message(index: int, t: float, scale: float = 1.0, segment: int = 0) -> FusedKeyframe:
    view = rgbd_keyframe(index, pose_on_arc(t), (24, 32))
    assert view.normals is not None
    return FusedKeyframe(
        index=index, timestamp=0.1 * index, image=view.image, intrinsics=view.intrinsics,
        world_from_cam=view.world_from_cam, scale=scale, depth=view.depth, confidence=np.ones_like(view.depth),
        normals=view.normals, segment=segment,
    )  # fmt: skip


def keyframe_message(index: int, t: float) -> Keyframe:
    view = view_message(index, t)
    inverse = 1.0 / view.depth[1::2, 1::2]
    return Keyframe(
        index=index, timestamp=view.timestamp, image=view.image, intrinsics=view.intrinsics, segment=view.segment,
        world_from_cam=view.world_from_cam, scale=view.scale, inverse_depth=inverse.astype(np.float32),
        inverse_depth_weight=np.ones_like(inverse, dtype=np.float32),
    )  # fmt: skip


def settings(**changes: object) -> Mapper.Config:
    small = {"iterations": 4, "refinement": 3, "threads": 1, "preview_period": 0.0, "device": "cpu"}
    return Mapper.Config(**(small | changes))  # type: ignore[arg-type]
