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


class Background:
    """Of keyframes, each of which is looked at once, and where its exposure changes: a long run has many."""

    def __init__(self, views: Sequence[TrainingView] = ()) -> None:
        self._rows: dict[int, int] = {}  # by keyframe
        self._colors = np.zeros((0, 3))  # doubled when it is full
        self.take(views)

    def take(self, views: Sequence[TrainingView]) -> None:
        """Keyframes that come after all others, or have another exposure now."""
        known = [view for view in views if view.mean_color.any()]
        if not known:
            return
        colors = np.stack([view.mean_color for view in known])
        exposures = np.stack([IDENTITY if view.measured is None else view.measured for view in known])
        exposures = exposures.astype(np.float64)
        found = np.linalg.solve(exposures[:, :, :3], (colors - exposures[:, :, 3])[..., None])[..., 0]
        rows = [self._rows.setdefault(view.index, len(self._rows)) for view in known]
        if len(self._rows) > len(self._colors):
            self._colors = np.resize(self._colors, (2 * len(self._rows), 3))
        self._colors[rows] = np.clip(found, 0.0, BRIGHTEST)

    @property
    def color(self) -> np.ndarray | None:
        """(3,) float32 in the map's colors, each keyframe's exposure undone; None where no keyframe's color is
        known."""
        known = self._colors[: len(self._rows)]
        return known.mean(axis=0).astype(np.float32) if len(known) else None
