"""The tracker's points as a map: inverse depth on its grid, with a confidence for the depth range of stereo."""

from __future__ import annotations

import numpy as np

from mvsgs_core.tracking.graph import Keyframe
from mvsgs_core.tracking.image import CELL


def coarse_map(keyframe: Keyframe, relative_sigma: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and confidence, each (H / 8, W / 8) float32; 0 where nothing was triangulated.

    relative_sigma: error of the inverse depth (for one pixel of matching error) at which the confidence is a half.
    """
    rows, columns = (n // CELL for n in keyframe.image.size)
    variance = 1.0 / np.maximum(keyframe.information * keyframe.inverse_depth**2, 1e-12)
    confidence = np.where(keyframe.triangulated, 1.0 / (1.0 + variance / relative_sigma**2), 0.0)
    inverse_depth = np.where(keyframe.triangulated, keyframe.inverse_depth, 0.0)
    return (
        inverse_depth.reshape(rows, columns).astype(np.float32),
        confidence.reshape(rows, columns).astype(np.float32),
    )


__all__ = ["coarse_map"]
