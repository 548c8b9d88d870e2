"""An image split into rectangles, each worth one splat: few where it is smooth, many where it is textured.

A rectangle has 1 to 8 pixels a side, powers of two. It can be left to the map, be shown by one splat, or be split into
two halves, by rows or by columns; of all ways to do so the one whose error plus the price of its splats is least is
found from the pixels up (optimal pruning: Chou, Lookabaugh, Gray, 1989; dyadic rectangles: Donoho, 1997).

The error is a dissimilarity as in SSIM: squared over the variance of the image around the pixel, twice, plus C2. So a
splat is worth as much where contrast is low as where it is high.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from mvsgs_core import native
from mvsgs_core.camera import mean_of_colors
from mvsgs_core.rasterizer.ssim_window import C2, RADIUS, SIGMA

LEVELS = 3  # halvings of the largest rectangle along an axis: of 8 pixels
DEPTH_NOISE = 0.02  # of depth, that a surface's has anyway: nothing is split for it
EMPTY = 1e3  # error of a pixel that the map does not show: more than any splat costs


@dataclass(frozen=True)
class Partition:
    """The rectangles of an image that are worth a splat."""

    labels: np.ndarray  # (H, W) int64 the pixel's rectangle, -1 where it is in none
    sides: np.ndarray  # (N, 2) int64 rows and columns of each

    def __len__(self) -> int:
        return len(self.sides)


@dataclass(frozen=True)
class Split:
    """What the kernel splits: an image of whole rectangles of 8x8 pixels."""

    colors: np.ndarray  # (H, W, 3) float32
    weight: np.ndarray  # (H, W) float32 factor from squared error to dissimilarity, 0 of a pixel that does not count
    left: np.ndarray  # (H, W) float32 dissimilarity that stays without a splat
    taken: np.ndarray  # (H, W) bool, the pixels that can get one
    sure: np.ndarray  # (H, W) bool, whose depth is known
    logarithm: np.ndarray  # (H, W) float64 of that depth, 0 of others
    angle: float  # of a pixel, radians
    depth_noise: float  # deviation of the logarithm that depth has anyway
    price: float


def partition(
    image: np.ndarray, residual: np.ndarray, wanted: np.ndarray, depth: np.ndarray, known: np.ndarray, angle: float,
    price: float, noise: float = 0.0,
) -> Partition:  # fmt: skip
    """The split of least cost.

    image: (H, W, 3) in [0, 1]; residual: (H, W) squared error, mean over RGB, that stays at a pixel without a splat,
    `EMPTY` where the map shows nothing; wanted: (H, W) bool, the pixels that can get one; depth: (H, W), positive where
    known (H, W) bool; angle: of a pixel, radians; price: dissimilarity, summed over pixels, that a splat must save;
    noise: variance of the image's noise. A splat more follows the noise of a pixel more, which no other view has, so
    that it must save that too, as the dissimilarity of a pixel of median contrast; the price at most once more.

    A splat shows the mean color of its rectangle, blended with its neighbors'. One whose known depths differ by more
    than its side and their noise, as standard deviations of the logarithm go, lies on two surfaces and is always split.
    """
    size = wanted.shape
    side = 1 << LEVELS
    beyond = ((0, -size[0] % side), (0, -size[1] % side))
    taken = np.pad(wanted, beyond)
    sure = np.pad(known & wanted, beyond)
    scale = _per_contrast(image)
    left = np.where(residual >= EMPTY, EMPTY, residual * scale).astype(np.float32)
    given = Split(
        colors=np.pad(image.astype(np.float32), (*beyond, (0, 0)), mode="edge"),
        weight=np.where(taken, np.pad(scale, beyond), np.float32(0)),
        left=np.where(taken, np.pad(left, beyond), np.float32(0)),
        taken=taken,
        sure=sure,
        logarithm=np.log(np.where(sure, np.pad(depth, beyond), 1.0), dtype=np.float64),
        angle=angle,
        depth_noise=DEPTH_NOISE,
        price=price + min(price, noise * float(np.median(scale))),
    )
    labels, sides = native.load("mapping").partition(**vars(given), threads=torch.get_num_threads())
    return Partition(labels[: size[0], : size[1]], sides)


def _per_contrast(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 factor from squared error to dissimilarity: 1 / (2 variance + C2) in SSIM's window."""
    colors = image.astype(np.float32)
    window = (2 * RADIUS + 1, 2 * RADIUS + 1)
    mean = cv2.GaussianBlur(colors, window, SIGMA)
    variance = mean_of_colors(np.maximum(cv2.GaussianBlur(colors * colors, window, SIGMA) - mean * mean, 0))
    return np.asarray(1 / (2 * variance + np.float32(C2)), dtype=np.float32)
