"""Renders as a rolling shutter would have taken them, so that they can be compared with the photographs.

A map is rendered for one moment, the middle of the readout; the photograph's rows were read one after the other.
With camera velocity (v, w), in the camera's axes, a point X of depth Z moves by dX/dt = -v - w x X, and its pixel by
the projection of that: row r shows it (r / H - 1/2) * readout_time later (first order in the readout time, as in the
tracker). The velocity is that of the run's own trajectory, the depth that of the map's own render.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import pixel_grid, unproject

LONGEST_GAP = 0.25  # seconds between frames: over a longer one the velocity is not known


@dataclass(frozen=True)
class Shutter:
    """How one photograph was read out."""

    readout_time: float  # seconds from the first row to the last
    velocity: np.ndarray  # (6,) of the camera in its own axes: translation a second in map units, rotation in radians


def velocities(timestamps: np.ndarray, world_from_cam: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Camera velocities (N, 6) as in `Shutter`, by the `known` (N,) neighbors in time of each frame; else 0.

    timestamps: (N,) seconds, ascending. world_from_cam: (N, 4, 4).
    """
    result = np.zeros((len(timestamps), 6))
    order = np.flatnonzero(known)
    for k, n in enumerate(order):
        around = [m for m in order[max(k - 1, 0) : k + 2] if abs(timestamps[m] - timestamps[n]) < LONGEST_GAP]
        seconds = timestamps[around[-1]] - timestamps[around[0]]
        if seconds > 0.0:
            moved = geometry.inverse(world_from_cam[around[0]]) @ world_from_cam[around[-1]]
            result[n] = geometry.se3_log(moved) / seconds
    return result


def pixel_velocity(depth: np.ndarray, intrinsics: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """(H, W, 2) pixels a second at which a still scene of this depth (H, W), all of it known, moves in the image."""
    points = unproject(depth, intrinsics)
    moves = -velocity[:3] - np.cross(velocity[3:], points)
    z = depth.astype(np.float64)[..., None]
    return np.asarray(intrinsics[:2] * (moves[..., :2] - points[..., :2] / z * moves[..., 2:]) / z)


def apply_rolling_shutter(color: np.ndarray, depth: np.ndarray, intrinsics: np.ndarray, shutter: Shutter) -> np.ndarray:
    """A render (H, W, 3) float32 with its depth (H, W), 0 unknown, as the shutter would have seen it.

    Where nothing is rendered, the median depth stands in.
    """
    known = np.isfinite(depth) & (depth > 0)
    if shutter.readout_time == 0.0 or not shutter.velocity.any() or not known.any():
        return color
    full = np.where(known, depth, np.median(depth[known]))
    u, v = pixel_grid(*depth.shape)
    moved = pixel_velocity(full, intrinsics, shutter.velocity) * (shutter.readout_time * (v / len(v) - 0.5))[..., None]
    at = (np.dstack([u, v]) - moved).astype(np.float32)
    result = cv2.remap(color, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(result, 0.0, 1.0)


__all__ = ["LONGEST_GAP", "Shutter", "apply_rolling_shutter", "pixel_velocity", "velocities"]
