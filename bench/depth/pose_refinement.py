"""Dataset poses made to fit their images: those of real sets are up to a degree off, several pixels at 320x240.

Bundle adjustment over matches of neighboring keyframes, every pose held near the dataset's own, so that scale and frame
stay the dataset's. It reads no depth: stereo with these poses is still scored against the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from bench.depth.data import Scene
from mvsgs_core import geometry
from mvsgs_core.mvs.hypotheses import RangeConfig, search_range
from mvsgs_core.mvs.keyframe import StereoKeyframe


@dataclass(frozen=True)
class PoseRefinementOptions:
    """How far poses may go, and what matches count."""

    reach: int = 3  # keyframes before and after that a keyframe is matched with
    points: int = 300  # corners a keyframe
    turn: float = 1.0  # degrees: width of the hold on a pose's rotation
    shift: float = 0.002  # of the median depth: width of the hold on its position
    pixel: float = 0.5  # pixels: noise of a match; residuals beyond count less (Cauchy)
    iterations: int = 12


@dataclass(frozen=True)
class _Matches:
    """Corners of one keyframe found in another."""

    source: int
    target: int
    point: np.ndarray  # (M,) which of all points
    seen: np.ndarray  # (M, 2) pixels in the target


def refine_poses(scene: Scene, options: PoseRefinementOptions | None = None) -> tuple[Scene, float, float]:
    """The scene with refined poses, and the median residual of its matches before and after, in pixels."""
    o = options or PoseRefinementOptions()
    views = scene.views
    poses = [v.world_from_cam for v in views]
    sources, rays, matches = _all_matches(views, o)
    inverse = _initial_depths(views, poses, sources, rays, matches)
    before = float(np.median(np.abs(np.concatenate([_residual(views, poses, rays, inverse, m)[0] for m in matches]))))
    held = [p.copy() for p in poses]
    depth = 1.0 / float(np.median(inverse))
    width = np.array([o.shift * depth] * 3 + [np.radians(o.turn)] * 3)
    for _ in range(o.iterations):
        poses, inverse = _step(views, poses, held, rays, inverse, matches, width, o)
    after = float(np.median(np.abs(np.concatenate([_residual(views, poses, rays, inverse, m)[0] for m in matches]))))
    moved = [replace(v, world_from_cam=p) for v, p in zip(views, poses, strict=True)]
    return replace(scene, views=moved), before, after


def _bytes(view: StereoKeyframe) -> np.ndarray:
    return np.clip(view.gray(1) + 128.0, 0.0, 255.0).astype(np.uint8)


def _track(image: np.ndarray, other: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 1, 2) found in `other`, and which of them (M,)."""
    guess = np.zeros_like(points)
    found, good, _ = cv2.calcOpticalFlowPyrLK(image, other, points, guess, winSize=(15, 15), maxLevel=3)
    return np.asarray(found), np.asarray(good).ravel() > 0


def _all_matches(
    views: list[StereoKeyframe], o: PoseRefinementOptions
) -> tuple[np.ndarray, np.ndarray, list[_Matches]]:
    """Source keyframe (P,) and viewing ray (P, 3) of each point; matches, tracked there and back."""
    images = [_bytes(v) for v in views]
    sources, rays, matches = [], [], []
    total = 0
    for i, view in enumerate(views):
        corners = cv2.goodFeaturesToTrack(images[i], o.points, 0.01, 6)
        if corners is None:
            continue
        pixels = corners.reshape(-1, 2).astype(np.float64)
        fx, fy, cx, cy = view.intrinsics
        ones = np.ones(len(pixels))
        rays.append(np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, ones], axis=1))
        sources.append(np.full(len(pixels), i))
        for j in range(max(0, i - o.reach), min(len(views), i + o.reach + 1)):
            if j == i:
                continue
            found, good = _track(images[i], images[j], corners)
            home, back = _track(images[j], images[i], found)
            near = np.linalg.norm((home - corners).reshape(-1, 2), axis=1) < 0.5
            use = np.flatnonzero(good & back & near)
            if len(use) >= 20:
                matches.append(_Matches(i, j, total + use, found.reshape(-1, 2)[use].astype(np.float64)))
        total += len(pixels)
    return np.concatenate(sources), np.concatenate(rays), matches


