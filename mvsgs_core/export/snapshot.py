"""The map as it leaves the mapper: world units, positions relative to an origin in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.rasterizer.splats import Splats


@dataclass(frozen=True)
class Snapshot:
    """Splats relative to `origin`, in world units, with the keyframes they were made from."""

    splats: Splats  # detached copies, on the CPU
    anchors: np.ndarray  # (N,) int64 keyframe of each splat
    origin: np.ndarray  # (3,) float64, world position that `splats.means` are relative to
    kernel: str
    iterations: int
    keyframes: np.ndarray  # (K,) int64
    world_from_cam: np.ndarray  # (K, 4, 4) float64, as refined, world frame (not relative to the origin)
    scale: np.ndarray  # (K,) float64
    exposures: np.ndarray  # (K, 3, 4) float32
