"""Frames since the last keyframe, posed from both sides once the next one is solved.

A frame is followed with the depths that its reference has then, of two or three views, and by its matches alone. The
keyframe after it gives the reference better depths and brings matches of its own, whose errors are others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import AGREEMENT, FrameRecord, followed_pose
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.localization import localize_by

WAITING = 64  # images, at most; beyond, the one whose neighbors in time are closest is let go


class BothSides:
    def __init__(self, graph: KeyframeGraph, matcher: Matcher, threads: int) -> None:
        self.graph, self.matcher = graph, matcher
        self.solver = Solver(steps=8, threads=threads)
        self._waiting: dict[int, tuple[TrackingImage, FrameRecord]] = {}

    def add(self, frame: TrackingImage, record: FrameRecord) -> None:
        """A frame that became no keyframe."""
        self._waiting[frame.index] = (frame.bare(), record)
        if len(self._waiting) > WAITING:
            order = list(self._waiting)
            del self._waiting[order[min(range(1, WAITING), key=lambda k: order[k + 1] - order[k - 1])]]

    def forget(self) -> None:
        """No keyframe comes that they could be seen from."""
        self._waiting = {}

    def settle(self, keyframes: Sequence[int]) -> list[Callable[[], bool]]:
        """What poses the frames that wait, now that the graph has these keyframes, in order: each says if it could."""
        waiting = {index: frame for index, frame in self._waiting.items() if index < keyframes[-1]}
        self._waiting = {index: frame for index, frame in self._waiting.items() if index > keyframes[-1]}
        return [
            partial(self._pose, image, record, next(k for k in keyframes if k > index))
            for index, (image, record) in waiting.items()
            if index not in self.graph.keyframes
        ]

    def _pose(self, image: TrackingImage, record: FrameRecord, after: int) -> bool:
        """Whether matches with its reference and the keyframe after it agree on a pose; else it has the one it had."""
        start, graph = followed_pose(record, self.graph, self.solver), self.graph
        if start is None or record.reference in (None, after):
            return False
        assert record.reference is not None
        if graph.keyframes[record.reference].segment != graph.keyframes[after].segment:
            return False
        pose = geometry.inverse(start)
        matches = {index: self._match(index, image, pose) for index in (record.reference, after)}
        found = localize_by(graph, matches, pose, self.solver)
        if found.failure or found.inliers < AGREEMENT:
            return False
        record.follow_both(graph, matches[record.reference], after, matches[after], found.cam_from_world)
        return True

    def _match(self, index: int, image: TrackingImage, pose: np.ndarray) -> Matches:
        """A keyframe's points, looked for where a camera at this pose (4, 4) should see them."""
        guess, _ = self.graph.predict_pose(index, pose)
        guess = self.graph.as_read(guess, image)
        matches, _ = self.matcher.match(self.graph.keyframes[index].image, image, guess, 0.0)
        return matches


__all__ = ["BothSides"]
