"""A textured room corner, rendered in closed form: a back wall, a floor, and a box in front that hides part of both."""

from __future__ import annotations

import cv2
import numpy as np

NEAR, FAR = 1.5, 5.0


def look(x: float, turn: float = 0.0) -> np.ndarray:
    """world_from_cam (4, 4) of a camera at (x, 0, 0) that looks along z, turned about y by `turn` radians."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    pose[0, 3] = x
    return pose


def intrinsics_of(size: tuple[int, int]) -> np.ndarray:
    height, width = size
    return np.array([0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2])


def _rays(pose: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = intrinsics_of(size)
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64)
    local = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(size)], axis=-1)
    return pose[:3, 3], local @ pose[:3, :3].T


def _hits(pose: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (H, W), points (H, W, 3) and surface number (H, W)."""
    origin, rays = _rays(pose, size)
    wall = (FAR - origin[2]) / rays[..., 2]
    floor = np.where(rays[..., 1] > 1e-6, (1.2 - origin[1]) / np.maximum(rays[..., 1], 1e-6), np.inf)
    box = (2.2 - origin[2]) / rays[..., 2]
    at = origin + box[..., None] * rays
    on_box = (np.abs(at[..., 0] - 0.2) < 0.45) & (np.abs(at[..., 1] + 0.1) < 0.4)
    depth = np.stack([wall, floor, np.where(on_box, box, np.inf)])
    surface = np.argmin(depth, axis=0)
    depth = depth.min(axis=0)
    return depth, origin + depth[..., None] * rays, surface


def true_depth(pose: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """(H, W) float32; rays have z = 1 in the camera, so their length is depth."""
    return _hits(pose, (size[0], size[1]))[0].astype(np.float32)


def _texture(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """A sum of sines that never repeats within the scene, different on each surface; in [0, 1]."""
    rng = np.random.default_rng(3)
    value = np.zeros(surface.shape)
    for frequency in (2.1, 5.3, 11.0, 23.0, 41.0):
        for _ in range(2):
            direction = rng.normal(size=(3, 3))
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            phase = rng.uniform(0, 2 * np.pi, 3)
            along = np.einsum("hwc,hwc->hw", points, direction[surface])
            value += np.sin(frequency * along + phase[surface]) / 4.0
    return np.clip(0.5 + value / 3.0, 0.0, 1.0)


def render(
    pose: np.ndarray, size: tuple[int, int], gain: float = 1.0, bias: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, 3) uint8 and its intrinsics (4,); exposure by gain and bias in gray levels."""
    _, points, surface = _hits(pose, size)
    gray = np.clip(30.0 + 190.0 * _texture(points, surface), 0, 255) * gain + bias
    image = np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return image, intrinsics_of(size)
