"""A map parted into blocks: which one owns a splat, and which keyframes and splats each needs.

Keyframes are parted by where the middle of what they see is: halves of equal number, along the axis on which these
points are spread most, and so on (Bentley's k-d tree, 1975). The planes between them part the splats, too, each of
which is owned by one block. A keyframe is at home in one and a guest in every other of which it sees enough.

Whether it sees enough is asked of clumps, the splats of one block in a cube, of which nothing hides another. Which
splats a block needs is asked of the keyframes' renders: a street's far end is mostly hidden.
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
    owner: np.ndarray  # (C,) int64 block


def part(
    views: Sequence[TrainingView], means: np.ndarray, log_scales: np.ndarray, opacity: np.ndarray, median_depth: float,
    blocks: int, overlap: float, shown: Callable[[int], np.ndarray],
) -> Parting:  # fmt: skip
    """Of keyframes (K) and splats: means (N, 3), log_scales (N, 3), opacity (N,) 0 to 1, in the mapper's frame.

    shown: (N,) bool, splats that a keyframe's image shows, by its place among the views; each is asked once.
    median_depth: of the scene; overlap: fraction of what a keyframe sees from which on it is a guest. A block that no
    keyframe is at home in is left out: its splats go to the first one.
    """
    points = np.array([_middle(view, median_depth) for view in views]).reshape(-1, 3)
    planes = _planes(points, min(blocks, max(1, len(views))))
    home, owner = _sides(points, planes), _sides(means.astype(np.float64), planes)
    kept = np.unique(home)
    home = np.searchsorted(kept, home)
    owner = np.where(np.isin(owner, kept), np.searchsorted(kept, owner), 0)
    count = max(1, len(kept))
    trained = home == np.arange(count)[:, None]
    if count == 1:
        return Parting(home, owner, trained, (np.ones(len(means), bool),))
    clumps = _clumps(means, log_scales, opacity, owner, CLUMP * median_depth)
    needed = owner == np.arange(count)[:, None]
    for k, view in enumerate(views):
        depth, inside = _seen(view, clumps.centers)
        near = inside & (depth < FAR * (view.median_depth or median_depth))
        weight = np.where(near, clumps.area / np.maximum(depth, 1e-3 * median_depth) ** 2, 0.0)
        fraction = np.bincount(clumps.owner, weight, count) / max(float(weight.sum()), 1e-30)
        trained[:, k] |= fraction > overlap
        needed[trained[:, k]] |= shown(k)
    return Parting(home, owner, trained, tuple(needed))


def _middle(view: TrainingView, median_depth: float) -> np.ndarray:
    """(3,) of what it sees."""
    pose = view.local_from_cam
    return np.asarray(pose[:3, 3] + (view.median_depth or median_depth) * pose[:3, 2])


Planes = tuple[int, float, "Planes | None", "Planes | None"]  # axis, value; what parts the side below, and that above


def _planes(points: np.ndarray, blocks: int) -> Planes | None:
    """None: one block. Equal points are never parted."""
    if blocks < 2 or len(points) < 2:
        return None
    axis = int(np.argmax(np.ptp(points, axis=0)))
    below = blocks // 2
    sorted_ = np.sort(points[:, axis])
    cut = min(max(1, round(len(points) * below / blocks)), len(points) - 1)
    value = float(sorted_[cut - 1] + sorted_[cut]) / 2
    under = points[:, axis] < value
    return axis, value, _planes(points[under], below), _planes(points[~under], blocks - below)


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


def _clumps(
    means: np.ndarray, log_scales: np.ndarray, opacity: np.ndarray, owner: np.ndarray, side: float
) -> _Clumps:  # fmt: skip
    cubes = np.column_stack([owner, np.floor(means / side).astype(np.int64)])
    _, of_splat = np.unique(cubes, axis=0, return_inverse=True)
    of_splat = of_splat.reshape(-1)
    count = int(of_splat.max(initial=-1)) + 1
    number = np.bincount(of_splat, minlength=count)
    centers = np.column_stack([np.bincount(of_splat, means[:, i], count) for i in range(3)]) / number[:, None]
    scales = np.sort(np.exp(log_scales.astype(np.float64)), axis=1)
    owners = np.zeros(count, dtype=np.int64)
    owners[of_splat] = owner
    area = np.bincount(of_splat, opacity * scales[:, 1] * scales[:, 2], count)
    return _Clumps(centers, area, owners)


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