def _residual(
    views: list[StereoKeyframe], poses: list[np.ndarray], rays: np.ndarray, inverse: np.ndarray, m: _Matches
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels found minus predicted (M, 2); points (M, 3) in the target, times inverse depth; turned rays (M, 3)."""
    relative = geometry.inverse(poses[m.target]) @ poses[m.source]
    turned = rays[m.point] @ relative[:3, :3].T
    local = turned + inverse[m.point, None] * relative[:3, 3]
    z = np.maximum(local[:, 2], 1e-3)
    fx, fy, cx, cy = views[m.target].intrinsics
    predicted = np.stack([fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy], axis=1)
    return m.seen - predicted, np.concatenate([local[:, :2], z[:, None]], axis=1), np.tile(relative[:3, 3], (len(z), 1))


def _initial_depths(
    views: list[StereoKeyframe], poses: list[np.ndarray], sources: np.ndarray, rays: np.ndarray, matches: list[_Matches]
) -> np.ndarray:
    """(P,) inverse depths: of 48 in the keyframe's range, that of the least robust residual."""
    choice = RangeConfig()
    limits = []
    for view in views:
        found = search_range(view, views, None, choice)
        if found is None:
            raise ValueError(f"keyframe {view.index} has no depth range")
        limits.append((found.low, found.high))
    low, high = np.array(limits)[sources].T
    best, cost = low.copy(), np.full(len(low), np.inf)
    for part in np.linspace(0.0, 1.0, 48):
        inverse = low + part * (high - low)
        total = np.zeros(len(low))
        for m in matches:
            error, _, _ = _residual(views, poses, rays, inverse, m)
            np.add.at(total, m.point, np.log1p((error**2).sum(axis=1) / 4.0))
        better = total < cost
        best[better], cost[better] = inverse[better], total[better]
    return best


def _step(
    views: list[StereoKeyframe], poses: list[np.ndarray], held: list[np.ndarray], rays: np.ndarray, inverse: np.ndarray,
    matches: list[_Matches], width: np.ndarray, o: PoseRefinementOptions,
) -> tuple[list[np.ndarray], np.ndarray]:  # fmt: skip
    """One Gauss-Newton step; points are eliminated (Schur). Poses move by exp(x) on the camera's side."""
    count, points = len(poses), len(inverse)
    normal = np.zeros((count, 6, count, 6))
    right = np.zeros((count, 6))
    mixed = np.zeros((points, count, 6))
    diagonal, pull = np.full(points, 1e-6), np.zeros(points)
    for m in matches:
        error, local, shift = _residual(views, poses, rays, inverse, m)
        weight = 1.0 / (o.pixel**2 + (error**2).sum(axis=1))
        fx, fy = views[m.target].intrinsics[:2]
        x, y, z = local.T
        zero = np.zeros_like(x)
        by_local = np.stack(
            [np.stack([fx / z, zero, -fx * x / z**2], 1), np.stack([zero, fy / z, -fy * y / z**2], 1)], axis=1
        )
        w = inverse[m.point]
        relative = geometry.inverse(poses[m.target]) @ poses[m.source]
        to_target = _motion(local, w)  # d local / d x of the target, with the sign of its inverse
        to_source = relative[:3, :3] @ _motion(rays[m.point], w)
        j_target, j_source = -by_local @ to_target, by_local @ to_source
        j_depth = np.einsum("mij,mj->mi", by_local, shift)
        s, t = m.source, m.target
        for a, ja in ((s, j_source), (t, j_target)):
            right[a] += np.einsum("m,mik,mi->k", weight, ja, error)
            mixed[m.point, a] += np.einsum("m,mik,mi->mk", weight, ja, j_depth)
            for b, jb in ((s, j_source), (t, j_target)):
                normal[a, :, b] += np.einsum("m,mik,mil->kl", weight, ja, jb)
        np.add.at(diagonal, m.point, weight * (j_depth**2).sum(axis=1))
        np.add.at(pull, m.point, weight * (j_depth * error).sum(axis=1))
    for k in range(count):
        away = geometry.se3_log(geometry.inverse(held[k]) @ poses[k])
        normal[k, :, k] += np.diag(1.0 / width**2)
        right[k] -= away / width**2
    size = 6 * count
    flat = mixed.reshape(points, size)
    schur = normal.reshape(size, size) - flat.T @ (flat / diagonal[:, None])
    x = np.linalg.solve(schur, right.reshape(size) - flat.T @ (pull / diagonal)).reshape(count, 6)
    change = (pull - flat @ x.reshape(size)) / diagonal
    moved = [p @ geometry.se3_exp(d) for p, d in zip(poses, x, strict=True)]
    return moved, np.clip(inverse + change, 0.5 * inverse, 2.0 * inverse)


def _motion(point: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(M, 3, 6): how points (times inverse depth) move with a twist (shift, turn) of their camera."""
    x, y, z = point.T
    zero = np.zeros_like(x)
    turn = np.stack([np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], axis=1)
    return np.concatenate([inverse[:, None, None] * np.eye(3), turn], axis=2)
