"""Sparse points where filtered depth is missing and the map shows nothing: one for each cell of the image.

What a filter rejects is doubtful, not unknown: a rough surface there, which the optimization and density control can
move, split or fade out, is worth more than a hole. Neither can make a splat where there is none.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core import camera
from mvsgs_core.splats.insertion import Points


def fill_points(
    depth: np.ndarray,
    confidence: np.ndarray,
    intrinsics: np.ndarray,
    image: np.ndarray,
    empty: np.ndarray,
    side: int,
) -> Points:
    """Camera-frame points, one for each cell of `side` x `side` pixels that is empty by half or more.

    depth: (h, w), 0 where unknown, confidence (h, w), intrinsics (4,) at that size, image (h, w, 3) in [0, 1], empty
    (h, w) bool. A point is on the ray of its cell's center, at the depth of the most confident of the empty pixels (a
    mean would lie between two surfaces), has their mean color and stands for the whole cell; its normal is unknown.
    Cells that the border cuts are left out.
    """
    rows, columns = depth.shape[0] // side, depth.shape[1] // side

    def cells(values: np.ndarray) -> np.ndarray:
        """(rows, columns, side^2, ...) of (h, w, ...)."""
        cut = values[: rows * side, : columns * side]
        split = cut.reshape(rows, side, columns, side, *values.shape[2:]).swapaxes(1, 2)
        return split.reshape(rows, columns, side * side, *values.shape[2:])

    holes = cells(empty)
    known = holes & (cells(depth) > 0)
    best = np.argmax(np.where(known, cells(confidence), -np.inf), axis=-1)
    chosen = known.any(axis=-1) & (2 * holes.sum(axis=-1) >= side * side)
    z = np.take_along_axis(cells(depth), best[..., None], axis=-1)[..., 0]
    colors = np.sum(cells(image) * holes[..., None], axis=2) / np.maximum(holes.sum(axis=-1), 1)[..., None]
    at_cells = camera.scale_intrinsics(intrinsics, (rows * side, columns * side), (rows, columns))
    positions = camera.unproject(z, at_cells)[chosen].astype(np.float64)
    spacing = positions[:, 2] / float(np.sqrt(at_cells[0] * at_cells[1]))
    return Points(positions, np.zeros_like(positions), colors[chosen].astype(np.float64), spacing)
