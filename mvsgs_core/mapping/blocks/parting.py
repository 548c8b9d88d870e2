"""A map parted into blocks: which one owns a splat, and which keyframes and splats each needs.

Keyframes are parted by where the middle of what they see is: in halves of equal work by a plane across an axis, these
again, and so on (Bentley's k-d tree, 1975). The planes part the splats, too, each of which is owned by one block. A
keyframe is at home in one and a guest in every other of which it sees enough. A block's work is its keyframes, guests
too, times its splats: an iteration goes over all of these.

Whether it sees enough is asked of clumps, the splats in a cube, of which nothing hides another. Which splats a block
needs is asked of the keyframes' renders: a street's far end is mostly hidden.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mvsgs_core.mapping.keyframes import TrainingView

CLUMP = 0.25  # side of the cubes, scene's median depths
FAR = 3.0  # median depths: what lies beyond makes nobody a guest, as something hides most of it


@dataclass(frozen=True)
class Parting:
    """Blocks 0 to B-1 of a map."""

    home: np.ndarray  # (K,) int64 block of each keyframe
    owner: np.ndarray  # (N,) int64 block of each splat
    trained: np.ndarray  # (B, K) bool, keyframes that a block trains on: those at home, and guests
    needed: tuple[np.ndarray, ...]  # B times (N,) bool, splats that these show, and all that the block owns

    def __len__(self) -> int:
        return len(self.trained)


@dataclass(frozen=True)
class _Clumps:
    centers: np.ndarray  # (C, 3)
    area: np.ndarray  # (C,) of its splats, as far as they are opaque


@dataclass(frozen=True)
class _Sight:
    """What a keyframe sees of the map nearby."""

    clumps: np.ndarray  # (S,) int64 their numbers
    fraction: np.ndarray  # (S,) of all that it sees there


def part(
    views: Sequence[TrainingView], means: np.ndarray, log_scales: np.ndarray, opacity: np.ndarray, median_depth: float,
    blocks: int, overlap: float, shown: Callable[[int], np.ndarray], shared: np.ndarray,
) -> Parting:  # fmt: skip
    """Of keyframes (K) and splats: means (N, 3), log_scales (N, 3), opacity (N,) 0 to 1, in the mapper's frame.

    shown: (N,) bool, splats that a keyframe's image shows, by its place among the views; each is asked once.
    shared: (K,) bool, keyframes beside which other frames are trained on: what those see, the keyframes before and
    after show as well. median_depth: of the scene; overlap: fraction of what a keyframe sees from which on it is a
    guest. A block that no keyframe is at home in is left out: its splats go to the first one.
    """
    points = np.array([_middle(view, median_depth) for view in views]).reshape(-1, 3)
    if min(blocks, len(views)) < 2:
        return _whole(len(views), len(means))
    clumps = _clumps(means, log_scales, opacity, CLUMP * median_depth)
    sights = [_sight(view, clumps, median_depth) for view in views]
    reach = np.array([_reach(point, sight, clumps, overlap) for point, sight in zip(points, sights)])
    planes = _planes(points, reach, means.astype(np.float64), min(blocks, len(views)))
    home, owner, held = (_sides(at, planes) for at in (points, means.astype(np.float64), clumps.centers))
    kept = np.unique(home)
    if len(kept) == 1:
        return _whole(len(views), len(means))
    home = np.searchsorted(kept, home)
    owner, held = (np.where(np.isin(at, kept), np.searchsorted(kept, at), 0) for at in (owner, held))
    trained = home == np.arange(len(kept))[:, None]
    for k, sight in enumerate(sights):
        trained[:, k] |= np.bincount(held[sight.clumps], sight.fraction, len(kept)) > overlap
    beside = trained & shared
    wanted = trained.copy()
    wanted[:, 1:] |= beside[:, :-1]
    wanted[:, :-1] |= beside[:, 1:]
    needed = owner == np.arange(len(kept))[:, None]
    for k in range(len(views)):
        needed[wanted[:, k]] |= shown(k)
    return Parting(home, owner, trained, tuple(needed))


def _whole(views: int, splats: int) -> Parting:
    home, owner = np.zeros(views, np.int64), np.zeros(splats, np.int64)
    return Parting(home, owner, np.ones((1, views), bool), (np.ones(splats, bool),))


def _middle(view: TrainingView, median_depth: float) -> np.ndarray:
    """(3,) of what it sees."""
    pose = view.local_from_cam
    return np.asarray(pose[:3, 3] + (view.median_depth or median_depth) * pose[:3, 2])


Planes = tuple[int, float, "Planes | None", "Planes | None"]  # axis, value; what parts the side below, and that above


def _planes(points: np.ndarray, reach: np.ndarray, means: np.ndarray, blocks: int) -> Planes | None:
    """None: one block. Equal points are never parted. reach: (K, 2, 3), see `_reach`."""
    if blocks < 2 or len(points) < 2:
        return None
    below, least, found = blocks // 2, np.inf, None
    for axis in np.argsort(-np.ptp(points, axis=0), kind="stable").tolist():
        values = np.unique(points[:, axis])
        cuts = (values[1:] + values[:-1]) / 2
        if not len(cuts):
            continue
        splats = np.searchsorted(np.sort(means[:, axis]), cuts)
        under = np.searchsorted(np.sort(reach[:, 0, axis]), cuts)
        over = len(points) - np.searchsorted(np.sort(reach[:, 1, axis]), cuts)
        # of one of the blocks that each side is to become
        work = np.maximum(under * splats / below**2, over * (len(means) - splats) / (blocks - below) ** 2)
        best = int(np.argmin(work))
        if work[best] < least:
            least, found = work[best], (axis, float(cuts[best]))
    if found is None:
        return None
    axis, value = found
    under, there = points[:, axis] < value, means[:, axis] < value
    return (
        axis, value,
        _planes(points[under], reach[under], means[there], below),
        _planes(points[~under], reach[~under], means[~there], blocks - below),
    )  # fmt: skip


def _sides(points: np.ndarray, planes: Planes | None) -> np.ndarray:
    """(N,) int64 block of each point."""
    found = np.zeros(len(points), dtype=np.int64)
    if planes is None:
        return found
    axis, value, below, above = planes
    under = points[:, axis] < value
    found[under] = _sides(points[under], below)
    found[~under] = _leaves(below) + _sides(points[~under], above)
    return found


def _leaves(planes: Planes | None) -> int:
    return 1 if planes is None else _leaves(planes[2]) + _leaves(planes[3])


def _clumps(means: np.ndarray, log_scales: np.ndarray, opacity: np.ndarray, side: float) -> _Clumps:
    _, of_splat = np.unique(np.floor(means / side).astype(np.int64), axis=0, return_inverse=True)
    of_splat = of_splat.reshape(-1)
    count = int(of_splat.max(initial=-1)) + 1
    number = np.bincount(of_splat, minlength=count)
    centers = np.column_stack([np.bincount(of_splat, means[:, i], count) for i in range(3)]) / number[:, None]
    scales = np.sort(np.exp(log_scales.astype(np.float64)), axis=1)
    return _Clumps(centers, np.bincount(of_splat, opacity * scales[:, 1] * scales[:, 2], count))


def _sight(view: TrainingView, clumps: _Clumps, median_depth: float) -> _Sight:
    depth, inside = _seen(view, clumps.centers)
    near = np.flatnonzero(inside & (depth < FAR * (view.median_depth or median_depth)))
    weight = clumps.area[near] / np.maximum(depth[near], 1e-3 * median_depth) ** 2
    return _Sight(near, weight / max(float(weight.sum()), 1e-30))


def _reach(point: np.ndarray, sight: _Sight, clumps: _Clumps, overlap: float) -> np.ndarray:
    """(2, 3): a keyframe is trained on below a plane that lies above the first, and above one below the second.

    point: (3,) the middle of what it sees.
    """
    ends = np.stack([point, point])
    for axis in range(3):
        at = clumps.centers[sight.clumps, axis]
        order = np.argsort(at)
        sum_ = np.cumsum(sight.fraction[order])
        for end, enough in ((0, sum_ > overlap), (1, 1.0 - sum_ + sight.fraction[order] > overlap)):
            if enough.any():
                chosen = at[order][enough]
                ends[end, axis] = min(point[axis], chosen[0]) if end == 0 else max(point[axis], chosen[-1])
    return ends


def _seen(view: TrainingView, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points (C, 3): depth (C,), and whether they are in the image (C,)."""
    (height, width), (fx, fy, cx, cy) = view.image_size, view.image_intrinsics  # there where the image was let go
    left, right, top, bottom = cx + 0.5, width - 0.5 - cx, cy + 0.5, height - 0.5 - cy
    planes = np.array([[-fx, 0, -left], [fx, 0, -right], [0, -fy, -top], [0, fy, -bottom]])
    pose = view.refined_from_cam
    points = (centers - pose[:3, 3]) @ pose[:3, :3]
    outside = (points @ (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T).max(axis=1)
    depth = points[:, 2]
    return depth, (outside < 0) & (depth > 0)


__all__ = ["Parting", "part"]
