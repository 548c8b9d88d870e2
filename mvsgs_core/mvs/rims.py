"""Which surface a pixel at an object's rim lies on: candidates are the surfaces around it, continued as planes.

Matching windows make a near surface grow over what is behind it, at half the image's size by several pixels, and a
narrow search around that surface does not find the way back.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.mvs.interface import TILE, Backend, ChooseOptions, CostOptions
from mvsgs_core.mvs.skipping import tile_counts


@dataclass(frozen=True)
class RimChoice:
    """Candidates and their smoothing."""

    rings: tuple[int, ...] = (3, 6)  # pixels: the surfaces so far away, in eight directions, are candidates
    small_jump: float = 0.3  # cost of a change of inverse depth that moves the point by a pixel
    large_jump: float = 1.0  # the most that a change costs
    least: float = 1.0  # pixels: tiles whose candidates differ less keep their depth
    edge: float = 12.0  # gray levels that halve these


def continued_surfaces(inverse_depth: np.ndarray, rings: tuple[int, ...]) -> np.ndarray:
    """(1 + 8 R, H, W) float32: a map (H, W), and the surfaces around each pixel continued to it as planes."""
    smooth = cv2.medianBlur(inverse_depth, 5)
    slope_u, slope_v = _slope(smooth, 1), _slope(smooth, 0)
    found = [inverse_depth]
    for ring in rings:
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)):
            u, v = ring * du, ring * dv
            plane = smooth - np.float32(u) * slope_u - np.float32(v) * slope_v
            found.append(_shifted(plane, u, v))
    return np.stack(found)


def _slope(surface: np.ndarray, axis: int) -> np.ndarray:
    """(H, W) change a pixel along `axis`: the smaller difference of both sides, so that none reaches over a jump."""
    step = np.diff(surface, axis=axis, prepend=np.take(surface, [0], axis), append=np.take(surface, [-1], axis))
    before, after = (step[:, :-1], step[:, 1:]) if axis == 1 else (step[:-1], step[1:])
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(smaller, dtype=np.float32), 5))


def _shifted(values: np.ndarray, u: int, v: int) -> np.ndarray:
    """What lies `u` columns and `v` rows away, the border repeated."""
    height, width = values.shape
    padded = cv2.copyMakeBorder(values, max(-v, 0), max(v, 0), max(-u, 0), max(u, 0), cv2.BORDER_REPLICATE)
    top, left = max(v, 0), max(u, 0)
    return padded[top : top + height, left : left + width]


def settle_rims(
    inverse_depth: np.ndarray,
    reference: np.ndarray,
    neighbors: np.ndarray,
    warps: np.ndarray,
    pixel: float,
    cost_options: CostOptions,
    choice: RimChoice,
    backend: Backend,
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float32 inverse depth, and how clear the choice was, 0 to 1, in cost.

    `pixel` is the change of inverse depth that moves a point by a pixel.
    """
    surfaces = continued_surfaces(inverse_depth, choice.rings)
    tiles = differing_tiles(surfaces, choice.least * pixel)
    cost = backend.surface_costs(reference, neighbors, warps, surfaces, cost_options, tiles)
    options = ChooseOptions(choice.small_jump / pixel, choice.large_jump, choice.edge, pixel)
    best, gap = backend.choose_surface(cost, surfaces, reference, options)
    return np.ascontiguousarray(np.take_along_axis(surfaces, best[None], axis=0)[0]), gap


def differing_tiles(surfaces: np.ndarray, least: float) -> np.ndarray:
    """(tile rows, D, tile columns) uint8: 1 where surfaces (D, H, W) differ by more than `least` anywhere in a tile."""
    differ = (surfaces.max(axis=0) - surfaces.min(axis=0) > least).astype(np.uint8)
    height, width = differ.shape
    rows, columns = tile_counts((height, width))
    padded = cv2.copyMakeBorder(differ, 0, rows * TILE[0] - height, 0, columns * TILE[1] - width, cv2.BORDER_CONSTANT)
    tiles = padded.reshape(rows, TILE[0], columns, TILE[1]).max(axis=(1, 3))
    return np.repeat(tiles[:, None], len(surfaces), axis=1)
