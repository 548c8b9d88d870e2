"""A run's messages -> topics that Foxglove draws: images, poses, transforms, depth, points, the map.

Live topics are stamped with the time of the frame that they show and hold what was known when they were made. What is
only known at the end, the whole trajectory and the map, is stamped with the last of them.

Frames of reference: `map` and in it `camera`. Parts of a stream that share none are `map_1` and `camera_1`, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from msgs import Frame, FusedKeyframe, Keyframe, Message, Poses, SplatMap, TrackedFrame, Trajectory
from mvsgs_core import camera, geometry
from mvsgs_core.export import foxglove_messages as foxglove

READ = (Frame, Keyframe, TrackedFrame, FusedKeyframe, Poses, Trajectory, SplatMap)  # what there is something to see of


class Seen(NamedTuple):
    topic: str
    ns: int  # of the stream
    message: Any  # one of foxglove.messages


class _Placed(NamedTuple):
    """Where a keyframe is now."""

    world_from_cam: np.ndarray
    scale: float
    segment: int | None  # None: only its keyframe says it, which is still to come


class _Between(NamedTuple):
    """A TrackedFrame without its image."""

    ns: int
    keyframe: int
    keyframe_from_cam: np.ndarray
    scale: float


def nanoseconds(seconds: float) -> int:
    """As timestamps of recordings hold them."""
    return min(max(0, round(seconds * 1e9)), foxglove.LATEST)


class FoxgloveView:
    """Knows where the keyframes are now, as frames between them and the map need it.

    Keyframes, frames between them and corrections may come in any order.
    """

    def __init__(self) -> None:
        self._keyframes: dict[int, _Placed] = {}
        self._waiting: dict[int, list[_Between]] = {}  # by their keyframe, which is still to come
        self._end = 0  # ns, of the newest image
        self._newest = -1  # keyframe, which says the part that images are of

    def of(self, message: Message) -> Iterator[Seen]:
        """What is to be seen of a message; nothing of those that are not in READ."""
        match message:
            case Frame():
                ns = self._stamp(message.timestamp)
                yield Seen("/camera/image", ns, foxglove.jpeg(ns, _camera(self._segment), message.image))
            case Keyframe():
                yield from self._keyframe(message)
            case TrackedFrame():
                pose = message.keyframe_from_cam.copy()
                ns = self._stamp(message.timestamp)
                yield from self._between(_Between(ns, message.keyframe, pose, message.scale))
            case FusedKeyframe():
                yield from self._depth(message)
            case Poses():
                self._correct(message)
            case Trajectory():
                yield from self._path(message)
            case SplatMap(refined=True):
                yield self._map(message)

    @property
    def _segment(self) -> int:
        newest = self._keyframes.get(self._newest)
        return 0 if newest is None or newest.segment is None else newest.segment

    def _stamp(self, timestamp: float) -> int:
        ns = nanoseconds(timestamp)
        self._end = max(self._end, ns)
        return ns

    def _keyframe(self, message: Keyframe) -> Iterator[Seen]:
        ns, frame, size = self._stamp(message.timestamp), _camera(message.segment), message.image.shape[:2]
        sent = foxglove.jpeg_size(*size)
        intrinsics = camera.scale_intrinsics(message.intrinsics, size, sent)
        yield Seen("/camera/calibration", ns, foxglove.calibration(ns, frame, intrinsics, sent))
        yield from _posed(ns, message.segment, message.world_from_cam)
        placed = self._keyframes.get(message.index)  # by a correction that overtook it
        if placed is None:
            placed = _Placed(message.world_from_cam.copy(), message.scale, message.segment)
        elif placed.segment is None:
            placed = placed._replace(segment=message.segment)
        self._keyframes[message.index] = placed
        self._newest = max(self._newest, message.index)
        for between in self._waiting.pop(message.index, ()):
            yield from self._between(between)

    def _between(self, between: _Between) -> Iterator[Seen]:
        placed = self._keyframes.get(between.keyframe)
        if placed is None or placed.segment is None:
            self._waiting.setdefault(between.keyframe, []).append(between)
            return
        keyframe_from_cam = geometry.scaled(between.keyframe_from_cam, placed.scale / between.scale)
        yield from _posed(between.ns, placed.segment, placed.world_from_cam @ keyframe_from_cam)

    def _correct(self, poses: Poses) -> None:
        for i, index in enumerate(poses.index.tolist()):
            segment = None if poses.segment is None else int(poses.segment[i])
            if segment is None and index in self._keyframes:
                segment = self._keyframes[index].segment
            self._keyframes[index] = _Placed(poses.world_from_cam[i].copy(), float(poses.scale[i]), segment)

    def _depth(self, keyframe: FusedKeyframe) -> Iterator[Seen]:
        ns, frame = self._stamp(keyframe.timestamp), _camera(keyframe.segment)
        size = keyframe.depth.shape[0], keyframe.depth.shape[1]
        intrinsics = camera.scale_intrinsics(keyframe.intrinsics, keyframe.image.shape[:2], size)
        yield Seen("/keyframe/depth", ns, foxglove.depth(ns, frame, keyframe.depth))
        yield Seen("/keyframe/calibration", ns, foxglove.calibration(ns, frame, intrinsics, size))
        points = foxglove.keyframe_points(
            ns, _world(keyframe.segment), keyframe.world_from_cam, keyframe.depth, intrinsics, keyframe.image
        )
        yield Seen("/keyframe/points", ns, points)

    def _path(self, trajectory: Trajectory) -> Iterator[Seen]:
        known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
        for segment in np.unique(trajectory.segment[known]).tolist():
            path = trajectory.world_from_cam[known & (trajectory.segment == segment)]
            yield Seen("/trajectory" + _part(segment), self._end, foxglove.poses(self._end, _world(segment), path))

    def _map(self, splats: SplatMap) -> Seen:
        placed = [self._keyframes[i].segment for i in splats.keyframes.tolist() if i in self._keyframes]
        frame = _world(next((segment for segment in placed if segment is not None), 0))
        points = foxglove.map_points(
            self._end, frame, splats.origin, splats.means, splats.sh, splats.opacity_logits
        )  # fmt: skip
        return Seen("/map", self._end, points)


def _posed(ns: int, segment: int, world_from_cam: np.ndarray) -> Iterator[Seen]:
    yield Seen("/camera/pose", ns, foxglove.pose(ns, _world(segment), world_from_cam))
    yield Seen("/tf", ns, foxglove.transform(ns, _world(segment), _camera(segment), world_from_cam))


def _part(segment: int) -> str:
    return f"_{segment}" if segment else ""


def _world(segment: int) -> str:
    return "map" + _part(segment)


def _camera(segment: int) -> str:
    return "camera" + _part(segment)
