"""Frames between keyframes that the map is trained on, too: posed against the map once it knows the next keyframe.

A frame is followed with the depths that its reference has then, of two or three views; the keyframe after it gives
better ones. So the frames wait for that keyframe. Held-out frames never go out.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Set
from dataclasses import dataclass
from functools import partial

import numpy as np

from mvsgs_core.held_out import is_held_out
from mvsgs_core.photometry import compose, inverse
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import FrameRecord, place_of, solve_trajectory
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.photometer import Photometer, Seen

HELD = 2  # frames between two keyframes, in the mean, where these wait to go out: up to 30 do, and all images with them


@dataclass(frozen=True)
class Between:
    """A frame and where it was seen from a keyframe."""

    index: int
    keyframe: int
    keyframe_from_cam: np.ndarray  # (4, 4) float64, in the unit of the graph as it is
    exposure: np.ndarray | None  # (3, 4) float32 from the keyframe's colors to its own; None: no difference is known
    velocity: np.ndarray | None  # (6,) of the camera, a twist a second, in the same unit; None: no neighbor tells it


class FramesBetween:
    """Keeps at most `limit` frames between two keyframes, spread evenly over the time, until the map has the second."""

    def __init__(self, graph: KeyframeGraph, photometer: Photometer, limit: int, threads: int) -> None:
        self.graph, self.photometer, self.limit = graph, photometer, limit
        self.solver = Solver(steps=8, threads=threads)
        self._held: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # of keyframes that are solved and held
        self._complete: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # of keyframes that are not solved yet
        self._newest: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # since the last keyframe
        self._ended: dict[int, tuple[TrackingImage, FrameRecord]] = {}  # those of `_complete` that came last

    @property
    def waiting(self) -> set[int]:
        """Frames whose images are needed until the next keyframe."""
        return set(self._held) | set(self._complete) | set(self._newest)

    def add(self, frame: TrackingImage, record: FrameRecord) -> None:
        """A frame that was followed and became no keyframe; its pose may still come, by `record`."""
        if self.limit == 0 or is_held_out(frame.index):
            return
        self._newest[frame.index] = (frame.bare(), record)
        while len(self._newest) > self.limit:  # by more than one where it was reopened
            del self._newest[spared({index: image for index, (image, _) in self._newest.items()})]

    def end(self) -> None:
        """A keyframe, which is still to be solved: others follow."""
        self._complete |= self._newest
        self._ended, self._newest = self._newest, {}

    def forget(self) -> None:
        """The keyframes that they are between are given up, those that are solved not."""
        self._complete, self._newest, self._ended = {}, {}, {}

    def forget_before(self, keyframe: int) -> None:
        """The keyframes before this one are given up."""
        self._complete = {index: frame for index, frame in self._complete.items() if index > keyframe}

    def reopen(self) -> None:
        """What was to be a keyframe is none: the frames wait for the next one."""
        self._complete = {index: frame for index, frame in self._complete.items() if index not in self._ended}
        self._newest, self._ended = self._ended | self._newest, {}

    def hold(self, keyframes: int) -> None:
        """The keyframes that the frames were to `end` at are solved and wait themselves: so many, and few frames do."""
        self._held |= self._complete
        self._complete, self._ended = {}, {}
        while len(self._held) > HELD * keyframes:
            del self._held[spared({index: image for index, (image, _) in self._held.items()})]

    def close(self) -> frozenset[int]:
        """The keyframes that the frames were to `end` at go out: what waited for them is to be settled."""
        closed = frozenset(self._held | self._complete)
        self._held, self._complete, self._ended = {}, {}, {}
        return closed

    def settle(
        self, waiting: frozenset[int], keyframes: Iterable[int], records: list[FrameRecord], published: Container[int]
    ) -> tuple[Between, ...]:
        """Frames that waited, posed now that the graph has these keyframes.

        Those of their segments that their matches fit, from published keyframes. records: of all frames so far; what
        comes before and after a frame tells its velocity.
        """
        segments = list({self.graph.keyframes[index].segment for index in keyframes})
        around = _with_neighbors(records, waiting)
        track, found = solve_trajectory(around, self.graph, self.solver), []
        velocities = track.velocities_of(track.index)
        for k in np.flatnonzero(track.posed & np.isin(track.segment, segments) & ~track.keyframe):
            record = around[k]
            if record.index not in waiting or record.reference is None or record.reference not in published:
                continue
            reference = self.graph.keyframes[record.reference]
            pose = reference.cam_from_world @ track.world_from_cam[k]
            exposure = exposure_from(self.photometer, record, reference.index)
            velocity = velocities[k] if np.isfinite(velocities[k]).all() else None
            found.append(Between(record.index, reference.index, pose, exposure, velocity))
        return tuple(found)


def exposure_from(photometer: Photometer, frame: Seen, keyframe: int) -> np.ndarray | None:
    """(3, 4) float32 of a frame, from the colors of a keyframe; None: no difference is known."""
    own, there = photometer.of_frames([frame], np.ones(1, bool)), photometer.exposure(keyframe)
    if own is None or there is None or not np.isfinite(own).all():
        return None
    return compose(own[0], inverse(there)).astype(np.float32)


def spared(frames: Mapping[int, TrackingImage]) -> int:
    """Of the two frames that are closest in time, the one with less detail: motion blurs."""
    order = sorted(frames)
    first = min(range(len(order) - 1), key=lambda k: order[k + 1] - order[k])
    return min(order[first : first + 2], key=lambda index: _detail(frames[index].gray))


def _with_neighbors(records: list[FrameRecord], indices: Set[int]) -> list[FrameRecord]:
    """Of these frames, of those before and after them that show something else, and of what these did not move
    against."""
    place = partial(place_of, records)
    near = set()
    for n in map(place, indices):
        after = n + 1
        while after < len(records) and records[after].same_as == records[n].index:
            after += 1
        near |= {max(n - 1, 0), n, after - 1, min(after, len(records) - 1)}  # a rest may be long
    near |= {place(origin) for origin in (records[n].same_as for n in near) if origin is not None}
    return [records[n] for n in sorted(near)]


def _detail(gray: np.ndarray) -> float:
    """Mean squared gradient of an image (H, W) uint8."""
    down, across = (np.diff(gray.astype(np.float32), axis=axis) for axis in (0, 1))
    return float(np.mean(down**2) + np.mean(across**2))


__all__ = ["Between", "FramesBetween", "exposure_from", "spared"]
