"""Pinhole cameras. Pixel (0, 0) is the CENTER of the first pixel; intrinsics are (fx, fy, cx, cy) in pixels."""

from __future__ import annotations

import cv2
import numpy as np


def scale_intrinsics(intrinsics: np.ndarray, from_size: tuple[int, int], to_size: tuple[int, int]) -> np.ndarray:
    """Intrinsics (4,) of the same field of view at another size; sizes are (height, width)."""
    sy, sx = to_size[0] / from_size[0], to_size[1] / from_size[1]
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    return np.array([fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5])


def matrix(intrinsics: np.ndarray) -> np.ndarray:
    """(3, 3) float64 camera matrix K."""
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(u, v), each (height, width) float64."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return u, v


def unproject(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Camera-frame points (H, W, 3) float64 of a depth map (H, W)."""
    u, v = pixel_grid(*depth.shape)
    fx, fy, cx, cy = intrinsics
    z = depth.astype(np.float64)
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)


def project(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of camera-frame points (..., 3); the caller checks that z > 0."""
    fx, fy, cx, cy = intrinsics
    z = points[..., 2]
    return np.stack([fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy], axis=-1)


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Image at (height, width): area filter when shrinking, linear when enlarging."""
    if image.shape[:2] == tuple(size):
        return image
    shrink = size[0] < image.shape[0]
    resized = cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    return np.asarray(resized)


def fit_size(height: int, width: int, area: int, multiple: int = 8) -> tuple[int, int]:
    """(height, width) of about `area` pixels, same aspect, both multiples of `multiple`; never enlarges."""
    factor = min(1.0, (area / (height * width)) ** 0.5)
    return (
        max(multiple, round(height * factor / multiple) * multiple),
        max(multiple, round(width * factor / multiple) * multiple),
    )
