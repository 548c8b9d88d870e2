"""Frames between keyframes that the map is trained on, too: posed against the map once it knows the next keyframe.

A frame is followed with the depths that its reference has then, of two or three views; the keyframe after it gives
better ones. So the frames wait for that keyframe. Held-out frames never go out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.held_out import is_held_out
from mvsgs_core.photometry import compose, inverse
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import FrameRecord, followed_pose
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.photometer import Photometer


@dataclass(frozen=True)
class Between:
    """A frame and where it was seen from a keyframe."""

    image: TrackingImage
    keyframe: int
    keyframe_from_cam: np.ndarray  # (4, 4) float64, in the unit of the graph as it is
    exposure: np.ndarray | None  # (3, 4) float32 from the keyframe's colors to its own; None: no difference is known

    @property
    def index(self) -> int:
        return self.image.index


class FramesBetween:
    """Keeps at most `limit` frames between two keyframes, spread evenly over the time, until the map has the second."""

    def __init__(self, graph: KeyframeGraph, photometer: Photometer, limit: int, threads: int) -> None:
        self.graph, self.photometer, self.limit = graph, photometer, limit
        self.solver = Solver(steps=8, threads=threads)
        self._complete: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # of keyframes that are not solved yet
        self._newest: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # since the last keyframe

    @property
    def waiting(self) -> set[int]:
        """Frames whose images are needed until the next keyframe."""
        return set(self._complete) | set(self._newest)

    def add(self, frame: TrackingImage, record: FrameRecord) -> None:
        """A frame that was followed and became no keyframe; its pose may still come, by `record`."""
        if self.limit == 0 or is_held_out(frame.index):
            return
        self._newest[frame.index] = (frame.bare(), record)
        if len(self._newest) > self.limit:
            del self._newest[self._spared()]

    def end(self) -> None:
        """A keyframe, which is still to be solved: others follow."""
        self._complete |= self._newest
        self._newest = {}

    def forget(self) -> None:
        """The keyframes that they are between are given up."""
        self._complete, self._newest = {}, {}

    def settle(self, keyframe: int) -> tuple[Between, ...]:
        """What waits, posed now that the graph has this keyframe: the frames of its segment that their matches fit."""
        segment = self.graph.keyframes[keyframe].segment
        found = []
        for image, record in [*self._complete.values(), *self._newest.values()]:
            reference = self.graph.keyframes.get(-1 if record.reference is None else record.reference)
            if reference is None or reference.segment != segment or image.index in self.graph.keyframes:
                continue
            pose = followed_pose(record, self.graph, self.solver)
            if pose is not None:
                found.append(
                    Between(image, reference.index, reference.cam_from_world @ pose, self._exposure(record, reference))
                )
        self.forget()
        return tuple(found)

    def _exposure(self, record: FrameRecord, reference: Keyframe) -> np.ndarray | None:
        """(3, 4) of a frame, from the colors of its reference."""
        own, there = self.photometer.of_frames([record], np.ones(1, bool)), self.photometer.exposure(reference.index)
        if own is None or there is None or not np.isfinite(own).all():
            return None
        return compose(own[0], inverse(there)).astype(np.float32)

    def _spared(self) -> int:
        """Of the two frames that are closest in time, the one with less detail: motion blurs."""
        order = sorted(self._newest)
        first = min(range(len(order) - 1), key=lambda k: order[k + 1] - order[k])
        return min(order[first : first + 2], key=lambda index: _detail(self._newest[index][0].gray))


def _detail(gray: np.ndarray) -> float:
    """Mean squared gradient of an image (H, W) uint8."""
    down, across = (np.diff(gray.astype(np.float32), axis=axis) for axis in (0, 1))
    return float(np.mean(down**2) + np.mean(across**2))


__all__ = ["Between", "FramesBetween"]
