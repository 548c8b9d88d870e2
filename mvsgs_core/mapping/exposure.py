"""A keyframe's exposure and white balance: the affine [A | b] (3, 4) that takes the map's colors to the image's.

The map's own colors are known up to one affine of all: as the map leaves the mapper, the mean over the keyframes is the
identity, so that frames whose exposure nobody knows look as the average one.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats

IDENTITY = np.eye(3, 4, dtype=np.float32)
MIN_KNOWN = 0.05  # fraction of the image that the map must show
MIN_OPACITY = 0.9  # of a pixel that the map shows
SATURATED = 0.98  # a camera's color from here on, and from its complement down, is cut off
SAMPLES = 20000  # pixels that are fitted, at most
HOLD = 1e-3  # variance of color that counts as much as the identity does
GAINS = (0.25, 4.0)  # what a fit may say
# Of a fit, toward the identity. A fit is a percent off, new splats pass that on to the next keyframe's fit, and only
# this keeps a long path from drifting; the training finds the rest.
KEPT = 0.9


def fitted_exposure(render: np.ndarray, opacity: np.ndarray, image: np.ndarray) -> np.ndarray | None:
    """Gain and offset of each channel that bring a render (H, W, 3) to an image, both in 0..1: (3, 4) float32.

    Robust (Cauchy): what the map does not know yet, or has at a wrong place, has little say. opacity: (H, W) of the
    render. None where the map shows too little of the image.
    """
    known = (opacity > MIN_OPACITY) & np.isfinite(render).all(axis=-1) & np.isfinite(image).all(axis=-1)
    known &= (image > 1.0 - SATURATED).all(axis=-1) & (image < SATURATED).all(axis=-1)
    if known.mean() < MIN_KNOWN:
        return None
    every = max(1, int(known.sum()) // SAMPLES)
    affine = np.zeros((3, 4), dtype=np.float32)
    for channel in range(3):
        x = render[..., channel][known][::every].astype(np.float64)
        y = image[..., channel][known][::every].astype(np.float64)
        gain, offset = 1.0, float(np.median(y - x))
        for _ in range(10):
            error = np.abs(gain * x + offset - y)
            weight = 1.0 / (1.0 + (error / (1.48 * np.median(error) + 1e-6)) ** 2)
            weight /= weight.sum()
            mean_x, mean_y = weight @ x, weight @ y
            covariance = weight @ ((x - mean_x) * (y - mean_y))
            gain = float(np.clip((covariance + HOLD) / (weight @ (x - mean_x) ** 2 + HOLD), *GAINS))
            offset = mean_y - gain * mean_x
        affine[channel, channel], affine[channel, 3] = 1.0 + KEPT * (gain - 1.0), KEPT * offset
    return affine


def colors_of_map(colors: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """Colors (..., 3) of an image as the map has them, in 0..1."""
    matrix, offset = exposure[:, :3].astype(np.float64), exposure[:, 3].astype(np.float64)
    return np.clip((colors - offset) @ np.linalg.pinv(matrix).T, 0.0, 1.0)


def relative_to_mean(splats: Splats, exposures: np.ndarray) -> tuple[Tensor, np.ndarray]:
    """Harmonics (N, B, 3) in the colors of the mean of `exposures` (K, 3, 4), and those relative to it, mean identity.

    Both together render the same images as before.
    """
    mean = exposures.astype(np.float64).mean(axis=0)
    matrix, offset = torch.from_numpy(mean[:, :3]), torch.from_numpy(mean[:, 3])
    sh = splats.sh.to(torch.float64) @ matrix.T
    sh[:, 0] += (offset + matrix.sum(dim=1) * 0.5 - 0.5) / C0
    inverse = np.linalg.pinv(mean[:, :3])
    relative = exposures.astype(np.float64)
    relative[:, :, :3] = relative[:, :, :3] @ inverse
    relative[:, :, 3] -= relative[:, :, :3] @ mean[:, 3]
    return sh.to(torch.float32), relative.astype(np.float32)
