"""What two images say of each other's light: gray levels of matched points, as the moments of their log ratios.

Tracked points are the most textured of their cells, and texture lies about light: a window around an edge is off as
soon as the match is, and the mean of encoded gray levels falls as a texture comes nearer (its pixels average less of
it). So levels are means over small windows at the flattest place of a point's cell, weighted by their spread, in both
images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from mvsgs_core.camera import mean_of_colors
from mvsgs_core.tracking.estimation.response import BRIGHTEST, DARKEST, offset_term

NOISE = 1.0 / 255.0  # of a window's mean, gray levels 0 to 1: quantization and what is left of the sensor's noise
FLOOR = 0.02  # of a level that a place may be off, however flat it is: by what shines, or lies behind the point beside
SHARE = 1.0  # of a window's spread that counts as its error: a match beside may be off by a window
INSIDE = 2.0  # pixels at least that a place lies inside of the points around it
BESIDE = 0.1  # of a level that one may be off that does not
MIN_SAMPLES = 30
TERMS = 9  # 1, what an offset adds, three of the radius, what an offset adds to these, the log ratio
_STEPS = 4  # of reweighting
_LOWEST, _HIGHEST = math.ceil(255.0 * DARKEST), math.floor(255.0 * BRIGHTEST)  # that tell, 0 to 255
_RIDGE = 1e-4  # share of the whole: few samples tell the terms apart


class Levels:
    """Means and spread of the windows of 3x3 of a half-size image (h, w, 3) uint8 RGB, 0 to 1."""

    def __init__(self, half: np.ndarray, mask: np.ndarray | None = None) -> None:
        """mask: (h, w) bool, False where a pixel is to be ignored; None: all count."""
        values = half.astype(np.float32) * np.float32(1.0 / 255.0)
        mean, gray = np.asarray(cv2.blur(values, (3, 3))), mean_of_colors(values)
        window = np.ones((3, 3), np.uint8)
        bright = cv2.inRange(cv2.dilate(half, window), (0,) * 3, (_HIGHEST,) * 3) == 0
        dark = cv2.inRange(cv2.erode(half, window), (_LOWEST,) * 3, (255,) * 3) == 0
        mean[bright | dark] = np.nan
        spread = np.sqrt(np.maximum(cv2.blur(gray * gray, (3, 3)) - cv2.blur(gray, (3, 3)) ** 2, 0.0))
        if mask is not None:
            mean[~mask], spread[~mask] = np.nan, 1.0
        self._windows = np.dstack([mean, spread])

    def flattest(self, cell: int) -> np.ndarray:
        """(M, 2) where each cell of so many pixels is flattest, by rows; pixels of the full size."""
        side, spread = cell // 2, self._windows[..., 3]
        rows, columns = spread.shape[0] // side, spread.shape[1] // side
        tiles = spread.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows * columns, -1)
        best = np.argmin(tiles, axis=1)
        v, u = (c * side for c in np.divmod(np.arange(rows * columns), columns))
        return np.asarray(2.0 * np.stack([u + best % side, v + best // side], axis=1) + 0.5)

    def at(self, points: np.ndarray) -> Samples:
        """points (N, 2): pixels of the full size; NaN outside of the image and where the sensor is at its limits."""
        half = ((points + 0.5) / 2.0 - 0.5).astype(np.float32)
        found = cv2.remap(
            self._windows, half[None, :, 0], half[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
            borderValue=(np.nan, np.nan, np.nan, np.nan),
        )[0].astype(np.float64)  # fmt: skip
        return Samples(found[:, :3], found[:, 3])


@dataclass(frozen=True)
class Samples:
    """Gray levels (N, 3), 0 to 1, NaN where there is none, and their windows' spread (N,)."""

    level: np.ndarray
    spread: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> Samples:
        return Samples(self.level[chosen], self.spread[chosen])

    @property
    def variance(self) -> np.ndarray:
        """(N, 3) of the logarithm of the levels."""
        return np.asarray((NOISE**2 + (SHARE * self.spread[:, None]) ** 2) / self.level**2 + 0.5 * FLOOR**2)


