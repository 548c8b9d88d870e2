"""Features that are found again across wide steps: SIFT (Lowe 2004) with square-rooted descriptors (RootSIFT).

RootSIFT (Arandjelovic and Zisserman 2012): the Euclidean distance of square roots is the Hellinger distance of the
histograms, so that a dot product compares two descriptors.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.camera import fit_size, mask_at, resize_image, stretching

AREA = 1280 * 960  # pixels of the image that features are found in, at most
CONTRAST = 0.02  # of a blob: half of Lowe's, who had photographs of higher contrast


@dataclass(frozen=True)
class Features:
    """Those of one photograph, those of the largest scale first."""

    points: np.ndarray  # (N, 2) float64 pixels of the photograph
    descriptors: np.ndarray  # (N, 128) float32 of length 1
    extent: np.ndarray  # (N,) float64 pixels across
    angle: np.ndarray  # (N,) float64 radians, of its strongest gradients


def find_features(image: np.ndarray, count: int, mask: np.ndarray | None = None) -> Features:
    """The `count` strongest features of an RGB image (H, W, 3) uint8; fewer where there are not so many.

    mask: (H, W) bool, False where none is to be; None: anywhere.
    """
    height, width = image.shape[:2]
    size = fit_size(height, width, AREA, 1)
    gray = cv2.cvtColor(resize_image(image, size), cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(count, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    seen = mask_at(mask, size)
    table = stretching(gray, seen)
    gray = gray if table is None else np.asarray(cv2.LUT(gray, table))
    found, descriptors = sift.detectAndCompute(gray, None if seen is None else seen.astype(np.uint8))
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros(0), np.zeros(0))
    order = np.argsort([-f.size for f in found], kind="stable")[:count]
    points = np.array([found[i].pt for i in order], np.float64).reshape(-1, 2)
    points = (points + 0.5) * [width / size[1], height / size[0]] - 0.5
    histograms = descriptors[order].astype(np.float32)
    histograms /= np.maximum(histograms.sum(axis=1, keepdims=True), 1e-6)
    extent = np.array([found[i].size for i in order], np.float64) * width / size[1]
    angle = np.radians([found[i].angle for i in order], dtype=np.float64)
    return Features(points, np.sqrt(histograms), extent, angle)


__all__ = ["Features", "find_features"]
