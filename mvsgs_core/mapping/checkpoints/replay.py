"""A run that goes on replays its stream from the beginning: what is in the map already is passed over, and compared."""

from __future__ import annotations

import numpy as np

from mvsgs_core.mapping.atlas import Atlas

TOLERANCE = 0.02  # of the median depth, radians and of scale, by which replayed poses may differ from the map's


class Replay:
    """Says of each message whether it is new, and whether the tracker found the way that the map was made with.

    A tracker that is deterministic gives the same poses to the bit. One that is not may have another scale or frame of
    reference: what comes then does not fit the map, and nothing of it is taken.
    """

    def __init__(self, atlas: Atlas) -> None:
        """atlas: as it was loaded."""
        self._atlas = atlas
        self._newest, self._revision = atlas.newest_view, atlas.revision
        self._found: dict[int, tuple[np.ndarray, float]] = {}  # replayed pose and scale of each keyframe
        self._decided = False
        self.problem = ""  # why nothing of the stream is taken

    def view(self, index: int, world_from_cam: np.ndarray, scale: float) -> bool:
        """Whether this keyframe is to be mapped."""
        if index <= self._newest:
            self._found[index] = (world_from_cam, scale)
            return False
        return self._fits()

    def poses(self, revision: int, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray) -> bool:
        """Whether these corrections (K,), (K, 4, 4), (K,) are to be taken."""
        if revision <= self._revision:
            self._found |= {int(k): (pose, float(s)) for k, pose, s in zip(index, world_from_cam, scale)}
            return False
        return self._fits()

    def _fits(self) -> bool:
        """Decided once, when the first message comes that is new: all before it have been replayed then."""
        if not self._decided:
            self._decided, self.problem = True, self._disagreement()
            self._found.clear()
        return not self.problem

    def _disagreement(self) -> str:
        if self._newest < 0:
            return ""  # nothing of the stream was in the map yet
        compared = 0
        for part in self._atlas.parts.values():
            length = part.median_depth * part.frame.length
            for view in part.views:
                if view.index not in self._found:
                    continue
                pose, scale = self._found[view.index]
                compared += 1
                off = float(np.linalg.norm(pose[:3, 3] - view.world_from_cam[:3, 3])) / length
                turned = float(np.linalg.norm(pose[:3, :3] - view.world_from_cam[:3, :3])) / np.sqrt(2.0)
                if not max(off, turned, abs(scale / view.scale - 1.0)) < TOLERANCE:
                    return (
                        f"the stream does not fit the map that is gone on with: keyframe {view.index} is {off:.3g} "
                        f"median depths and {np.degrees(turned):.3g} degrees from where it was; the map is refined as "
                        "it is (dataset=resumed scores it alone)"
                    )
        if not compared:
            return (
                f"the stream does not fit the map that is gone on with: none of its keyframes came up to frame "
                f"{self._newest}; the map is refined as it is (dataset=resumed scores it alone)"
            )
        return ""
