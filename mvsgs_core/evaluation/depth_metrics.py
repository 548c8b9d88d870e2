"""How good depth maps are: absolute relative error, fraction of inliers, completeness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

INLIER = 0.05  # relative error below which a depth counts as right


@dataclass(frozen=True)
class DepthScore:
    """Sums over pixels, so that scores of several maps add up."""

    relative_error: float
    inliers: int
    estimated: int  # pixels with both an estimate and a true depth
    known: int  # pixels with a true depth

    def __add__(self, other: DepthScore) -> DepthScore:
        return DepthScore(
            self.relative_error + other.relative_error,
            self.inliers + other.inliers,
            self.estimated + other.estimated,
            self.known + other.known,
        )

    def abs_rel(self) -> float | None:
        """Mean relative error; None where nothing was estimated."""
        return self.relative_error / self.estimated if self.estimated else None

    def inlier_ratio(self) -> float | None:
        return self.inliers / self.estimated if self.estimated else None

    def completeness(self) -> float | None:
        return self.estimated / self.known if self.known else None


NO_DEPTH = DepthScore(0.0, 0, 0, 0)


def depth_ratios(depth: np.ndarray, truth: np.ndarray, every: int = 7) -> np.ndarray:
    """(N,) ratios of true to estimated depth, of every 7th pixel that has both; see `score_depth`."""
    truth = _at_pixels_of(depth, truth)
    both = (np.isfinite(truth) & (truth > 0) & np.isfinite(depth) & (depth > 0)).ravel()
    return np.asarray((truth.ravel()[both] / depth.ravel()[both])[::every], dtype=np.float64)


def score_depth(depth: np.ndarray, truth: np.ndarray, scale: float, inlier: float = INLIER) -> DepthScore:
    """Scores depth (h, w), times `scale`, against true depth (H, W); 0 is unknown in both.

    The truth is read at the centers of the estimate's pixels (nearest): averaging would invent depths at edges.
    """
    truth = _at_pixels_of(depth, truth)
    known = np.isfinite(truth) & (truth > 0)
    both = known & np.isfinite(depth) & (depth > 0)
    error = np.abs(depth[both].astype(np.float64) * scale - truth[both]) / truth[both]
    return DepthScore(float(error.sum()), int((error < inlier).sum()), int(both.sum()), int(known.sum()))


def _at_pixels_of(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    height, width = depth.shape
    return np.asarray(cv2.resize(truth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))
