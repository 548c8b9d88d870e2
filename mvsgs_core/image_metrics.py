"""How close a render is to the photograph: PSNR and SSIM (Wang et al. 2004)."""

from __future__ import annotations

import cv2
import numpy as np

_K1, _K2, _WINDOW, _SIGMA = 0.01, 0.03, 11, 1.5


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two (H, W, 3) images with values in 0..1; inf for equal images.

    mask: (H, W) bool, the pixels that count; None: all.
    Raises ValueError for different shapes or values that are not finite.
    """
    _check(image, reference)
    squared = (image.astype(np.float64) - reference.astype(np.float64)) ** 2
    mse = float(np.mean(squared if mask is None else squared[mask]))
    return float("inf") if mse == 0 else -10.0 * float(np.log10(mse))


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean structural similarity of two (H, W, 3) images in 0..1: 11x11 Gaussian window, sigma 1.5, borders mirrored.

    mask: (H, W) bool, the windows' centers that count; None: all.
    Agrees with torchmetrics' structural_similarity_index_measure(data_range=1) to 1e-5 in less time.
    Raises ValueError for different shapes, for an image smaller than the window, or for values that are not finite.
    """
    _check(image, reference)
    if min(image.shape[:2]) < _WINDOW:
        raise ValueError(f"SSIM needs images of at least {_WINDOW}x{_WINDOW}, got {image.shape[:2]}")
    # float64: the variances below are differences of nearly equal numbers in flat regions
    x, y = image.astype(np.float64), reference.astype(np.float64)
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x**2
    variance_y = _blur(y * y) - mean_y**2
    covariance = _blur(x * y) - mean_x * mean_y
    c1, c2 = _K1**2, _K2**2
    index = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)) / (
        (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    )
    return float(np.mean(index if mask is None else index[mask]))


def _blur(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image, (_WINDOW, _WINDOW), _SIGMA, borderType=cv2.BORDER_REFLECT_101))


def _check(image: np.ndarray, reference: np.ndarray) -> None:
    if image.shape != reference.shape:
        raise ValueError(f"images of different shape: {image.shape} and {reference.shape}")
    if not (np.isfinite(image).all() and np.isfinite(reference).all()):
        raise ValueError("an image to be scored has values that are not finite")
