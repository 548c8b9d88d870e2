"""Positions that are aligned with the true ones by a similarity, and what is left between them."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.evaluation.trajectory_metrics import rmse


def distances(found: np.ndarray, wanted: np.ndarray, by: slice | np.ndarray = slice(None)) -> np.ndarray:
    """(N,) of positions (N, 3) after the Sim(3) alignment of those that `by` chooses, at least 3."""
    aligned = geometry.umeyama(found[by], wanted[by]).apply(found)
    return np.asarray(np.linalg.norm(aligned - wanted, axis=1))


def aligned_error(found: np.ndarray, wanted: np.ndarray) -> float:
    """RMS distance of positions (N, 3) after Sim(3) alignment, in the unit of the wanted ones."""
    return rmse(distances(found, wanted))