def surrounded(places: np.ndarray, points: np.ndarray, found: np.ndarray, cells: tuple[int, int]) -> np.ndarray:
    """(M,) bool: the places (M, 2) that lie among points (M, 2) which were `found` (M,), those of the 3x3 cells around;
    of what was not found itself, none. By rows of `cells` = (rows, columns).

    A smooth place beside a contour may be of what is behind it: it moves otherwise than the points, and a sky, of which
    nothing is matched, would be compared with a sky that is higher up, step by step as the camera drives on.
    """
    around = np.full((cells[0] + 2, cells[1] + 2, 2), np.nan)
    around[1:-1, 1:-1] = np.where(found[:, None], points, np.nan).reshape(*cells, 2)
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)])
    reach = np.full((len(places), 8), -np.inf)  # of the points, seen from the place
    for row, column in product(range(3), range(3)):  # np.ndindex keeps 100 bytes a call
        near = around[row : row + cells[0], column : column + cells[1]].reshape(-1, 2)
        reach = np.fmax(reach, (near - places) @ directions)
    return np.asarray(found & (reach > INSIDE).all(axis=1))


def log_ratio_moments(
    a: Samples, b: Samples, radial: tuple[np.ndarray, np.ndarray], dark: np.ndarray, doubt: np.ndarray | None = None
) -> np.ndarray | None:
    """Weighted moments (3, 9, 9), a channel each, of z = (1, offset term, radial terms' change, that of their products
    with the offset term, log b / a).

    radial: terms (N, 3) in a and b. doubt (N,): parts of a level that a sample may be off besides; None: nothing.
    dark (3,): the vignetting as far as it is known, log V = dark · radial; without it the mean levels of the offset
    term are, and half of it those of the products. Weights are those of independent samples, outliers from what light
    changes down-weighted (Cauchy), so that the moments are information. None where there are too few samples.
    """
    known = np.isfinite(a.level).all(axis=1) & np.isfinite(b.level).all(axis=1)
    if known.sum() < MIN_SAMPLES:
        return None
    a, b = a[known], b[known]
    also = 0.0 if doubt is None else doubt[known, None] ** 2
    log_a, log_b = np.log(a.level), np.log(b.level)
    ratio, variance = log_b - log_a, a.variance + b.variance + also
    mean_ratio, sigma = ratio.mean(axis=1), np.sqrt(variance.mean(axis=1))
    at_a, at_b = (r[known] for r in radial)
    even = 0.5 * (log_a + log_b - ((at_a + at_b) @ dark)[:, None])  # noise of the ratio is not in it
    z = np.zeros((3, len(sigma), TERMS))
    z[..., 0] = 1.0
    z[..., 1] = offset_term(np.exp(even)).T
    z[..., 2:5] = at_b - at_a
    light = z[..., :5].mean(axis=0)  # what it can change: what is off by that is no outlier
    robust, scale = np.ones(len(sigma)), 1.0
    for _ in range(_STEPS):
        weight = robust / sigma**2
        normal = (light.T * weight) @ light
        change = np.linalg.solve(normal + _RIDGE * np.trace(normal) * np.eye(5), light.T @ (weight * mean_ratio))
        error = (mean_ratio - light @ change) / sigma
        scale = 1.4826 * float(np.median(np.abs(error))) + 1e-9
        robust = 1.0 / (1.0 + (error / (2.0 * scale)) ** 2)
    half = 0.5 * (weight @ ratio) / weight.sum()  # of the ratio, without the noise of a sample's own
    for at, sign in ((at_a, -1.0), (at_b, 1.0)):
        term = offset_term(np.exp(even + sign * half + 0.5 * (at @ dark)[:, None]))
        z[..., 5:8] += sign * term.T[..., None] * at
    z[..., 8] = ratio.T
    weight = (robust[:, None] / (variance * scale**2)).T
    return np.asarray((weight[..., None] * z).transpose(0, 2, 1) @ z)


def of_response(moments: np.ndarray, response: float) -> np.ndarray:
    """Moments' columns (..., 9) as those (..., 6) of (1, offset term, radial terms, log ratio), for a vignetting that
    lifts dark levels `response` times as much as it brightens."""
    radial = moments[..., 2:5] + response * moments[..., 5:8]
    return np.concatenate([moments[..., :2], radial, moments[..., 8:]], axis=-1)


def backward(moments: np.ndarray) -> np.ndarray:
    """The same seen from b to a: log ratio and radial terms change their sign."""
    sign = np.array([1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0])
    return np.asarray(moments * sign * sign[:, None])


__all__ = ["MIN_SAMPLES", "TERMS", "Levels", "Samples", "backward", "log_ratio_moments", "of_response", "surrounded"]
