"""Depth where the filters left none: doubtful, or, where the map shows nothing, continued from what surrounds it.

What a filter rejects is doubtful, not unknown: a rough surface there, which the optimization and density control can
move, split or fade out, is worth more than a hole. Neither can make a splat where there is none. Where matching says
nothing at all, as in the strip that only the newest keyframe sees, what surrounds it goes on.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core.membrane import membrane

MIN_CONFIDENCE = 0.07  # a depth below is worse than what surrounds it, continued
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
