"""Keyframes of a plane, as the tracker sends them."""

from __future__ import annotations

import numpy as np

from msgs import Keyframe
from tests.support.plane_scene import look, render, true_depth

SIZE = (120, 160)


def keyframe(index: int, **changes: object) -> Keyframe:
    pose = look(0.08 * index)
    depth = true_depth(pose, SIZE)
    values: dict[str, object] = {
        "index": index,
        "timestamp": 0.1 * index,
        "image": render(pose, SIZE)[0],
        "intrinsics": render(pose, SIZE)[1],
        "world_from_cam": pose,
        "scale": 1.0,
        "inverse_depth": np.ascontiguousarray(1.0 / depth[4::8, 4::8]).astype(np.float32),
        "inverse_depth_weight": np.ones((15, 20), dtype=np.float32),
        "segment": 0,
    }
    values.update(changes)
    return Keyframe(**values)  # type: ignore[arg-type]
