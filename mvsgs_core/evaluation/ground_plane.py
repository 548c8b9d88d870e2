"""Where up is, by how a camera was held: no gravity is known of a stream of images."""

from __future__ import annotations

import numpy as np

_TURNED = 0.03  # sin² of 10°: a camera that turned by less does not say the plane of its x axes
_FLAT = 0.25  # out of that plane they reach at most this fraction of the smaller extent in it, both squared


def up_direction(rotations: np.ndarray) -> np.ndarray:
    """(3,) unit vector in the world of camera rotations (N, 3, 3) world from camera, N >= 1.

    Who films holds the camera level, so that its x axes stay in the ground plane: up is normal to them. Where the
    camera turned too little to say that, up is the mean of what is up in the images.
    """
    upward = -rotations[:, :, 1].mean(axis=0)
    right = rotations[:, :, 0]
    extents, directions = np.linalg.eigh(right.T @ right / len(right))
    if extents[1] > _TURNED and extents[0] < _FLAT * extents[1]:
        normal = directions[:, 0]
        return np.asarray(normal if normal @ upward >= 0 else -normal)
    length = np.linalg.norm(upward)
    return np.asarray(upward / length if length > 1e-6 else -rotations[0, :, 1])


def ground_axes(rotations: np.ndarray) -> np.ndarray:
    """(2, 3): right and ahead of the first camera, in the ground plane. Rotations (N, 3, 3) as for `up_direction`."""
    up = up_direction(rotations)
    first = rotations[0]
    # of a camera that looks down, what is up in its image lies ahead
    ahead = max((axis - (axis @ up) * up for axis in (first[:, 2], -first[:, 1])), key=lambda flat: float(flat @ flat))
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead])


__all__ = ["ground_axes", "up_direction"]
