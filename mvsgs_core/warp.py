"""Plane-sweep warps between two pinhole cameras, and how many pixels a change of inverse depth moves a point."""

from __future__ import annotations

import numpy as np

from mvsgs_core import camera, geometry


def relative_warp(
    reference_intrinsics: np.ndarray,
    reference_pose: np.ndarray,
    neighbor_intrinsics: np.ndarray,
    neighbor_pose: np.ndarray,
) -> np.ndarray:
    """(12,) float64: m (3x3, row by row) and b (3) with (X, Y, Z) = m (u, v, 1) + w b, w the inverse depth.

    The pixel in the neighbor is (X / Z, Y / Z) and its depth there Z / w. Poses are world_from_cam (4, 4).
    """
    neighbor_from_reference = geometry.inverse(neighbor_pose) @ reference_pose
    k_neighbor = camera.matrix(neighbor_intrinsics)
    m = k_neighbor @ neighbor_from_reference[:3, :3] @ np.linalg.inv(camera.matrix(reference_intrinsics))
    b = k_neighbor @ neighbor_from_reference[:3, 3]
    return np.concatenate([m.reshape(9), b])


def apply_warp(
    warp: np.ndarray, u: np.ndarray, v: np.ndarray, inverse_depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (x, y) in the neighbor and Z, the depth there times the inverse depth here; Z > 0 is in front."""
    m, b = warp[:9].reshape(3, 3), warp[9:]
    xs, ys, zs = (m[i, 0] * u + m[i, 1] * v + m[i, 2] + b[i] * inverse_depth for i in range(3))
    safe = np.where(zs > 1e-9, zs, 1.0)
    return xs / safe, ys / safe, zs


def parallax(warp: np.ndarray, size: tuple[int, int], inverse_depth: float) -> float:
    """Pixels in the neighbor per unit of inverse depth at `inverse_depth`, median over the reference of `size`."""
    height, width = size
    u, v = np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5))
    delta = 0.02 * inverse_depth
    x0, y0, z0 = apply_warp(warp, u, v, np.full_like(u, inverse_depth - delta))
    x1, y1, z1 = apply_warp(warp, u, v, np.full_like(u, inverse_depth + delta))
    front = (z0 > 0) & (z1 > 0)
    if not front.any():
        return 0.0
    return float(np.median(np.hypot(x1 - x0, y1 - y0)[front]) / (2 * delta))
