"""Trajectory metrics after similarity alignment (Sturm et al. 2012; Umeyama 1991)."""

from __future__ import annotations

from dataclasses import dataclass

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
