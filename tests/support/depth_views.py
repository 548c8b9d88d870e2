"""Depth maps of a plane, for fusion."""

from __future__ import annotations

import numpy as np

from mvsgs_core.fusion.keyframe_depth import KeyframeDepth
from tests.support.plane_scene import intrinsics_of, look, true_depth

SIZE = (40, 56)


def view(index: int, x: float, noise: float = 0.0, turn: float = 0.0, size: tuple[int, int] = SIZE) -> KeyframeDepth:
    pose = look(x, turn)
    depth = true_depth(pose, size)
    rng = np.random.default_rng(index)
    depth = (depth * np.exp(noise * rng.normal(size=size))).astype(np.float32)
    confidence = rng.uniform(0.3, 1.0, size).astype(np.float32)
    return KeyframeDepth(index, depth, confidence, intrinsics_of(size), pose, 1.0)
