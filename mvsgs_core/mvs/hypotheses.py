"""Inverse-depth ranges: of a keyframe from the tracker's coarse grid, of a stage from the stage before."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core import camera
from mvsgs_core.membrane import membrane
from mvsgs_core.mvs.interface import SurfaceEstimate
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.setting_ranges import at_least, within
from mvsgs_core.warp import apply_warp, relative_warp


@dataclass(frozen=True)
class RangeConfig:
    """How the search range follows from sparse, partly wrong coarse depth."""

    percentile: float = 2.0  # of the valid inverse depths, at each end
    margin: float = 1.6  # factor beyond these percentiles
    min_cells: int = 24  # fewer valid cells: ask the neighbors' grids
    min_weight: float = 0.05  # a cell below is unknown

    def __post_init__(self) -> None:
        within(self, percentile=(0, 50))
        at_least(self, margin=1, min_cells=1, min_weight=0)


@dataclass(frozen=True)
class SearchRange:
    """Inverse depths [low, high] to search, both positive."""

    low: float
    high: float
    source: str  # "own grid", "neighbors' grids", "previous keyframe" or "given"

    def typical(self) -> np.ndarray:
        """(3,) inverse depths: near the far end, the middle, near the near end."""
        return self.low + (self.high - self.low) * np.array([0.15, 0.4, 0.75])


def valid_cells(view: StereoKeyframe, config: RangeConfig) -> np.ndarray:
    """(K,) float64 inverse depths that the tracker knows."""
    good = np.isfinite(view.inverse_depth) & (view.inverse_depth > 0) & (view.weight >= config.min_weight)
    return view.inverse_depth[good].astype(np.float64)


def range_of(inverse_depths: np.ndarray, config: RangeConfig, source: str) -> SearchRange:
    """Percentiles with a margin; robust to a few per cent of outliers."""
    low, high = np.percentile(inverse_depths, [config.percentile, 100.0 - config.percentile])
    return SearchRange(float(low / config.margin), float(high * config.margin), source)


def search_range(
    reference: StereoKeyframe, others: list[StereoKeyframe], previous: SearchRange | None, config: RangeConfig
) -> SearchRange | None:
    """The reference's own range; else that of its neighbors' points seen from it; else the previous one; else None."""
    own = valid_cells(reference, config)
    if len(own) >= config.min_cells:
        return range_of(own, config, "own grid")
    gathered = [own, *(_seen_from(reference, other, config) for other in others)]
    points = np.concatenate(gathered)
    if len(points) >= config.min_cells:
        return range_of(points, config, "neighbors' grids")
    if previous is not None:
        return SearchRange(previous.low, previous.high, "previous keyframe")
    return None


def _seen_from(reference: StereoKeyframe, other: StereoKeyframe, config: RangeConfig) -> np.ndarray:
    """(K,) inverse depths, in the reference, of the cells of another view that project into it."""
    good = np.isfinite(other.inverse_depth) & (other.inverse_depth > 0) & (other.weight >= config.min_weight)
    if not good.any():
        return np.empty(0)
    size = other.inverse_depth.shape[:2]
    u, v = camera.pixel_grid(*size)
    warp = relative_warp(
        camera.scale_intrinsics(other.intrinsics, other.size, size),
        other.world_from_cam,
        reference.intrinsics,
        reference.world_from_cam,
    )
    w = other.inverse_depth[good].astype(np.float64)
    x, y, z = apply_warp(warp, u[good], v[good], w)
    height, width = reference.size
    inside = (z > 1e-6) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.asarray(w[inside] / z[inside])


def upsample_surface(inverse_depth: np.ndarray, size: tuple[int, int], max_gap: float) -> np.ndarray:
    """(H, W) float32 of a coarse map: linear on a surface, nearest across a jump larger than `max_gap`.

    A linear mix across a jump would center the next search between the two surfaces, on neither of them.
    """
    smooth = cv2.medianBlur(np.ascontiguousarray(inverse_depth, dtype=np.float32), 3)
    if smooth.shape[:2] == tuple(size):
        return np.asarray(smooth)
    linear = cv2.resize(smooth, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    kernel = np.ones((3, 3), np.uint8)
    local_range = cv2.dilate(smooth, kernel) - cv2.erode(smooth, kernel)
    jump = cv2.resize(local_range, (size[1], size[0]), interpolation=cv2.INTER_NEAREST) > max_gap
    nearest = cv2.resize(smooth, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(np.where(jump, nearest, linear), dtype=np.float32)


def certainty(estimate: SurfaceEstimate) -> np.ndarray:
    """(H, W) float32, 0 where other hypotheses are as good, 1 where the best one is clearly better than all others."""
    clear = np.clip(estimate.margin / 0.1, 0.0, 1.0)
    return np.asarray((clear * estimate.probability) ** 2, dtype=np.float32)


def fill_uncertain(
    inverse_depth: np.ndarray, sure: np.ndarray, gray: np.ndarray, *, min_certainty: float = 0.05,
    stiffness: float = 200.0, edge: float = 10.0,
) -> np.ndarray:  # fmt: skip
    """Where `sure` (H, W) is below `min_certainty`, inverse depth (H, W) becomes a membrane through the sure ones.

    The membrane (a weighted least-squares smoother) may bend at gray-level edges of about `edge`. In inverse depth a
    plane stays a plane, so it bridges textureless walls and furniture.
    """
    guide = np.clip(gray + 128.0, 0.0, 255.0).astype(np.uint8)
    sheet = membrane(inverse_depth, sure + np.float32(1e-4), guide, stiffness, edge)
    return np.where(sure < min_certainty, sheet, inverse_depth).astype(np.float32)
