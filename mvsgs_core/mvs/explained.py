"""How much of a keyframe the map explains already: what it shows from earlier keyframes, warped and compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mvsgs_core import camera
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.warp import apply_warp, relative_warp


@dataclass(frozen=True)
class ExplainChoice:
    """When a keyframe needs no stereo."""

    share: float = 0.8  # of its pixels that the map must explain
    tolerance: float = 12.0  # gray levels that a pixel and the map's may differ, after one shift for the exposure
    views: int = 8  # newest renders of the map that are looked at
    area: int = 80 * 60  # pixels that are compared, aspect kept


@dataclass(frozen=True)
class MapSight:
    """The map rendered from a keyframe's pose."""

    index: int
    gray: np.ndarray  # (h, w) float32 gray levels
    depth: np.ndarray  # (h, w) float32, 0 where the map shows nothing
    intrinsics: np.ndarray  # (4,) float64 at (h, w)
    world_from_cam: np.ndarray  # (4, 4) float64
    scale: float
    segment: int = 0

    def moved(self, world_from_cam: np.ndarray, scale: float) -> MapSight:
        """The same sight after the tracker corrected its pose and the map's scale."""
        depth = self.depth * np.float32(scale / self.scale)
        return replace(self, world_from_cam=world_from_cam, scale=float(scale), depth=depth)


class Explained:
    """Holds the newest sights of the map; no two keyframes in a row are called explained, so that the filters of the

    others still have neighbors with depth.
    """

    def __init__(self, choice: ExplainChoice) -> None:
        self.choice = choice
        self.sights: list[MapSight] = []
        self._last = False

    def see(self, sight: MapSight) -> None:
        self.sights = [*self.sights, sight][-self.choice.views :]

    def move(self, poses: dict[int, tuple[np.ndarray, float]]) -> None:
        """Corrected poses (world_from_cam (4, 4), scale) by keyframe index."""
        self.sights = [s.moved(*poses[s.index]) if s.index in poses else s for s in self.sights]

    def enough(self, reference: StereoKeyframe) -> bool:
        """Whether stereo can pass over this keyframe."""
        self._last = not self._last and self.share(reference) >= self.choice.share
        return self._last

    def share(self, reference: StereoKeyframe) -> float:
        """Part of the reference's pixels onto which a sight's point falls, the nearest there, with the same color."""
        sights = [s for s in self.sights if s.segment == reference.segment]
        if not sights:
            return 0.0
        size = camera.fit_size(*reference.size, self.choice.area, multiple=1)
        target = cv2.resize(reference.pyramid[-1] + 128.0, size[::-1], interpolation=cv2.INTER_AREA)
        target = cv2.blur(target, (3, 3))
        explained = np.zeros(size, dtype=bool)
        for sight in sights:
            explained |= self._explained_by(sight, reference, target)
        return float(explained.mean())

    def _explained_by(self, sight: MapSight, reference: StereoKeyframe, target: np.ndarray) -> np.ndarray:
        size = (target.shape[0], target.shape[1])
        intrinsics = camera.scale_intrinsics(reference.intrinsics, reference.size, size)
        stride = max(1, round(sight.depth.shape[1] / (2 * size[1])))  # two points a pixel of the grid are enough
        # Compared at the point's own place, both images blurred over three of the grid's pixels.
        blur = 2 * round(1.5 * sight.gray.shape[1] / size[1]) + 1
        gray = cv2.blur(sight.gray, (blur, blur))[::stride, ::stride]
        depth = sight.depth[::stride, ::stride].astype(np.float64)
        known = depth > 0
        inverse = 1.0 / np.where(known, depth, 1.0)
        v, u = (stride * a.astype(np.float64) for a in np.indices(depth.shape))
        warp = relative_warp(sight.intrinsics, sight.world_from_cam, intrinsics, reference.world_from_cam)
        x, y, z = apply_warp(warp, u, v, inverse)
        inside = known & (z > 1e-6) & (x > -0.5) & (x < size[1] - 0.5) & (y > -0.5) & (y < size[0] - 0.5)
        if not inside.any():
            return np.zeros(size, dtype=bool)
        at_x, at_y = (np.where(inside, a, 0.0).astype(np.float32) for a in (x, y))
        there = cv2.remap(target, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        difference = (gray - there)[inside]
        order = np.argsort(-(z / inverse)[inside], kind="stable")  # the nearest last: it stays
        cell = np.round(y[inside]).astype(int) * size[1] + np.round(x[inside]).astype(int)
        shown = np.full(target.size, np.nan)
        shown[cell[order]] = (difference - np.median(difference))[order]
        return np.asarray(np.abs(shown.reshape(size)) < self.choice.tolerance)
