"""Random inputs of the stereo kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.mvs.interface import MatchingImages
from mvsgs_core.warp import relative_warp
from tests.support.plane_scene import look, render

SIZE = (36, 52)


@dataclass(frozen=True)
class Problem:
    images: MatchingImages
    first: np.ndarray  # SIZE inverse depth of the first hypothesis
    step: np.ndarray  # SIZE between two of them


def problem(seed: int = 0) -> Problem:
    rng = np.random.default_rng(seed)
    poses = [look(0.0), look(0.15, 0.02), look(-0.1), look(0.3, -0.03)]
    images = [render(p, SIZE)[0][..., 0].astype(np.float32) - 128.0 for p in poses]
    intrinsics = render(poses[0], SIZE)[1]
    warps = np.stack([relative_warp(intrinsics, poses[0], intrinsics, p) for p in poses[1:]])
    first = 0.15 + 0.02 * rng.random(SIZE)
    given = MatchingImages(images[0], np.stack(images[1:]), warps.astype(np.float32))
    return Problem(given, first.astype(np.float32), np.full(SIZE, 0.02, dtype=np.float32))
