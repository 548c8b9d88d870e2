"""A camera's trajectory: what is known of the pose of each frame of a stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from mvsgs_core import geometry

LONGEST_GAP = 0.25  # seconds between frames: over a longer one the velocity is not known


class TrackingState(IntEnum):
    """What the tracker knows of a frame's pose."""

    TRACKED = 0
    LOST = 1  # no pose: the frame could not be matched with the map
    NOT_INITIALIZED = 2  # no pose: before the map began
    DEGENERATE = 3  # a pose, but the motion gives no depth (pure rotation) or the image no texture


@dataclass(frozen=True)
class Trajectory:
    """All frames that the tracker saw, N, in order."""

    index: np.ndarray  # (N,) int64
    timestamp: np.ndarray  # (N,) float64 seconds
    world_from_cam: np.ndarray  # (N, 4, 4) float64, NaN where there is no pose
    keyframe: np.ndarray  # (N,) bool
    state: np.ndarray  # (N,) uint8 TrackingState
    segment: np.ndarray  # (N,) int32: poses of two segments share no frame of reference
    focal_factor: float = 1.0  # on the focal lengths of the frames, where they were guessed
    readout_time: float = 0.0  # seconds of the rolling shutter, first row to last; 0: none that is taken account of
    exposure: np.ndarray | None = None  # (N, 3, 4) float32 color affine of each, see `msgs`, NaN where it is not known
    vignetting: np.ndarray | None = None  # (3,) float32 of the sensor
    velocity: np.ndarray | None = None  # (N, 6) of the camera, see `velocities`; None: that between the poses
    places: np.ndarray | None = None  # (N, 3) latitude, longitude, altitude by GPS, NaN where not known; None: nowhere
    distortion: np.ndarray | None = None  # (2,) k1, k2 of the frames that the keyframes are without; None: none
    reads_columns: bool = False  # the rolling shutter reads columns, not rows
    in_order: bool = True  # one frame after the other along a path; false: photographs in any order

    @classmethod
    def empty(cls) -> Trajectory:
        """That of a stream without frames."""
        index, poses = np.zeros(0, np.int64), np.zeros((0, 4, 4))
        return cls(index, np.zeros(0), poses, np.zeros(0, bool), np.zeros(0, np.uint8), np.zeros(0, np.int32))

    @property
    def posed(self) -> np.ndarray:
        """(N,) bool: frames with a pose, verified or not."""
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))

    def velocities_of(self, index: np.ndarray) -> np.ndarray:
        """(K, 6) of the camera at the frames `index` (K,), see `velocities`; NaN where no neighbor tells it, and of
        frames of another stream."""
        if len(self.index) == 0:
            return np.full((len(index), 6), np.nan)
        found = np.zeros((len(self.index), 6))
        for segment in np.unique(self.segment[self.posed]):
            found += velocities(self.timestamp, self.world_from_cam, self.posed & (self.segment == segment))
        found[~found.any(axis=1)] = np.nan
        place = np.minimum(np.searchsorted(self.index, index), len(self.index) - 1)
        return np.where((self.index[place] == index)[:, None], found[place], np.nan)

    def main(self, keyframes: np.ndarray | Sequence[int] = ()) -> np.ndarray:
        """(N,) bool: frames with a pose in the part that holds most of a map's `keyframes` (K,), by index.

        In that with most frames where none of them is of this stream, or there is no map.
        """
        posed = self.posed
        if not posed.any():
            return posed
        mapped = posed & np.isin(self.index, keyframes)
        segments, counts = np.unique(self.segment[mapped if mapped.any() else posed], return_counts=True)
        return np.asarray(posed & (self.segment == segments[np.argmax(counts)]))

    def following(self, keyframes: np.ndarray, world_from_cam: np.ndarray) -> Trajectory:
        """The part that a map shows, moved to where that has its keyframes (K,), by index: world_from_cam (K, 4, 4).

        The frames between two of them move as they do, on the screw from one motion to the other, linear in time;
        those before the first and after the last move as that one, and repeated ones as the first of them. Time is as
        `along` has it. Photographs in any order move as the keyframe does that is nearest in space.
        """
        order = np.argsort(keyframes)
        shown = self.main(keyframes)
        anchors = np.flatnonzero(shown & np.isin(self.index, keyframes))
        if not len(anchors):
            return self
        known = world_from_cam[order[np.searchsorted(keyframes, self.index[anchors], sorter=order)]]
        if np.array_equal(known, self.world_from_cam[anchors]):
            return self
        poses, main = self.world_from_cam.copy(), np.flatnonzero(shown)
        again = repeated(poses[main]) & ~np.isin(main, anchors)
        first = main[np.maximum.accumulate(np.where(again, 0, np.arange(len(main))))]
        origin = poses[anchors[0], :3, 3].copy()  # the world's may be far away
        poses[:, :3, 3] -= origin
        target = known.copy()
        target[:, :3, 3] -= origin
        moves, times = target @ geometry.inverse(poses[anchors]), along(self.timestamp)
        if self.in_order:
            place = np.interp(times[main], times[anchors], np.arange(len(anchors)))
        else:
            place = nearest(poses[main, :3, 3], poses[anchors, :3, 3]).astype(np.float64)
        before = np.floor(place).astype(int)
        after = np.minimum(before + 1, len(anchors) - 1)
        change = geometry.se3_log(geometry.inverse(moves[before]) @ moves[after])
        poses[main] = moves[before] @ geometry.se3_exp((place - before)[:, None] * change) @ poses[main]
        poses[:, :3, 3] += origin
        poses[anchors] = known
        poses[main] = poses[first]
        return replace(self, world_from_cam=poses)


