"""Trajectory metrics after similarity alignment (Sturm et al. 2012; Umeyama 1991), and TUM trajectory files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core import geometry


@dataclass(frozen=True)
class Alignment:
    """truth = scale * rotation @ estimate + translation."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,)

    def positions(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Camera positions (N, 3) of estimated poses (N, 4, 4) in the frame of the truth."""
        return self.scale * world_from_cam[:, :3, 3] @ self.rotation.T + self.translation


def align(estimate: np.ndarray, truth: np.ndarray) -> Alignment:
    """Least-squares Sim(3) from estimated to true camera positions; both (N, 4, 4) world_from_cam.

    Raises ValueError where no alignment exists: fewer than 3 poses, or positions that coincide.
    """
    # the truth's own origin may be far away: solved around its mean inside umeyama, in float64
    return Alignment(*geometry.umeyama(estimate[:, :3, 3], truth[:, :3, 3]))


def absolute_errors(estimate: np.ndarray, truth: np.ndarray, alignment: Alignment) -> np.ndarray:
    """(N,) distances of aligned to true camera positions, in the unit of the truth."""
    return np.linalg.norm(alignment.positions(estimate) - truth[:, :3, 3], axis=1)


def rmse(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def relative_errors(estimate: np.ndarray, truth: np.ndarray, scale: float, step: int = 1) -> tuple[float, float]:
    """Relative pose error over `step` poses: RMSE of translation (truth's unit) and of rotation (degrees)."""
    if len(estimate) <= step:
        raise ValueError(f"relative errors over {step} poses need more than {step} poses")
    scaled = estimate.copy()
    scaled[:, :3, 3] *= scale
    move_e = geometry.inverse(scaled[:-step]) @ scaled[step:]
    move_t = geometry.inverse(truth[:-step]) @ truth[step:]
    error = geometry.inverse(move_t) @ move_e
    angles = np.linalg.norm(geometry.so3_log(error[:, :3, :3]), axis=1)
    return rmse(np.linalg.norm(error[:, :3, 3], axis=1)), float(np.degrees(rmse(angles)))


def path_length(world_from_cam: np.ndarray) -> float:
    """Length of the way through camera positions (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(world_from_cam[:, :3, 3], axis=0), axis=1).sum())


def write_tum(file: Path, timestamps: np.ndarray, world_from_cam: np.ndarray) -> None:
    """Writes `timestamp tx ty tz qx qy qz qw` lines, seconds and camera to world."""
    quaternions = geometry.quaternion_from_rotation(world_from_cam[:, :3, :3])
    with file.open("w") as out:
        out.write("# timestamp tx ty tz qx qy qz qw (camera to world)\n")
        for t, pose, (w, x, y, z) in zip(timestamps, world_from_cam, quaternions):
            values = (*pose[:3, 3], x, y, z, w)
            out.write(f"{t:.6f} " + " ".join(f"{v:.9g}" for v in values) + "\n")


def read_tum(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps (N,) and world_from_cam (N, 4, 4) of a TUM trajectory file. Raises ValueError for a bad line."""
    rows = []
    for number, line in enumerate(file.read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            row = [float(v) for v in line.replace(",", " ").split()]
        except ValueError as error:
            raise ValueError(f"{file}:{number}: not a number in {line!r}") from error
        if len(row) != 8:
            raise ValueError(f"{file}:{number}: expected `timestamp tx ty tz qx qy qz qw`, got {len(row)} values")
        rows.append(row)
    data = np.array(rows, dtype=np.float64).reshape(-1, 8)
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    if len(data):
        poses[:, :3, :3] = geometry.rotation_from_quaternion(data[:, [7, 4, 5, 6]])
        poses[:, :3, 3] = data[:, 1:4]
    return data[:, 0], poses
