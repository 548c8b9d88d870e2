"""Sparse points where filtered depth is missing and the map shows nothing: one for each cell of the image.

What a filter rejects is doubtful, not unknown: a rough surface there, which the optimization and density control can
move, split or fade out, is worth more than a hole. Neither can make a splat where there is none. Where matching says
nothing at all, as in the strip that only the newest keyframe sees, what surrounds it goes on.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core import camera
from mvsgs_core.mapping.insertion import Points
from mvsgs_core.membrane import membrane

MIN_CONFIDENCE = 0.15  # a depth below is worse than what surrounds it, continued
STIFFNESS, EDGE = 200.0, 5.0  # of what is continued, see membrane: in gray levels


def continued_depth(depth: np.ndarray, confidence: np.ndarray, shown: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Depth (h, w) float32 with a value at every pixel: where matching says nothing, what surrounds it goes on.

    depth (h, w), 0 where unknown, with its confidence (h, w); shown: (h, w) depth that the map shows there, 0 where it
    shows nothing; image (h, w, 3) in [0, 1], at whose edges the surface may break. In inverse depth, where a plane
    stays a plane. Doubtful depth is left as it is where nothing better is in the whole image; all 0 where none is.
    """
    sure = np.where((depth > 0) & (confidence >= MIN_CONFIDENCE), confidence.astype(np.float32) ** 2, np.float32(0))
    known = np.where(sure > 0, depth, shown)
    weight = np.where(sure > 0, sure, np.where(shown > 0, np.float32(MIN_CONFIDENCE), np.float32(0)))
    if not weight.any():
        known, weight = depth, (depth > 0).astype(np.float32)
    inverse = np.where(known > 0, 1.0 / np.maximum(known, 1e-30), 0.0).astype(np.float32)
    sheet = membrane(inverse, weight, np.round(255.0 * image).astype(np.uint8), STIFFNESS, EDGE)
    continued = np.where(sheet > 0, 1.0 / np.maximum(sheet, 1e-30), 0.0)
    return np.where(weight > 0, known, continued).astype(np.float32)


def fill_points(
    depth: np.ndarray,
    confidence: np.ndarray,
    intrinsics: np.ndarray,
    image: np.ndarray,
    empty: np.ndarray,
    side: int,
) -> Points:
    """Camera-frame points, one for each cell of `side` x `side` pixels a quarter of which or more is empty.

    depth: (h, w), 0 where unknown, confidence (h, w), intrinsics (4,) at that size, image (h, w, 3) in [0, 1], empty
    (h, w) bool. A point is on the ray of its cell's center, at the depth of the most confident of the empty pixels (a
    mean would lie between two surfaces), has their mean color and stands for the whole cell; its normal is unknown.
    Of a cell that the border cuts, what is inside counts.
    """
    rows, columns = -(-depth.shape[0] // side), -(-depth.shape[1] // side)
    beyond = ((0, rows * side - depth.shape[0]), (0, columns * side - depth.shape[1]))

    def cells(values: np.ndarray) -> np.ndarray:
        """(rows, columns, side^2, ...) of (h, w, ...), 0 beyond the border."""
        whole = np.pad(values, (*beyond, *[(0, 0)] * (values.ndim - 2)))
        split = whole.reshape(rows, side, columns, side, *values.shape[2:]).swapaxes(1, 2)
        return split.reshape(rows, columns, side * side, *values.shape[2:])

    holes = cells(empty)
    known = holes & (cells(depth) > 0)
    best = np.argmax(np.where(known, cells(confidence), -np.inf), axis=-1)
    pixels = cells(np.ones(depth.shape, dtype=bool)).sum(axis=-1)
    chosen = known.any(axis=-1) & (4 * holes.sum(axis=-1) >= pixels)
    z = np.take_along_axis(cells(depth), best[..., None], axis=-1)[..., 0]
    colors = np.sum(cells(image) * holes[..., None], axis=2) / np.maximum(holes.sum(axis=-1), 1)[..., None]
    at_cells = camera.scale_intrinsics(intrinsics, (rows * side, columns * side), (rows, columns))
    positions = camera.unproject(z, at_cells)[chosen].astype(np.float64)
    spacing = positions[:, 2] / float(np.sqrt(at_cells[0] * at_cells[1]))
    return Points(positions, np.zeros_like(positions), colors[chosen].astype(np.float64), spacing)
