"""What the outside was published of each keyframe, so that only what changed is published again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mvsgs_core.trajectory import TrackingState


class Tracked(Protocol):
    """A keyframe as far as it is published."""

    @property
    def inverse_depth(self) -> np.ndarray: ...

    @property
    def triangulated(self) -> np.ndarray: ...  # bool, of the shape of inverse_depth

    @property
    def median_depth(self) -> float: ...


class Keyframes(Protocol):
    """What tells of keyframes by their index: a tracker's graph, or DROID-SLAM's video."""

    @property
    def keyframes(self) -> Mapping[int, Tracked]: ...

    def world_from_cam(self, index: int) -> np.ndarray: ...


@dataclass(frozen=True)
class Correction:
    """Keyframe poses as they are now, absolute."""

    index: np.ndarray  # (K,) int64
    world_from_cam: np.ndarray  # (K, 4, 4) float64
    scale: np.ndarray  # (K,) float64: depths now over depths when the keyframe was first published
    segment: np.ndarray | None = None  # (K,) int32 part of the map that it belongs to now; None: there is only one


@dataclass(frozen=True)
class Update:
    """What one frame changed."""

    state: TrackingState
    keyframes: tuple[int, ...] = ()  # indices of frames that became keyframes, in order
    correction: Correction | None = None  # of keyframes published before


@dataclass
class _Published:
    world_from_cam: np.ndarray
    scale: float
    inverse_depth: np.ndarray  # when first published
    known: np.ndarray
    segment: int


class Publisher:
    """tolerance: of the median depth (positions), radians (rotations) and fraction (scales) that counts as a change.

    segment_of: the part of the map that a keyframe belongs to; None where the tracker has only one.
    """

    def __init__(self, graph: Keyframes, tolerance: float, segment_of: Callable[[int], int] | None = None) -> None:
        self.graph = graph
        self.tolerance = tolerance
        self.segment_of = segment_of
        self.held: list[int] = []  # keyframes that are not published yet
        self.highest_segment = 0  # that was ever published: a number is not given twice
        self._published: dict[int, _Published] = {}

    def publish(self, index: int) -> None:
        """A keyframe was sent as it is now, with scale 1."""
        keyframe = self.graph.keyframes[index]
        self._published[index] = _Published(
            self.graph.world_from_cam(index), 1.0, keyframe.inverse_depth.copy(), keyframe.triangulated.copy(),
            self._segment(index),
        )  # fmt: skip
        self.highest_segment = max(self.highest_segment, self._segment(index))

    @property
    def published(self) -> set[int]:
        return set(self._published)

    def publish_all(self, indices: list[int], settled: bool) -> tuple[int, ...]:
        """Keyframes that may go out now: these, and those held back before; none until the focal length is settled."""
        self.held += indices
        if not settled:
            return ()
        out, self.held = tuple(self.held), []
        for index in out:
            self.publish(index)
        return out

    def corrections(self, everything: bool = False) -> Correction | None:
        """Keyframes that moved noticeably, or joined another segment, since they were last published; else None."""
        moved = []
        for index, published in self._published.items():
            if index not in self.graph.keyframes:
                continue
            pose, scale = self.graph.world_from_cam(index), self._scale(index, published)
            shift = (
                np.linalg.norm(pose[:3, 3] - published.world_from_cam[:3, 3]) / self.graph.keyframes[index].median_depth
            )
            turn = np.linalg.norm(pose[:3, :3] - published.world_from_cam[:3, :3]) / np.sqrt(2.0)
            moves = max(shift, turn, abs(np.log(scale / published.scale))) > self.tolerance
            if everything or moves or published.segment != self._segment(index):
                moved.append((index, pose, scale))
        if not moved:
            return None
        for index, pose, scale in moved:
            self._published[index].world_from_cam, self._published[index].scale = pose, scale
            self._published[index].segment = self._segment(index)
        return Correction(
            np.array([m[0] for m in moved], np.int64),
            np.stack([m[1] for m in moved]),
            np.array([m[2] for m in moved], np.float64),
            None if self.segment_of is None else np.array([self._segment(m[0]) for m in moved], np.int32),
        )

    def _segment(self, index: int) -> int:
        return 0 if self.segment_of is None else self.segment_of(index)

    def _scale(self, index: int, published: _Published) -> float:
        keyframe = self.graph.keyframes[index]
        known = keyframe.triangulated & published.known
        if known.sum() < 20:
            return published.scale
        return float(np.median(published.inverse_depth[known] / keyframe.inverse_depth[known]))


__all__ = ["Correction", "Keyframes", "Publisher", "Tracked", "Update"]
