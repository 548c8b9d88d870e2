"""The map as it leaves the mapper or a file: world units, positions relative to an origin in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.rasterizer.rasterize import Render, rasterize
from mvsgs_core.rasterizer.splats import Splats


@dataclass(frozen=True)
class Snapshot:
    """Splats relative to `origin`, in world units, with the keyframes they were made from."""

    splats: Splats  # detached copies, on the CPU
    anchors: np.ndarray  # (N,) int64 keyframe of each splat
    origin: np.ndarray  # (3,) float64, world position that `splats.means` are relative to
    kernel: str  # "gaussian", "exact" or "ges_scale": what `splats.betas` means
    iterations: int
    keyframes: np.ndarray  # (K,) int64
    world_from_cam: np.ndarray  # (K, 4, 4) float64, as refined, world frame (not relative to the origin)
    scale: np.ndarray  # (K,) float64
    exposures: np.ndarray  # (K, 3, 4) float32
    vignetting: np.ndarray | None = None  # (3,) float32 of the camera, see `photometry`; None: none
    antialiased: bool = False  # rendered, and so trained, as `rasterize` does with antialiased=True
    background: np.ndarray | None = None  # (3,) float32 color where there is no splat; None: black

    def relative_pose(self, world_from_cam: np.ndarray) -> np.ndarray:
        """(4, 4) of a pose in the world (4, 4): relative to `origin`, as the splats are."""
        local = world_from_cam.copy()
        local[:3, 3] -= self.origin
        return local

    def typical_depth(self) -> float | None:
        """Median distance of the splats from the keyframes that they were made from, world units: that of what a camera
        sees, however far the map reaches. None where no keyframe of theirs is known."""
        if not len(self.keyframes) or not len(self.anchors):
            return None
        order = np.argsort(self.keyframes)
        place = order[np.searchsorted(self.keyframes, self.anchors, sorter=order).clip(max=len(order) - 1)]
        known = self.keyframes[place] == self.anchors
        if not known.any():
            return None
        cameras = self.world_from_cam[place[known], :3, 3] - self.origin
        return float(np.median(np.linalg.norm(self.splats.means.numpy()[known] - cameras, axis=1)))

    @torch.no_grad()
    def render(
        self, world_from_cam: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], **options: Any
    ) -> Render:
        """The map from a pose in the world (4, 4); intrinsics (4,) and size (height, width) as for `rasterize`, whose
        other options may be given."""
        pose = self.relative_pose(world_from_cam)
        return rasterize(
            self.splats, pose, intrinsics, size, kernel=self.kernel, antialiased=self.antialiased,
            background=self.background, **options,
        )  # fmt: skip

    def scaled(self, factor: float) -> Snapshot:
        """The same map in another unit."""
        splats = replace(
            self.splats, means=self.splats.means * factor, log_scales=self.splats.log_scales + math.log(factor)
        )
        poses = geometry.scaled(self.world_from_cam, factor)
        return replace(self, splats=splats, origin=self.origin * factor, world_from_cam=poses)
