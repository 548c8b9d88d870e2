"""When a pose is certain: a keyframe's triangulated points are found where it puts them, enough and widely spread.

The same is asked of a lost camera that was found again, of an old keyframe that closes a loop, and of frames that were
posed afterwards: a pose that only points of unknown depth speak for is none. But of a camera that only turned nothing
can be triangulated: a frame that a rotation alone explains, against such a keyframe, stands where that stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.setting_ranges import above, at_least, within
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import Localization, located


@dataclass(frozen=True)
class PoseCriteria:
    min_fraction: float = 0.12  # of the keyframe's textured points, found
    min_matches: int = 50  # with known depth
    min_inliers: float = 0.7  # fraction of these, within 2 pixels of the pose
    min_area: float = 0.1  # fraction of the image: hull of the inliers

    def __post_init__(self) -> None:
        at_least(self, min_matches=1)
        above(self, min_inliers=0)
        within(self, min_fraction=(0, 1), min_inliers=(0, 1), min_area=(0, 1))

    def accept(self, graph: KeyframeGraph, index: int, matches: Matches, found: Localization) -> bool:
        """Whether the matches of the points of keyframe `index` make the pose certain that was found from them."""
        keyframe = graph.keyframes[index]
        known = matches.alive & keyframe.triangulated
        turned = keyframe.triangulated.sum() < self.min_matches
        if turned:
            known = matches.alive
        fraction = matches.alive.sum() / max(1, keyframe.image.cells.textured.sum())
        if found.failure or fraction < self.min_fraction or known.sum() < self.min_matches:
            return False
        agree = known & located(graph, index, matches, found.cam_from_world, at_infinity=turned)
        if agree.sum() < self.min_inliers * known.sum():
            return False
        height, width = keyframe.image.size
        hull = cv2.convexHull(matches.target[agree].astype(np.float32))
        return bool(cv2.contourArea(hull) >= self.min_area * height * width)


__all__ = ["PoseCriteria"]
