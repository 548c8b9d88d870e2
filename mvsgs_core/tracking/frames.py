"""Every frame that was seen: what it was matched with, so that its pose can follow the keyframes' corrections."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.bundle_adjustment import Solver
from mvsgs_core.tracking.flow import Matches
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.localization import localize


class State(IntEnum):
    """What is known of a frame's pose; the same values as msgs.TrackingState."""

    TRACKED = 0
    LOST = 1
    NOT_STARTED = 2
    DEGENERATE = 3


@dataclass
class FrameRecord:
    """A frame's state and its matches with one keyframe."""

    index: int
    timestamp: float  # seconds
    state: State
    reference: int | None = None  # keyframe
    matches: Matches | None = None  # of the reference's points; None: it stands where the frame `same_as` stands
    same_as: int | None = None  # frame that this one did not move against
    cam_from_reference: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4)


@dataclass(frozen=True)
class Path:
    """All frames, N, in order."""

    index: np.ndarray  # (N,) int64
    timestamp: np.ndarray  # (N,) float64 seconds
    world_from_cam: np.ndarray  # (N, 4, 4) float64, NaN where there is no pose
    keyframe: np.ndarray  # (N,) bool
    state: np.ndarray  # (N,) uint8
    segment: np.ndarray  # (N,) int32


def compact(matches: Matches) -> Matches:
    """The same in a third of the memory: kept for every frame."""
    shift = None if matches.shift is None else matches.shift.astype(np.float16)
    return Matches(matches.target.astype(np.float32), matches.weight.astype(np.float16), shift)


def solve_path(records: list[FrameRecord], graph: KeyframeGraph, solver: Solver) -> Path:
    """Final poses: a keyframe's own, else motion-only bundle adjustment against the reference as it is now."""
    n = len(records)
    poses = np.full((n, 4, 4), np.nan)
    keyframe, segment = np.zeros(n, bool), np.full(n, -1, np.int32)
    state = np.array([r.state for r in records], np.uint8).reshape(n)
    place = {r.index: k for k, r in enumerate(records)}
    for k, record in enumerate(records):
        own = graph.keyframes.get(record.index)
        if own is not None:
            poses[k], keyframe[k], segment[k] = graph.world_from_cam(record.index), True, own.segment
            if state[k] in (State.LOST, State.NOT_STARTED):
                state[k] = State.TRACKED
            continue
        if record.same_as is not None:
            other = place[record.same_as]
            poses[k], segment[k], state[k] = poses[other], segment[other], state[other]
            continue
        if record.reference not in graph.keyframes or record.matches is None or record.state == State.LOST:
            continue
        assert record.reference is not None
        start = record.cam_from_reference @ graph.keyframes[record.reference].cam_from_world
        found = localize(graph, {record.reference: record.matches}, start, solver)
        if found.failure or found.inliers < 0.4:
            state[k] = State.LOST
            continue
        poses[k] = geometry.inverse(found.cam_from_world)
        segment[k] = graph.keyframes[record.reference].segment
        if state[k] == State.NOT_STARTED:
            state[k] = State.TRACKED
    return Path(
        index=np.array([r.index for r in records], np.int64).reshape(n),
        timestamp=np.array([r.timestamp for r in records], np.float64).reshape(n),
        world_from_cam=poses,
        keyframe=keyframe,
        state=state,
        segment=segment,
    )


__all__ = ["FrameRecord", "Path", "State", "compact", "solve_path"]
