"""What a camera makes of the colors it sees: image = clip(V(r) (A color + b)), all colors 0 to 1.

[A | b] (3, 4) is a frame's exposure and white balance, against the mean camera, whose colors the map has. V(r) = 1 +
v1 r^2 + v2 r^4 + v3 r^6 is the sensor's vignetting; r is the distance from the principal point over half the image's
diagonal, so that (v1, v2, v3) hold at every size.
"""

from __future__ import annotations

import numpy as np

IDENTITY = np.eye(3, 4, dtype=np.float32)
MAX_GAIN = 16.0  # of an exposure, up and down: no two images with a common range of gray levels differ by more
MAX_OFFSET = 1.0  # of an exposure: black would be white
MIN_FACTOR = 0.1  # of a vignetting, and MAX_FACTOR: a lens that shows an image is within
MAX_FACTOR = 2.0


def compose(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Affines (..., 3, 4) float64 that do `first`, then `second`."""
    a, b = np.asarray(second, dtype=np.float64), np.asarray(first, dtype=np.float64)
    offset = (a[..., :3] @ b[..., 3:]) + a[..., 3:]
    return np.concatenate([a[..., :3] @ b[..., :3], offset], axis=-1)


def inverse(affine: np.ndarray) -> np.ndarray:
    """Of affines (..., 3, 4), float64. Raises numpy.linalg.LinAlgError for one that is singular."""
    matrix = np.linalg.inv(np.asarray(affine, dtype=np.float64)[..., :3])
    return np.concatenate([matrix, -matrix @ np.asarray(affine, dtype=np.float64)[..., 3:]], axis=-1)


def is_exposure(affine: np.ndarray) -> bool:
    """Whether a camera may have this affine (3, 4)."""
    if not np.isfinite(affine).all() or np.abs(affine[:, 3]).max() > MAX_OFFSET:
        return False
    gains = np.linalg.svd(affine[:, :3].astype(np.float64), compute_uv=False)
    return bool(gains[0] <= MAX_GAIN and gains[-1] >= 1.0 / MAX_GAIN)


def is_vignetting(vignetting: np.ndarray) -> bool:
    """Whether a lens may have these coefficients (3,)."""
    if not np.isfinite(vignetting).all():
        return False
    factor = _polynomial(vignetting, np.linspace(0.0, 1.0, 33))
    return bool(factor.min() >= MIN_FACTOR and factor.max() <= MAX_FACTOR)


def vignetting_factor(vignetting: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """V (h, w) float32 at each pixel of an image of `size` (height, width) with `intrinsics` (4,) at that size.

    Beyond r = 1, where a principal point off the middle lets corners be, that of r = 1: no polynomial holds there.
    """
    height, width = size
    x, y = (np.arange(width) - intrinsics[2])[None, :], (np.arange(height) - intrinsics[3])[:, None]
    square = (x**2 + y**2) / (0.25 * (height**2 + width**2))
    return _polynomial(vignetting, np.sqrt(np.minimum(square, 1.0))).astype(np.float32)


def _polynomial(vignetting: np.ndarray, radius: np.ndarray) -> np.ndarray:
    square = radius**2
    v1, v2, v3 = np.asarray(vignetting, dtype=np.float64)
    return np.asarray(1.0 + square * (v1 + square * (v2 + square * v3)))
