"""How far a depth sensor's maps agree with each other, and an offset of its inverse depth that explains what does not.

A structured-light sensor measures a disparity: a constant error of it adds the same to every inverse depth, near
surfaces keep their place and far ones move. It shows without any stereo: points of one map, carried to others by the
cameras' poses, meet the depths there or do not. Offset and scale against the poses are those of the least mean
difference; no depth of ours takes part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.depth.data import Scene
from mvsgs_core import geometry

POINTS = 400  # of each map
APART = 3  # keyframes: nearer ones see everything from the same distance
MAX_DIFFERENCE = 0.1  # relative difference: occlusions and moving things count as much, not more
STEPS = 3  # on both sides of the best so far, at each refinement
REFINEMENTS = 4  # each halves the steps
FIRST = 0.04, 0.04  # steps: of the offset times the median depth, and of the logarithm of the scale
EXPLAINS = 0.1  # fraction of the difference that an offset must explain to be believed


@dataclass(frozen=True)
class SensorOffset:
    """What makes the sensor's maps agree best."""

    offset: float  # of true inverse depth over measured, per meter
    before: float  # mean relative difference of carried depths, at most MAX_DIFFERENCE each, best scale, no offset
    after: float  # with the offset

    @property
    def believed(self) -> bool:
        return self.after < (1.0 - EXPLAINS) * self.before


@dataclass(frozen=True)
class _Map:
    truth: np.ndarray  # (H, W)
    intrinsics: np.ndarray
    world_from_cam: np.ndarray
    pixels: np.ndarray  # (2, POINTS) u, v
    depths: np.ndarray  # (POINTS,)


def sensor_offset(scene: Scene) -> SensorOffset:
    """Raises ValueError with fewer than two maps of true depth that lie far enough apart."""
    maps = _maps(scene)
    if len(maps) <= APART:
        raise ValueError(f"{scene.name} has {len(maps)} depth maps, their agreement needs {APART + 1}")
    median = float(np.median(np.concatenate([m.depths for m in maps])))

    def search(offsets: bool) -> tuple[float, float]:
        best, lowest = np.zeros(2), _difference(maps, 0.0, 1.0)
        step = np.array(FIRST) * (1.0 if offsets else 0.0, 1.0)
        for _ in range(REFINEMENTS):
            middle = best
            for i in range(-STEPS, STEPS + 1) if offsets else (0,):
                for j in range(-STEPS, STEPS + 1):
                    tried = middle + step * (i, j)
                    found = _difference(maps, tried[0] / median, float(np.exp(tried[1])) * (1.0 + tried[0]))
                    if found < lowest:
                        best, lowest = tried, found
            step = step / 2.0
        return float(best[0]) / median, lowest

    _, before = search(offsets=False)
    offset, after = search(offsets=True)
    return SensorOffset(offset, before, after)


def without_offset(scene: Scene, offset: float) -> Scene:
    """The scene with true depths (H, W) whose inverse is larger by `offset`, 0 where they are unknown."""
    truths = [None if t is None else _shifted(t, offset, 1.0) for t in scene.truths]
    return replace(scene, truths=truths)


def _difference(maps: list[_Map], offset: float, scale: float) -> float:
    """Mean relative difference of depths carried from each map to the others, at most MAX_DIFFERENCE each."""
    total, count = 0.0, 0
    for i, source in enumerate(maps):
        z = _shifted(source.depths, offset, scale)
        fx, fy, cx, cy = source.intrinsics
        points = np.stack([(source.pixels[0] - cx) / fx * z, (source.pixels[1] - cy) / fy * z, z], axis=1)
        world = points @ source.world_from_cam[:3, :3].T + source.world_from_cam[:3, 3]
        for j, target in enumerate(maps):
            if abs(i - j) < APART:
                continue
            cam_from_world = geometry.inverse(target.world_from_cam)
            local = world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
            local = local[local[:, 2] > 1e-6]
            fx, fy, cx, cy = target.intrinsics
            u = np.rint(local[:, 0] / local[:, 2] * fx + cx).astype(np.int64)
            v = np.rint(local[:, 1] / local[:, 2] * fy + cy).astype(np.int64)
            height, width = target.truth.shape
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            there = target.truth[v[inside], u[inside]]
            known = there > 0
            found = _shifted(there[known], offset, scale)
            apart = np.abs(local[inside, 2][known] - found) / found
            total += float(np.minimum(apart, MAX_DIFFERENCE).sum())
            count += len(apart)
    return total / count if count else MAX_DIFFERENCE  # maps that no longer meet do not agree


def _maps(scene: Scene) -> list[_Map]:
    rng = np.random.default_rng(0)
    found = []
    for view, truth in zip(scene.views, scene.truths, strict=True):
        if truth is None or not (truth > 0).any():
            continue
        v, u = np.nonzero(truth)
        chosen = rng.integers(0, len(v), POINTS)
        pixels = np.stack([u[chosen], v[chosen]]).astype(np.float64)
        depths = truth[v[chosen], u[chosen]].astype(np.float64)
        found.append(_Map(truth, view.intrinsics, view.world_from_cam, pixels, depths))
    return found


def _shifted(depth: np.ndarray, offset: float, scale: float) -> np.ndarray:
    """Depths with `offset` added to their inverse, times `scale`; 0 stays 0."""
    known = depth > 0
    shifted = scale / (1.0 / np.where(known, depth, 1.0) + offset)
    return np.where(known, shifted, 0.0).astype(depth.dtype)
