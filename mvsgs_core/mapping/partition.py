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

from mvsgs_core.rasterizer.ssim_window import C2, RADIUS, SIGMA

LEVELS = 3  # halvings of the largest rectangle along an axis: of 8 pixels
EMPTY = 1e3  # error of a pixel that the map does not show: more than any splat costs
NOTHING, LEAF, ROWS, COLUMNS = range(4)  # what becomes of a rectangle

Key = tuple[int, int]  # a rectangle of 2^key[0] rows and 2^key[1] columns


@dataclass(frozen=True)
class Partition:
    """The rectangles of an image that are worth a splat."""

    labels: np.ndarray  # (H, W) int64 the pixel's rectangle, -1 where it is in none
    sides: np.ndarray  # (N, 2) int64 rows and columns of each

    def __len__(self) -> int:
        return len(self.sides)


def partition(
    image: np.ndarray, residual: np.ndarray, wanted: np.ndarray, depth: np.ndarray, known: np.ndarray, angle: float,
    price: float,
) -> Partition:  # fmt: skip
    """The split of least cost.

    image: (H, W, 3) in [0, 1]; residual: (H, W) squared error, mean over RGB, that stays at a pixel without a splat,
    `EMPTY` where the map shows nothing; wanted: (H, W) bool, the pixels that can get one; depth: (H, W), positive where
    known (H, W) bool; angle: of a pixel, radians; price: dissimilarity, summed over pixels, that a splat must save.

    A splat shows the mean color of its rectangle, blended with its neighbors'. One whose known depths differ by more
    than its side, as standard deviations of the logarithm go, lies on two surfaces and is always split.
    """
    size = wanted.shape
    side = 1 << LEVELS
    beyond = ((0, -size[0] % side), (0, -size[1] % side))
    colors = np.pad(image.astype(np.float32), (*beyond, (0, 0)), mode="edge")
    taken = np.pad(wanted, beyond)
    sure = np.pad(known & wanted, beyond)
    logarithm = np.log(np.where(sure, np.pad(depth, beyond), 1.0), dtype=np.float64)
    scale = _per_contrast(image)
    weight = np.where(taken, np.pad(scale, beyond), np.float32(0))
    left = np.where(residual >= EMPTY, EMPTY, residual * scale).astype(np.float32)
    left = np.where(taken, np.pad(left, beyond), np.float32(0))
    sums: dict[Key, tuple[np.ndarray, ...]] = {
        (0, 0): (taken.astype(np.float32), left, sure.astype(np.float64), logarithm, logarithm**2)
    }
    cost: dict[Key, np.ndarray] = {}
    choice: dict[Key, np.ndarray] = {}
    for key in np.ndindex(LEVELS + 1, LEVELS + 1):
        rows, columns = key
        if rows:  # of which nothing else is made any more
            sums[key] = tuple(_by_two_rows(value) for value in sums.pop((rows - 1, columns)))
        elif columns:
            sums[key] = tuple(_by_two_columns(value) for value in sums[0, columns - 1])
        count, nothing, number, first, second = sums[key]
        leaf = _distortion(colors, weight, key) + np.float32(price)
        variance = second / np.maximum(number, 1) - (first / np.maximum(number, 1)) ** 2
        leaf[variance > angle**2 * (1 << (rows + columns))] = np.inf
        impossible = np.full_like(leaf, np.inf)
        options = np.stack([
            nothing,
            leaf,
            _by_two_rows(cost[rows - 1, columns]) if rows else impossible,
            _by_two_columns(cost[rows, columns - 1]) if columns else impossible,
        ])  # fmt: skip
        best = np.argmin(options, axis=0).astype(np.int8)
        choice[key] = np.where(count > 0, best, NOTHING)
        cost[key] = np.where(count > 0, np.take_along_axis(options, best[None], axis=0)[0], 0.0)
    return _chosen(choice, taken, size)


def _per_contrast(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 factor from squared error to dissimilarity: 1 / (2 variance + C2) in SSIM's window."""
    colors = image.astype(np.float32)
    window = (2 * RADIUS + 1, 2 * RADIUS + 1)
    mean = cv2.GaussianBlur(colors, window, SIGMA)
    variance = np.maximum(cv2.GaussianBlur(colors**2, window, SIGMA) - mean**2, 0).mean(axis=-1)
    return np.asarray(1 / (2 * variance + np.float32(C2)), dtype=np.float32)


def _distortion(colors: np.ndarray, weight: np.ndarray, key: Key) -> np.ndarray:
    """Weighted squared error, mean over RGB, of each rectangle: of the means, blended, against the colors.

    weight: (H, W) of a pixel, 0 of one that does not count. A single pixel has no error.
    """
    height, width = weight.shape
    shape = (width >> key[1], height >> key[0])
    if key == (0, 0):
        return np.zeros_like(weight)
    means = cv2.resize(colors, shape, interpolation=cv2.INTER_AREA)
    difference = colors - cv2.resize(means, (width, height), interpolation=cv2.INTER_LINEAR)
    squared = np.einsum("ijk,ijk->ij", difference, difference) * weight / np.float32(3)
    area = np.float32(1 << (key[0] + key[1]))
    return np.asarray(cv2.resize(squared, shape, interpolation=cv2.INTER_AREA) * area)


def _chosen(choice: dict[Key, np.ndarray], taken: np.ndarray, size: tuple[int, ...]) -> Partition:
    """The rectangles that the choices lead to from the largest down; of whole images, cut to `size`."""
    labels = np.full(taken.shape, -1, dtype=np.int64)
    reached = {key: np.zeros(value.shape, dtype=bool) for key, value in choice.items()}
    reached[LEVELS, LEVELS][:] = True
    sides: list[np.ndarray] = []
    total = 0
    for key in sorted(choice, key=sum, reverse=True):
        rows, columns = key
        leaves = reached[key] & (choice[key] == LEAF)
        number = int(leaves.sum())
        named = np.full(leaves.shape, -1)
        named[leaves] = total + np.arange(number)
        whole = _by_halves(_by_halves(named, rows, 0), columns, 1)
        labels = np.where((whole >= 0) & taken, whole, labels)
        sides.append(np.tile([[1 << rows, 1 << columns]], (number, 1)))
        total += number
        if rows:
            reached[rows - 1, columns] |= _by_halves(reached[key] & (choice[key] == ROWS), 1, 0)
        if columns:
            reached[rows, columns - 1] |= _by_halves(reached[key] & (choice[key] == COLUMNS), 1, 1)
    return Partition(labels[: size[0], : size[1]], np.concatenate(sides))


def _by_two_rows(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[0::2] + values[1::2])


def _by_two_columns(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[:, 0::2] + values[:, 1::2])


def _by_halves(values: np.ndarray, times: int, axis: int) -> np.ndarray:
    """Each value for all the smaller rectangles that it is split into."""
    return np.asarray(np.repeat(values, 1 << times, axis))
