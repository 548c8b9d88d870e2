"""Every frame that was seen: what it was matched with, so that its pose can follow the keyframes' corrections."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.photometer import observed
from mvsgs_core.tracking.places.localization import confirmed, localize_by
from mvsgs_core.tracking.sample import restored, sample
from mvsgs_core.trajectory import TrackingState, Trajectory

AGREEMENT = 0.7  # of a frame's points, all of which agreed once: fewer after the map's corrections, and it is lost


@dataclass(slots=True)
class FrameRecord:
    """A frame's state and where it was seen from one keyframe, or two; 1.6 kilobytes at most, kept for every frame."""

    index: int
    timestamp: float  # seconds
    state: TrackingState
    reference: int | None = None  # keyframe that the frame's pose was found against; None: no pose, or as `same_as`
    points: bytes = b""  # of its matches, see sample.py
    cam_from_reference: bytes = b""  # (3, 4) float64: where the search for the pose begins
    after: int | None = None  # keyframe after the frame that it was matched with, too
    points_after: bytes = b""
    same_as: int | None = None  # frame that this one did not move against
    found_percent: int = 0  # of the reference's points that the pose shows, those that were found there
    light: bytes = b""  # what its gray levels say of its exposure, see photometer.py

    def follow(
        self,
        graph: KeyframeGraph,
        reference: int,
        matches: Matches,
        cam_from_world: np.ndarray,
        image: TrackingImage,
    ) -> None:
        """Keeps what gives the frame's pose (4, 4) and exposure again, from its matches of a keyframe's points."""
        self.light = observed(graph, reference, image, matches)
        self.reference, self.same_as = reference, None
        self.after, self.points_after = None, b""
        self.found_percent = round(100 * confirmed(graph, reference, matches, cam_from_world))  # a small int is shared
        self._stand(graph, matches, cam_from_world)

    def follow_both(
        self, graph: KeyframeGraph, matches: Matches, after: int, matches_after: Matches, cam_from_world: np.ndarray
    ) -> None:
        """The same, with matches of another keyframe's points beside those of the reference."""
        self._stand(graph, matches, cam_from_world)
        self.after, self.points_after = after, sample(graph, after, matches_after, cam_from_world)

    def forget(self) -> None:
        """The frame has no pose."""
        self.reference, self.same_as, self.points, self.cam_from_reference, self.light = None, None, b"", b"", b""
        self.after, self.points_after = None, b""

    def _stand(self, graph: KeyframeGraph, matches: Matches, cam_from_world: np.ndarray) -> None:
        assert self.reference is not None
        self.points = sample(graph, self.reference, matches, cam_from_world)
        relative = cam_from_world @ graph.world_from_cam(self.reference)
        self.cam_from_reference = relative[:3].tobytes()


def followed_pose(record: FrameRecord, graph: KeyframeGraph, solver: Solver) -> np.ndarray | None:
    """A frame's pose (4, 4) world_from_cam from its matches, against its keyframes as they are now.

    None where there is no reference, or too few of the matches agree with it any more.
    """
    if record.reference is None or record.reference not in graph.keyframes:
        return None
    reference = graph.keyframes[record.reference]
    relative = _relative(record)
    matches = {record.reference: restored(record.points, reference)}
    if record.after is not None and record.after in graph.keyframes:
        matches[record.after] = restored(record.points_after, graph.keyframes[record.after])
    found = localize_by(graph, matches, relative @ reference.cam_from_world, solver)
    return None if found.failure or found.inliers < AGREEMENT else geometry.inverse(found.cam_from_world)


def _relative(record: FrameRecord) -> np.ndarray:
    return np.vstack([np.frombuffer(record.cam_from_reference).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def place_of(records: list[FrameRecord], index: int) -> int:
    """Of a frame's record, or of the next one's: they are in the order of their indices, and may be those of hours."""
    return bisect_left(records, index, key=lambda record: record.index)


def record_of(records: list[FrameRecord], index: int) -> FrameRecord:
    """Of a frame that was seen."""
    return records[place_of(records, index)]


def seen_pose(records: list[FrameRecord], k: int, graph: KeyframeGraph) -> tuple[np.ndarray, int] | None:
    """Pose (4, 4) world_from_cam of a frame as it was followed, on its keyframe as that is now, and its segment.

    `followed_pose` solves it anew and is exact. None where the frame has none (yet).
    """
    record = records[k]
    if record.same_as is not None:
        record = record_of(records, record.same_as)
    own = graph.keyframes.get(record.index)
    if own is not None:
        return graph.world_from_cam(record.index), own.segment
    if record.reference is None or record.reference not in graph.keyframes:
        return None
    relative = _relative(record)
    segment = graph.keyframes[record.reference].segment
    return graph.world_from_cam(record.reference) @ geometry.inverse(relative), segment


def solve_trajectory(records: list[FrameRecord], graph: KeyframeGraph, solver: Solver) -> Trajectory:
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
            if state[k] in (TrackingState.LOST, TrackingState.NOT_INITIALIZED):
                state[k] = TrackingState.TRACKED
            continue
        if record.same_as is not None:
            other = place[record.same_as]
            poses[k], segment[k], state[k] = poses[other], segment[other], state[other]
            continue
        if record.reference is None or record.reference not in graph.keyframes:
            if state[k] != TrackingState.NOT_INITIALIZED:
                state[k] = TrackingState.LOST
            continue
        pose = followed_pose(record, graph, solver)
        if pose is None:
            state[k] = TrackingState.LOST
            continue
        poses[k], segment[k] = pose, graph.keyframes[record.reference].segment
        if state[k] != TrackingState.DEGENERATE:
            state[k] = TrackingState.TRACKED
    return Trajectory(
        index=np.array([r.index for r in records], np.int64).reshape(n),
        timestamp=np.array([r.timestamp for r in records], np.float64).reshape(n),
        world_from_cam=poses,
        keyframe=keyframe,
        state=state,
        segment=segment,
    )


__all__ = ["FrameRecord", "followed_pose", "place_of", "record_of", "seen_pose", "solve_trajectory"]
