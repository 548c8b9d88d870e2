"""A tracker of your own, in a file outside the repository:

    mvsgs dataset=tum dataset.path=DIR tracker._target_=my_tracker.Strided tracker.stride=8

It is visual odometry as in textbooks: corners followed by Lucas-Kanade, a start from the essential matrix, then PnP
against triangulated points. It is small, and it is honest about what that means: sparse depth, a fixed stride of
keyframes, no bundle adjustment and no loop closure, so it drifts; where it loses the points it says LOST and stays so.
The scale is arbitrary, as with any single camera: the first points have the median depth 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from msgs import Frame, Keyframe, TrackingState, Trajectory
from nodes import Node

MIN_START = 60  # points that must agree for a start
MIN_POINTS = 15  # points that must agree for a pose
MIN_ANGLE = np.radians(1.0)  # between the two rays of a triangulated point
MAX_ERROR = 2.0  # pixels


class Strided(Node):
    """Frame -> Keyframe at a fixed stride, with the pose from sparse visual odometry; Trajectory at the end."""

    @dataclass
    class Config:
        stride: int = 8  # frames from one keyframe to the next
        corners: int = 800  # followed at once
        start_parallax: float = 0.03  # median motion of the corners before the start, of the image's width
        grid: int = 8  # pixels per cell of the keyframes' sparse inverse depth

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._first: Frame | None = None
        self._gray = np.zeros((0, 0), np.uint8)  # of the last frame
        self._pixels = np.zeros((0, 2))  # of every followed corner in the last frame
        self._anchors = np.zeros((0, 2))  # and in the keyframe where it was found
        self._anchor_poses = np.zeros((0, 4, 4))  # cam_from_world of that keyframe
        self._points = np.zeros((0, 3))  # in the world; NaN where not triangulated yet
        self._last_keyframe = 0
        self._track: list[tuple[int, float, np.ndarray | None, bool]] = []  # index, time, cam_from_world, keyframe

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        self.stats.count("frames")
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        if self._first is None:
            self._first = frame
            self._add_corners(gray, np.eye(4))
            self._remember(frame, np.eye(4), keyframe=True)
        else:
            self._follow(gray)
            yield from self._localize(frame, gray)
        self._gray = gray

    def on_end(self) -> Iterator[Trajectory]:
        if not self._track:
            return
        indices, times, poses, keyframes = zip(*self._track, strict=True)
        started = any(keyframes[1:])
        lost = TrackingState.LOST if started else TrackingState.NOT_INITIALIZED
        known = [pose is not None and started for pose in poses]
        yield Trajectory(
            np.array(indices, np.int64),
            np.array(times),
            np.stack([np.linalg.inv(p) if k else np.full((4, 4), np.nan) for p, k in zip(poses, known, strict=True)]),
            np.array(keyframes) & np.array(known),
            np.where(known, int(TrackingState.TRACKED), int(lost)).astype(np.uint8),
            np.zeros(len(indices), np.int32),
        )

    def _localize(self, frame: Frame, gray: np.ndarray) -> Iterator[Keyframe]:
        camera = _matrix(frame.intrinsics)
        starting = not np.isfinite(self._points).any()
        pose = self._start(frame, camera) if starting else self._pose_from_points(camera)
        keyframe = pose is not None and (starting or frame.index - self._last_keyframe >= self.config.stride)
        self._remember(frame, pose, keyframe)
        if pose is None or not keyframe:
            return
        if starting:
            assert self._first is not None
            yield self._keyframe(self._first, np.eye(4), self._anchors)
        else:
            self._triangulate(pose, camera)
        self._last_keyframe = frame.index
        yield self._keyframe(frame, pose, self._pixels)
        self._add_corners(gray, pose)

    def _start(self, frame: Frame, camera: np.ndarray) -> np.ndarray | None:
        """The second pose, from the essential matrix, once the corners have moved enough. None before."""
        motion = np.median(np.linalg.norm(self._pixels - self._anchors, axis=1)) if len(self._pixels) else 0.0
        if len(self._pixels) < MIN_START or motion < self.config.start_parallax * frame.image.shape[1]:
            return None
        essential, inliers = cv2.findEssentialMat(self._anchors, self._pixels, camera, cv2.RANSAC, 0.999, 1.0)
        if essential is None or essential.shape != (3, 3):
            return None
        good, rotation, translation, _ = cv2.recoverPose(essential, self._anchors, self._pixels, camera, mask=inliers)
        if good < MIN_START:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation[:, 0]
        self._triangulate(pose, camera)
        known = np.isfinite(self._points[:, 2])
        if known.sum() < MIN_START:
            self._points[:] = np.nan
            return None
        scale = 1.0 / np.median(self._points[known, 2])
        self._points *= scale
        pose[:3, 3] *= scale
        return pose

    def _pose_from_points(self, camera: np.ndarray) -> np.ndarray | None:
        known = np.flatnonzero(np.isfinite(self._points[:, 0]))
        if len(known) < MIN_POINTS:
            return None
        points, pixels = self._points[known], self._pixels[known]
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points, pixels, camera, None, reprojectionError=MAX_ERROR, iterationsCount=200
        )
        if not found or inliers is None or len(inliers) < MIN_POINTS:
            self.stats.warn("tracking was lost: too few points agree on a pose")
            return None
        inliers = inliers[:, 0]
        rotation, translation = cv2.solvePnPRefineLM(
            points[inliers], pixels[inliers], camera, None, rotation, translation
        )
        self._points[np.setdiff1d(known, known[inliers])] = np.nan
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        return pose

    def _triangulate(self, pose: np.ndarray, camera: np.ndarray) -> None:
        """World points of the corners that have none yet, where angle, side and reprojection allow it."""
        for i in np.flatnonzero(np.isnan(self._points[:, 0])):
            projections = [camera @ self._anchor_poses[i][:3], camera @ pose[:3]]
            pixels = [self._anchors[i], self._pixels[i]]
            rows = [uv[axis] * p[2] - p[axis] for p, uv in zip(projections, pixels, strict=True) for axis in (0, 1)]
            homogeneous = np.linalg.svd(np.stack(rows))[2][-1]
            if abs(homogeneous[3]) < 1e-9:
                continue
            point = homogeneous[:3] / homogeneous[3]
            rays = [point - np.linalg.inv(p)[:3, 3] for p in (self._anchor_poses[i], pose)]
            cosine = rays[0] @ rays[1] / (np.linalg.norm(rays[0]) * np.linalg.norm(rays[1]))
            seen = [p @ np.append(point, 1.0) for p in projections]
            good = all(
                s[2] > 0 and np.linalg.norm(s[:2] / s[2] - uv) < MAX_ERROR for s, uv in zip(seen, pixels, strict=True)
            )
            if good and cosine < np.cos(MIN_ANGLE):
                self._points[i] = point

    def _follow(self, gray: np.ndarray) -> None:
        """Lucas-Kanade from the last frame to this one and back; what does not come back is dropped."""
        if len(self._pixels) == 0:
            return
        before = self._pixels.astype(np.float32)[:, None]
        after, found, _ = cv2.calcOpticalFlowPyrLK(self._gray, gray, before, None)
        back, _, _ = cv2.calcOpticalFlowPyrLK(gray, self._gray, after, None)
        keep = (found[:, 0] == 1) & (np.linalg.norm(back - before, axis=2)[:, 0] < 0.5)
        height, width = gray.shape
        keep &= ((after[:, 0] > 0) & (after[:, 0] < (width - 1, height - 1))).all(axis=1)
        self._pixels = after[keep, 0].astype(np.float64)
        self._anchors, self._anchor_poses = self._anchors[keep], self._anchor_poses[keep]
        self._points = self._points[keep]

    def _add_corners(self, gray: np.ndarray, pose: np.ndarray) -> None:
        wanted = self.config.corners - len(self._pixels)
        free = np.full(gray.shape, 255, np.uint8)
        for x, y in self._pixels.astype(int):
            cv2.circle(free, (int(x), int(y)), 8, 0, -1)
        found = cv2.goodFeaturesToTrack(gray, wanted, 0.005, 8, mask=free) if wanted > 0 else None
        if found is None:
            return
        corners = found[:, 0].astype(np.float64)
        self._pixels = np.concatenate([self._pixels, corners])
        self._anchors = np.concatenate([self._anchors, corners])
        self._anchor_poses = np.concatenate([self._anchor_poses, np.repeat(pose[None], len(corners), 0)])
        self._points = np.concatenate([self._points, np.full((len(corners), 3), np.nan)])

    def _keyframe(self, frame: Frame, pose: np.ndarray, pixels: np.ndarray) -> Keyframe:
        """With the inverse depth of the cells that a point falls into; the others are unknown, at weight 0."""
        self.stats.count("keyframes")
        step = self.config.grid
        shape = (frame.image.shape[0] // step, frame.image.shape[1] // step)
        inverse_depth, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        known = np.isfinite(self._points[:, 0])
        depth = (self._points[known] @ pose[2, :3]) + pose[2, 3]
        columns, rows = (pixels[known] / step).astype(int).T
        inside = (depth > 0) & (columns < shape[1]) & (rows < shape[0])
        inverse_depth[rows[inside], columns[inside]] = 1.0 / depth[inside]
        weight[rows[inside], columns[inside]] = 1.0
        return Keyframe(
            frame.index,
            frame.timestamp,
            frame.image,
            frame.intrinsics,
            np.linalg.inv(pose),
            1.0,
            inverse_depth,
            weight,
            0,
        )

    def _remember(self, frame: Frame, pose: np.ndarray | None, keyframe: bool) -> None:
        self._track.append((frame.index, frame.timestamp, pose, keyframe))


def _matrix(intrinsics: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
