"""Rigid and similarity transforms, float64. A pose is a 4x4 matrix; names say the frames: `world_from_cam`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # the axes of a camera; its own inverse
FARTHEST = 1e100  # in any unit: what lies beyond is no position
_STILL = 1e-9  # of a position's magnitude: two that are nearer are the same


def inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (..., 4, 4)."""
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    result = np.zeros_like(pose, dtype=np.float64)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -(rotation_t @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(4, 4) of a rotation (3, 3) and a translation (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def is_rigid(pose: np.ndarray) -> bool:
    """Whether (4, 4) is a rotation and a position, up to the rounding of who wrote it down; squares of the latter can
    be taken."""
    if not np.abs(pose[:3, 3]).max() < FARTHEST or not np.isfinite(pose).all():
        return False
    rotation = pose[:3, :3]
    if np.abs(rotation).max() > 2.0 or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0)


def scaled(pose: np.ndarray, factor: float) -> np.ndarray:
    """Poses (..., 4, 4), their lengths multiplied."""
    result = np.array(pose, np.float64)
    result[..., :3, 3] *= factor
    return result


def twist_scaled(twist: np.ndarray, factor: float) -> np.ndarray:
    """Twists (..., 6) = (translation, rotation), their lengths multiplied."""
    return np.asarray(twist * np.repeat([factor, 1.0], 3))


def skew(v: np.ndarray) -> np.ndarray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape[:-1], 3, 3)


