"""The focal length of unknown photographs from their fundamental matrices alone.

With the right focal length K' F K is an essential matrix, whose two singular values are equal: the factor on the guess
is that where they differ least (Mendonca and Cipolla 1999), over all pairs.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core.camera import matrix

RANGE = (0.4, 3.0)  # of the guess
BY_HOMOGRAPHY = 0.7  # of the matches: a pair that a plane explains so well tells no focal length
MIN_PAIRS = 10
AGREES = 0.03  # difference of the singular values over their sum: pairs that differ by more have no vote


def focal_factor(
    fundamentals: list[np.ndarray], intrinsics: list[tuple[np.ndarray, np.ndarray]], weights: list[float]
) -> float | None:
    """The factor on the focal lengths of all photographs; None where the pairs do not tell it.

    They do not where there are fewer than `MIN_PAIRS`, or the cost has no minimum within the range: the cameras then
    turn about parallel axes, or look at one point from one distance, for which any focal length will do (Sturm 1997).

    fundamentals: (3, 3) on pixels, of pairs that no homography explains. intrinsics: (4,) of both, as guessed.
    """
    if len(fundamentals) < MIN_PAIRS:
        return None
    factors = np.geomspace(*RANGE, 81)
    scale = np.stack([factors, factors, np.ones_like(factors)], axis=1)  # diagonal of what multiplies K
    cost = np.zeros(len(factors))
    for fundamental, (first, second), weight in zip(fundamentals, intrinsics, weights):
        middle = matrix(second).T @ fundamental @ matrix(first)
        singular = np.linalg.svd(scale[:, :, None] * middle * scale[:, None, :], compute_uv=False)
        cost += weight * np.minimum((singular[:, 0] - singular[:, 1]) / (singular[:, 0] + singular[:, 1]), AGREES)
    best = int(np.argmin(cost))
    return float(factors[best]) if 0 < best < len(factors) - 1 else None


__all__ = ["BY_HOMOGRAPHY", "focal_factor"]