def along(timestamps: np.ndarray) -> np.ndarray:
    """(N,) ascending, what lies between frames: their times (N,), or where these stand still or go back, as of a clock
    that was set, their numbers."""
    return timestamps if (np.diff(timestamps) > 0.0).all() else np.arange(len(timestamps), dtype=np.float64)


def nearest(centers: np.ndarray, among: np.ndarray) -> np.ndarray:
    """(N,) int which of the camera positions `among` (K, 3), at least one, is nearest to each of `centers` (N, 3).

    Of photographs in any order it is what lies beside a pose, as `along` has it of a path's; any for a NaN."""
    return np.array([np.argmin(np.linalg.norm(among - center, axis=1)) for center in centers], np.int64)


def velocities(timestamps: np.ndarray, world_from_cam: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Camera velocities (N, 6) by the `known` (N,) neighbors in time of each frame; 0 where there is none.

    A twist (translation, rotation) a second in the camera's own axes, in the unit of the poses. timestamps: (N,)
    seconds; of frames whose times stand still or go back it is 0. world_from_cam: (N, 4, 4). Frames that have the pose
    of the one before are that image again, as in a video of 15 frames a second that is shown at 30: the velocity is
    that between the images before and after. Over a longer time, the camera rests.
    """
    result = np.zeros((len(timestamps), 6))
    order = np.flatnonzero(known)
    begins = np.flatnonzero(~repeated(world_from_cam[order]))
    new = order[begins]
    for k, same in enumerate(np.split(order, begins[1:]) if len(order) else ()):
        around = [m for m in new[max(k - 1, 0) : k + 2] if abs(timestamps[m] - timestamps[new[k]]) < LONGEST_GAP]
        seconds = timestamps[around[-1]] - timestamps[around[0]]
        rests = timestamps[same[-1]] - timestamps[same[0]] >= LONGEST_GAP
        if not rests and seconds > 0.0 and (np.diff(timestamps[around]) > 0.0).all():
            moved = geometry.inverse(world_from_cam[around[0]]) @ world_from_cam[around[-1]]
            result[same] = geometry.se3_log(moved) / seconds
    return result


def repeated(world_from_cam: np.ndarray) -> np.ndarray:
    """(N,) bool: frames (N, 4, 4) with the pose of the one before, against which they did not move."""
    again = np.zeros(len(world_from_cam), bool)
    again[1:] = (world_from_cam[1:] == world_from_cam[:-1]).all(axis=(1, 2))
    return again


__all__ = ["LONGEST_GAP", "TrackingState", "Trajectory", "along", "nearest", "repeated", "velocities"]
