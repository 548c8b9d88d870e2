"""The kernel of `partition` in NumPy: what it is tested against."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.mapping.partition import LEVELS, Split

NOTHING, LEAF, ROWS, COLUMNS = range(4)  # what becomes of a rectangle

Key = tuple[int, int]  # a rectangle of 2^key[0] rows and 2^key[1] columns


def split(given: Split) -> tuple[np.ndarray, np.ndarray]:
    """Labels (H, W) int64, -1 where there is no rectangle, and rows and columns (N, 2) int64 of each."""
    taken, logarithm = given.taken, given.logarithm
    sums: dict[Key, tuple[np.ndarray, ...]] = {
        (0, 0): (taken.astype(np.float32), given.left, given.sure.astype(np.float64), logarithm, logarithm**2)
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
        leaf = _distortion(given.colors, given.weight, key) + np.float32(given.price)
        variance = second / np.maximum(number, 1) - (first / np.maximum(number, 1)) ** 2
        leaf[variance > given.depth_noise**2 + given.angle**2 * (1 << (rows + columns))] = np.inf
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
    return _chosen(choice, taken)


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


def _chosen(choice: dict[Key, np.ndarray], taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rectangles that the choices lead to from the largest down."""
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
    return labels, np.concatenate(sides)


def _by_two_rows(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[0::2] + values[1::2])


def _by_two_columns(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[:, 0::2] + values[:, 1::2])


def _by_halves(values: np.ndarray, times: int, axis: int) -> np.ndarray:
    """Each value for all the smaller rectangles that it is split into."""
    return np.asarray(np.repeat(values, 1 << times, axis))
