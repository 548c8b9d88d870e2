"""How gray levels follow the light: a camera's step from one exposure to another, and its vignetting.

An exposure's change moves a gray level I (0 to 1) by dI = (g I + h (m - I)) dt, for t from 0 to 1, with m = `MIDDLE`:
g is the log gain of mid gray, h what dark levels gain over it. So images differ by affines, slope e^(g - h), and log
ratios of gray levels are g + h (m / I - 1), linear in both. A camera whose gray levels are (light)^p - o, as those of
sRGB or with a black level, has h = k g with o = k m / (1 - k); k is its response. Its exponent p cannot be seen from
unknown exposures (Grossberg and Nayar 2003): it is part of the gains.
"""

from __future__ import annotations

import numpy as np

MIDDLE = 0.4  # gray level, 0 to 1: about the mean of most images
DARKEST, BRIGHTEST = 0.03, 0.95  # gray levels that are followed: noise and black levels below, saturation above

_LEVELS = np.linspace(0.05, BRIGHTEST, 10)
_RADII = np.linspace(0.0, 1.0, 33)


def offset_term(levels: np.ndarray) -> np.ndarray:
    """What h multiplies in the log ratio of gray levels (...)."""
    return np.asarray(MIDDLE / levels - 1.0)


def radial_terms(points: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """r², r⁴ and r⁶ of points (N, 2): r the distance from the principal point over half the diagonal; (N, 3)."""
    square = ((points - intrinsics[2:]) ** 2).sum(axis=1) / (0.25 * (size[0] ** 2 + size[1] ** 2))
    return np.stack([square, square**2, square**3], axis=1)


def affine(gain: np.ndarray, lift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope and offset of the gray levels' change by g `gain` and h `lift`, both of any shape."""
    rate = np.asarray(gain - lift, dtype=np.float64)
    small = np.abs(rate) < 1e-8
    mean = np.where(small, 1.0, np.expm1(rate) / np.where(small, 1.0, rate))  # of e^(rate t)
    return np.exp(rate), MIDDLE * lift * mean


def vignetting_polynomial(logarithm: np.ndarray, response: float) -> np.ndarray:
    """(3,) v of 1 + v1 r² + v2 r⁴ + v3 r⁶, nearest over the image to what a log gain l1 r² + l2 r⁴ + l3 r⁶ of (3,) l,
    with `response` times that as lift, makes of mid gray."""
    powers = np.stack([_RADII**2, _RADII**4, _RADII**6], axis=1)
    slope, offset = affine(powers @ logarithm, response * (powers @ logarithm))
    return np.asarray(np.linalg.lstsq(powers, slope + offset / MIDDLE - 1.0, rcond=None)[0])


def change(gain: np.ndarray, lift: np.ndarray) -> float:
    """Root mean square of what gains and lifts (...) change about gray levels, 0 to 1."""
    slope, offset = affine(gain, lift)
    return float(np.sqrt(np.mean((_LEVELS * (slope[..., None] - 1.0) + offset[..., None]) ** 2)))


def vignetting_change(logarithm: np.ndarray) -> float:
    """Root mean square over the image of l1 r² + l2 r⁴ + l3 r⁶, (3,) l, its mean taken out: that would be exposure."""
    values = np.stack([_RADII**2, _RADII**4, _RADII**6], axis=1) @ logarithm
    weight = _RADII / _RADII.sum()  # rings of the image
    return float(np.sqrt(weight @ (values - weight @ values) ** 2))


__all__ = [
    "BRIGHTEST",
    "DARKEST",
    "MIDDLE",
    "affine",
    "change",
    "offset_term",
    "radial_terms",
    "vignetting_change",
    "vignetting_polynomial",
]
