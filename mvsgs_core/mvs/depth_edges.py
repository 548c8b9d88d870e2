"""Which surface a pixel at a depth edge lies on: candidates are the surfaces around it, continued as planes.

Matching windows make a near surface grow over what is behind it, at half the image's size by several pixels, and a
narrow search around that surface does not find the way back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from mvsgs_core import camera
from mvsgs_core.mvs.interface import RADII, TILE, Backend, ChooseOptions, MatchingImages
from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.mvs.pruning import tile_counts
from mvsgs_core.setting_ranges import above, at_least, within
from mvsgs_core.warp import apply_warp


@dataclass(frozen=True)
class DepthEdgeConfig:
    """Candidates and their smoothing."""

    # Pixels, one tuple a round: the surfaces so far away, in eight directions, are candidates. The wide round frees
    # what a window covered whole, as between the slats of a chair; the narrow one finds the edge to the pixel.
    rounds: tuple[tuple[int, ...], ...] = ((4, 8, 12), (3, 6))
    radius: int = 1  # pixels, of the matching window: a wide one holds both surfaces
    # Right at an edge half of the neighbors see something else; gray levels tell what such small windows do not.
    cost: CostConfig = field(
        default_factory=lambda: CostConfig(top_k=2, contrast=5.0, intensity_weight=0.3, intensity_range=10.0)
    )
    p1: float = 0.3  # cost of a change of inverse depth that moves the point by a pixel
    p2: float = 1.0  # the most that a change costs
    min_difference: float = 1.0  # pixels: tiles whose candidates differ less keep their depth
    edge: float = 12.0  # gray levels that halve P1 and P2

    def __post_init__(self) -> None:
        within(self, radius=RADII)
        at_least(self, p1=0, p2=0, min_difference=0)
        above(self, edge=0)


def continued_surfaces(inverse_depth: np.ndarray, rings: tuple[int, ...]) -> np.ndarray:
    """(1 + 8 R, H, W) float32: a map (H, W), and the surfaces around each pixel continued to it as planes."""
    smooth = cv2.medianBlur(inverse_depth, 5)
    slope_u, slope_v = _slope(smooth, 1), _slope(smooth, 0)
    found = [inverse_depth]
    for ring in rings:
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)):
            rows, away_v = _beside(ring * dv, smooth.shape[0])
            columns, away_u = _beside(ring * du, smooth.shape[1])
            there = (rows[:, None], columns[None])
            found.append(smooth[there] - away_u[None] * slope_u[there] - away_v[:, None] * slope_v[there])
    return np.stack(found)


def _slope(surface: np.ndarray, axis: int) -> np.ndarray:
    """(H, W) change a pixel along `axis`: the smaller difference of both sides, so that none reaches over a jump."""
    step = np.diff(surface, axis=axis)
    # At the border there is one side only.
    before = np.concatenate([np.take(step, [0], axis), step], axis)
    after = np.concatenate([step, np.take(step, [-1], axis)], axis)
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(smaller, dtype=np.float32), 5))


def _beside(shift: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """(length,) where `shift` away lies, the last pixel where that is outside, and float32 how far away it is."""
    here = np.arange(length)
    there = np.clip(here + shift, 0, length - 1)
    return there, (there - here).astype(np.float32)


def refine_depth_edges(
    inverse_depth: np.ndarray,
    images: MatchingImages,
    pixel: float,
    top_k: int,
    config: DepthEdgeConfig,
    backend: Backend,
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float32 inverse depth, and how clear the least clear choice was, 0 to 1, in cost.

    `pixel` is the change of inverse depth that moves a point by a pixel; of the neighbors `top_k` count at most.
    """
    images = equalized(images, inverse_depth)
    cost_config = replace(config.cost, top_k=min(config.cost.top_k, top_k))
    options = ChooseOptions(config.p1 / pixel, config.p2, config.edge, pixel)
    clear = np.ones(inverse_depth.shape, dtype=np.float32)
    for rings in config.rounds:
        surfaces = continued_surfaces(inverse_depth, rings)
        tiles = differing_tiles(surfaces, config.min_difference * pixel)
        cost = backend.surface_costs(images, surfaces, config.radius, cost_config, tiles)
        best, gap = backend.choose_surface(cost, surfaces, images.reference, options)
        inverse_depth = np.ascontiguousarray(np.take_along_axis(surfaces, best[None], axis=0)[0])
        clear = np.minimum(clear, gap)
    return inverse_depth, clear


def equalized(images: MatchingImages, inverse_depth: np.ndarray, every: int = 4) -> MatchingImages:
    """The images with each neighbor's median difference of gray level to the reference taken out.

    A camera's exposure changes; of every fourth pixel at the surface (H, W) found so far the median is hardly wrong.
    """
    u, v = (a[::every, ::every] for a in camera.pixel_grid(*inverse_depth.shape))
    w = inverse_depth[::every, ::every].astype(np.float64)
    height, width = images.neighbors.shape[1:]
    equal = []
    for image, warp in zip(images.neighbors, images.warps, strict=True):
        x, y, z = apply_warp(warp, u, v, w)
        seen = (z > 1e-6) & (w > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        there = cv2.remap(image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        difference = (images.reference[::every, ::every] - there)[seen]
        equal.append(image + np.float32(np.median(difference) if len(difference) else 0.0))
    return replace(images, neighbors=np.stack(equal))


def differing_tiles(surfaces: np.ndarray, min_difference: float) -> np.ndarray:
    """(tile rows, D, tile columns) uint8: 1 where surfaces (D, H, W) differ by more anywhere in a tile."""
    differ = (surfaces.max(axis=0) - surfaces.min(axis=0) > min_difference).astype(np.uint8)
    height, width = differ.shape
    rows, columns = tile_counts((height, width))
    padded = cv2.copyMakeBorder(differ, 0, rows * TILE[0] - height, 0, columns * TILE[1] - width, cv2.BORDER_CONSTANT)
    tiles = padded.reshape(rows, TILE[0], columns, TILE[1]).max(axis=(1, 3))
    return np.repeat(tiles[:, None], len(surfaces), axis=1)
