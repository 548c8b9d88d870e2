"""Whether poses, depth, intrinsics and images of a sequence belong together, measured by the images alone."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.camera import matrix, project, unproject
from mvsgs_core.datasets import Item
from mvsgs_core.geometry import inverse, skew


def photometric_error(a: Item, b: Item, world_from_cam_b: np.ndarray | None = None) -> float:
    """Median absolute gray difference, 0 to 255, of the pixels of `a` to where their true depth puts them in `b`."""
    assert a.depth is not None
    assert a.world_from_cam is not None
    pose_b = b.world_from_cam if world_from_cam_b is None else world_from_cam_b
    assert pose_b is not None
    b_from_a = inverse(pose_b) @ a.world_from_cam
    known = (a.depth > 0) & (np.arange(a.depth.size).reshape(a.depth.shape) % 31 == 0)  # a sample: remap takes < 2^15
    points = unproject(a.depth, a.intrinsics)[known] @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    ahead = points[:, 2] > 1e-6
    pixels = project(points[ahead], b.intrinsics).astype(np.float32)
    height, width = b.image.shape[:2]
    inside = np.all((pixels >= 0) & (pixels <= (width - 1, height - 1)), axis=1)
    assert inside.mean() > 0.3, "the two frames do not overlap: no measure of their poses"
    gray_a, gray_b = _smooth_gray(a.image), _smooth_gray(b.image)
    sampled = cv2.remap(gray_b, pixels[None, :, 0], pixels[None, :, 1], cv2.INTER_LINEAR)[0]
    return float(np.median(np.abs(sampled - gray_a[known][ahead])[inside]))


def epipolar_error(a: Item, b: Item, intrinsics: np.ndarray | None = None, mirror: bool = False) -> float:
    """Median distance, in pixels, of SIFT matches from the epipolar line that the poses say.

    intrinsics: other ones for both; mirror: uses inverted poses, a convention that is wrong.
    """
    assert a.world_from_cam is not None
    assert b.world_from_cam is not None
    sift = cv2.SIFT_create(1500)
    points_a, descriptors_a = sift.detectAndCompute(_gray(a.image), None)
    points_b, descriptors_b = sift.detectAndCompute(_gray(b.image), None)
    matches = [
        m
        for m, second in cv2.BFMatcher().knnMatch(descriptors_a, descriptors_b, k=2)
        if m.distance < 0.7 * second.distance
    ]
    assert len(matches) > 30, "too few matches to measure with"
    pixels_a = np.array([(*points_a[m.queryIdx].pt, 1.0) for m in matches])
    pixels_b = np.array([(*points_b[m.trainIdx].pt, 1.0) for m in matches])
    pose_a, pose_b = a.world_from_cam, b.world_from_cam
    if mirror:
        pose_a, pose_b = inverse(pose_a), inverse(pose_b)
    b_from_a = inverse(pose_b) @ pose_a
    k_a = np.linalg.inv(matrix(a.intrinsics if intrinsics is None else intrinsics))
    k_b = np.linalg.inv(matrix(b.intrinsics if intrinsics is None else intrinsics))
    fundamental = k_b.T @ skew(b_from_a[:3, 3]) @ b_from_a[:3, :3] @ k_a
    line_b, line_a = pixels_a @ fundamental.T, pixels_b @ fundamental
    residual = np.abs(np.sum(pixels_b * line_b, axis=1))
    norm = np.sqrt(np.sum(line_a[:, :2] ** 2, axis=1) + np.sum(line_b[:, :2] ** 2, axis=1))
    return float(np.median(residual / norm))


def _gray(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _smooth_gray(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(_gray(image).astype(np.float32), (0, 0), 1.0))