def _angles(omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared angles (..., 1, 1) of rotation vectors, where they are so small that series are used, and angles or 1."""
    theta2 = np.sum(omega * omega, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta < 1e-4
    return theta2, small, np.where(small, 1.0, theta)


def so3_exp(omega: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    theta2, small, safe = _angles(omega)
    a = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    k = skew(omega)
    return np.eye(3) + a * k + b * (k @ k)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) next to matrices (..., 3, 3), scaled or rounded, whose determinants are positive.

    `inverse` takes the transpose: a rotation that is none by 1e-3 has no inverse, and what is chained with it is bent.
    """
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


def so3_log(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) of rotation matrices (..., 3, 3), stable up to and at pi (by quaternion)."""
    q = quaternion_from_rotation(rotation)
    q = np.where(q[..., :1] < 0, -q, q)
    w, v = q[..., 0], q[..., 1:]
    n = np.linalg.norm(v, axis=-1)
    angle = 2.0 * np.arctan2(n, w)
    factor = np.where(n < 1e-9, 2.0, angle / np.where(n < 1e-9, 1.0, n))
    return v * factor[..., None]


def se3_exp(xi: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) of twists (..., 6) = (translation, rotation)."""
    rho, omega = xi[..., :3], xi[..., 3:]
    theta2, small, safe = _angles(omega)
    b = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    c = np.where(small, 1.0 / 6.0 - theta2 / 120.0, (safe - np.sin(safe)) / safe**3)
    k = skew(omega)
    v = np.eye(3) + b * k + c * (k @ k)
    pose = np.zeros((*xi.shape[:-1], 4, 4))
    pose[..., :3, :3] = so3_exp(omega)
    pose[..., :3, 3] = (v @ rho[..., None])[..., 0]
    pose[..., 3, 3] = 1.0
    return pose


def se3_log(pose: np.ndarray) -> np.ndarray:
    """Twists (..., 6) = (translation, rotation) of poses (..., 4, 4)."""
    omega = so3_log(pose[..., :3, :3])
    _, small, safe = _angles(omega)
    half = 0.5 * safe
    c = np.where(small, 1.0 / 12.0, (1.0 - half * np.cos(half) / np.sin(half)) / safe**2)
    k = skew(omega)
    v_inv = np.eye(3) - 0.5 * k + c * (k @ k)
    rho = (v_inv @ pose[..., :3, 3:])[..., 0]
    return np.concatenate([rho, omega], axis=-1)


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), w first, of rotation matrices (..., 3, 3): the largest component is solved first."""
    m = rotation
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    four_squares = np.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], axis=-1
    )
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 0, 1] + m[..., 1, 0]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 1, 2] + m[..., 2, 1]
    rows = np.stack(
        [
            np.stack([four_squares[..., 0], a, b, c], axis=-1),
            np.stack([a, four_squares[..., 1], d, e], axis=-1),
            np.stack([b, d, four_squares[..., 2], f], axis=-1),
            np.stack([c, e, f, four_squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(four_squares, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def rotation_from_quaternion(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w first; normalised here."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    return np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    ).reshape(*q.shape[:-1], 3, 3)  # fmt: skip


def interpolate(pose_a: np.ndarray, pose_b: np.ndarray, t: float) -> np.ndarray:
    """Pose (4, 4) on the screw motion from `pose_a` (t = 0) to `pose_b` (t = 1)."""
    return pose_a @ se3_exp(t * se3_log(inverse(pose_a) @ pose_b))


def moves(positions: np.ndarray) -> bool:
    """Whether positions (N, 3) differ by more than rounding: where they do not, they have no direction nor length."""
    magnitude = float(np.abs(positions).max(initial=0.0))
    return len(positions) > 0 and bool(np.ptp(positions, axis=0).max() > _STILL * (magnitude + 1.0))


@dataclass(frozen=True)
class Similarity:
    """X' = scale * rotation @ X + translation, float64."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    @classmethod
    def between(cls, old: np.ndarray, new: np.ndarray, scale: float) -> Similarity:
        """What was seen from pose `old` (4, 4), its depths multiplied by `scale`, and put at pose `new`."""
        rotation = new[:3, :3] @ old[:3, :3].T
        return cls(scale, rotation, new[:3, 3] - scale * rotation @ old[:3, 3])

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Where points (N, 3) go, (N, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def poses(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Where poses (N, 4, 4) go: they stay rigid."""
        moved = np.array(world_from_cam, np.float64)
        moved[:, :3, :3] = self.rotation @ moved[:, :3, :3]
        moved[:, :3, 3] = self.apply(moved[:, :3, 3])
        return moved

    def shifts(self, points: np.ndarray) -> np.ndarray:
        """Distances (N,) by which points (N, 3) move."""
        return np.asarray(np.linalg.norm(self.apply(points) - points, axis=1))

    def moves(self, length: float, tolerance: float = 1e-6) -> bool:
        """Whether a point within `length` moves by more than `tolerance` of it."""
        change = abs(self.scale - 1.0) + float(np.abs(self.rotation - np.eye(3)).max())
        return change + float(np.abs(self.translation).max()) / length > tolerance


def umeyama(source: np.ndarray, target: np.ndarray) -> Similarity:
    """From positions (N, 3) to others, by least squares (Umeyama 1991, eq. 40-42).

    Raises ValueError with fewer than 3 positions, and where either side has no extent.
    """
    if len(source) < 3:
        raise ValueError(f"an alignment needs at least 3 positions, got {len(source)}")
    if not (moves(source) and moves(target)):
        raise ValueError("all positions coincide: no alignment")
    scale, rotation, translation = umeyama_of_each(source, target)
    return Similarity(float(scale), rotation, translation)


def umeyama_of_each(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `umeyama`, of sets (..., N, 3) that have an extent: scales (...), rotations (..., 3, 3) and translations
    (..., 3)."""
    mean_s, mean_t = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    ds, dt = source - mean_s, target - mean_t
    variance = np.mean(np.sum(ds * ds, axis=-1), axis=-1)
    u, d, vt = np.linalg.svd(np.swapaxes(dt, -1, -2) @ ds / source.shape[-2])
    sign = np.ones_like(d)
    sign[..., 2] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0.0, -1.0, 1.0)
    rotation = (u * sign[..., None, :]) @ vt
    scale = np.sum(d * sign, axis=-1) / variance
    moved = (scale[..., None, None] * rotation) @ np.swapaxes(mean_s, -1, -2)
    return scale, rotation, mean_t[..., 0, :] - moved[..., 0]


def left_multiplication(q: np.ndarray) -> np.ndarray:
    """Matrices (K, 4, 4) with L(q) p = q p for quaternions (K, 4), w first."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
