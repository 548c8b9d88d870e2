"""Hypotheses of the sweep that need not be computed: those that the tracker's coarse depth rules out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.mvs.interface import TILE
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.setting_ranges import at_least, within


@dataclass(frozen=True)
class PruningConfig:
    """What is left out, tile by tile (mvsgs_core.mvs.interface.TILE)."""

    outside_range: bool = True  # first stage: no more hypotheses than the range needs at the stage's step
    outside_cells: bool = True  # first stage: hypotheses that the tracker's cells around a tile rule out
    cell_radius: int = 3  # cells around a tile that speak for it
    cell_percentile: float = 5.0  # of their inverse depths, at each end
    cell_margin: float = 2.0  # factor beyond these percentiles
    min_cells: int = 8  # with fewer known ones around it, a tile searches the whole range
    min_weight: float = 0.3  # a cell below says nothing

    def __post_init__(self) -> None:
        at_least(self, cell_radius=0, cell_margin=1, min_cells=1, min_weight=0)
        within(self, cell_percentile=(0, 50))


def tile_counts(size: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of tiles that cover (H, W) pixels."""
    return -(-size[0] // TILE[0]), -(-size[1] // TILE[1])


def cell_bounds(inverse_depth: np.ndarray, weight: np.ndarray, config: PruningConfig) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest inverse depth (h, w) that the known cells around each cell of a grid (h, w) leave open.

    0 and infinity where too few are known.
    """
    known = np.isfinite(inverse_depth) & (inverse_depth > 0) & (weight >= config.min_weight)
    r = config.cell_radius
    values = np.pad(np.where(known, inverse_depth, np.inf).astype(np.float32), r, constant_values=np.inf)
    side = 2 * r + 1
    around = np.lib.stride_tricks.sliding_window_view(values, (side, side)).reshape(*inverse_depth.shape, side * side)
    ordered = np.sort(around, axis=-1)  # the unknown ones last
    count = np.isfinite(ordered).sum(axis=-1)
    out = np.floor(count * config.cell_percentile / 100.0).astype(np.int64)
    low = np.take_along_axis(ordered, out[..., None], axis=-1)[..., 0] / config.cell_margin
    last = np.maximum(count - 1 - out, 0)
    high = np.take_along_axis(ordered, last[..., None], axis=-1)[..., 0] * config.cell_margin
    enough = count >= config.min_cells
    return np.where(enough, low, 0.0), np.where(enough, high, np.inf)


def tiles_in_cells(
    reference: StereoKeyframe, size: tuple[int, int], low: float, interval: float, count: int, config: PruningConfig
) -> np.ndarray:
    """(tile rows, D, tile columns) uint8: 1 where hypothesis low + k interval of a tile of (H, W) is open."""
    lowest, highest = cell_bounds(reference.inverse_depth, reference.weight, config)
    rows, columns = tile_counts(size)
    # A tile may lie on several cells: what any of them leaves open, at 4x4 points of the tile.
    order = (columns * 4, rows * 4)
    enlarged = [cv2.resize(a.astype(np.float32), order, interpolation=cv2.INTER_NEAREST) for a in (lowest, highest)]
    begin = enlarged[0].reshape(rows, 4, columns, 4).min(axis=(1, 3))
    end = enlarged[1].reshape(rows, 4, columns, 4).max(axis=(1, 3))
    hypotheses = low + interval * np.arange(count, dtype=np.float32)[None, :, None]
    is_open = (hypotheses >= begin[:, None] - interval) & (hypotheses <= end[:, None] + interval)
    is_open |= ~is_open.any(axis=1, keepdims=True)  # the cells contradict the range: all of it
    return is_open.astype(np.uint8)
