"""The inside of a colored box, ray-traced exactly at a few pixels: views with true pose, depth and normals."""

from __future__ import annotations

import numpy as np

from mvsgs_core import camera
from mvsgs_core.mapping.keyframes import RGBDKeyframe

HALF = np.array([1.6, 1.2, 1.4])  # half edges of the box
BOX = np.array([0.0, 0.0, 1.0])  # its center


def pose_on_arc(t: float) -> np.ndarray:
    """Camera (4, 4) at t in [0, 1] of a short sideways arc that looks into the box."""
    angle = (t - 0.5) * 0.5
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.8 * (t - 0.5), 0.1 * np.sin(6 * t), 0.1 * t]
    return pose


def rgbd_keyframe(
    index: int, world_from_cam: np.ndarray, size: tuple[int, int] = (48, 64), origin: float = 0.0, unit: float = 1.0
) -> RGBDKeyframe:
    """The view from a pose; the world is scaled by `unit` and then moved by `origin` along x."""
    height, width = size
    intrinsics = np.array([0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5])
    rays = camera.unproject(np.ones(size), intrinsics)
    directions = rays @ world_from_cam[:3, :3].T
    start = world_from_cam[:3, 3] - BOX
    with np.errstate(divide="ignore"):
        distances = (np.where(directions > 0, HALF, -HALF) - start) / directions
    wall = np.argmin(distances, axis=-1)
    depth = np.take_along_axis(distances, wall[..., None], axis=-1)[..., 0]
    points = start + directions * depth[..., None]
    inward = -np.sign(directions) * np.eye(3)[wall]
    pose = world_from_cam.copy()
    pose[:3, 3] = pose[:3, 3] * unit + [origin, 0.0, 0.0]
    return RGBDKeyframe(
        index=index,
        image=np.round(255 * _texture(points, wall)).astype(np.uint8),
        intrinsics=intrinsics,
        world_from_cam=pose,
        depth=(depth * unit).astype(np.float32),
        normals=(inward @ world_from_cam[:3, :3]).astype(np.float32),
    )


def _texture(points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    phase = np.array([0.3, 1.7, 4.1])
    waves = np.sin(5.0 * points + phase) + np.cos(3.0 * points[..., [1, 2, 0]] - phase) + 0.7 * wall[..., None]
    color = 0.5 + 0.18 * waves
    return np.asarray(np.clip(color, 0.0, 1.0))
