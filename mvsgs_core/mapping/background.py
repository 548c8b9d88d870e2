"""What a map shows where it has no splat: the mean color of its keyframes, the same in all directions.

Behind black, splats that stand beside a hole are drawn over it, and a view between the keyframes shows black where they
are not; the sky has to be covered by splats that hang before it. Rendered over this color none of it pays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvsgs_core.mapping.exposure import BRIGHTEST
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.photometry import IDENTITY


def background_of(views: Sequence[TrainingView]) -> np.ndarray | None:
    """(3,) float32 in the map's colors, each keyframe's exposure undone; None where no keyframe's color is known."""
    known = [view for view in views if view.mean_color.any()]
    if not known:
        return None
    colors = np.stack([view.mean_color for view in known])
    exposures = np.stack([IDENTITY if view.measured is None else view.measured for view in known]).astype(np.float64)
    found = np.linalg.solve(exposures[:, :, :3], (colors - exposures[:, :, 3])[..., None])[..., 0]
    return np.clip(found, 0.0, BRIGHTEST).mean(axis=0).astype(np.float32)
