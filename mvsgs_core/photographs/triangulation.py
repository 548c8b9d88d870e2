"""Points of tracks from the photographs that have poses: each pair of views proposes one, most observations decide."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.two_views import midpoints

PAIRS = 6  # of views that propose a track's point, at most: those farthest apart in the order of the track


def triangulate(
    cam_from_world: np.ndarray,
    lens: SharedLens,
    photograph: np.ndarray,
    track: np.ndarray,
    pixels: np.ndarray,
    max_error: float,
    min_angle: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Points (K, 3) of the tracks (K,) that have one: in front of, and within `max_error` pixels in, two views or more,

    with rays at least `min_angle` radians apart. Observations (N) sorted by track; all photographs have poses.
    """
    names, starts, lengths = np.unique(track, return_index=True, return_counts=True)
    keep = lengths > 1
    names, starts, lengths = names[keep], starts[keep], lengths[keep]
    if not len(names):
        return np.zeros((0, 3)), names
    first, second = _pairs(lengths)
    of = np.repeat(np.arange(len(names)), [len(_spread(n)) for n in lengths])
    first, second = starts[of] + first, starts[of] + second
    rays = lens.unproject(photograph, pixels)
    world_from_cam = geometry.inverse(cam_from_world)
    there_from_here = cam_from_world[photograph[second]] @ world_from_cam[photograph[first]]
    points, angle = midpoints(rays[first], rays[second], there_from_here)
    here = world_from_cam[photograph[first]]
    points = (here[:, :3, :3] @ points[..., None])[..., 0] + here[:, :3, 3]
    good = np.isfinite(points).all(axis=1) & (angle >= min_angle)
    of, points, angle = of[good], points[good], angle[good]
    # how many observations of its track agree with each proposed point
    count = lengths[of]
    proposal = np.repeat(np.arange(len(of)), count)
    observation = np.repeat(starts[of] - np.cumsum(count) + count, count) + np.arange(int(count.sum()))
    pose = cam_from_world[photograph[observation]]
    seen = (pose[:, :3, :3] @ points[proposal][..., None])[..., 0] + pose[:, :3, 3]
    safe = np.where(seen[:, 2:] > 1e-6, seen, [0.0, 0.0, 1.0])
    error = np.linalg.norm(lens.project(photograph[observation], safe) - pixels[observation], axis=1)
    agree = np.bincount(proposal, (seen[:, 2] > 1e-6) & (error < max_error), minlength=len(of))
    order = np.lexsort((angle, agree, of))
    last = np.flatnonzero(np.diff(of[order], append=-1)) if len(of) else np.zeros(0, np.int64)
    best = order[last]
    best = best[agree[best] >= 2]
    return points[best], names[of[best]]


def _spread(length: int) -> list[tuple[int, int]]:
    """Pairs of places in a track, those farthest apart first."""
    pairs = [(i, j) for i in range(min(length, 8)) for j in range(i + 1, min(length, 8))]
    if length > 8:
        places = np.linspace(0, length - 1, 8).astype(int)
        pairs = [(int(places[i]), int(places[j])) for i, j in pairs]
    return sorted(pairs, key=lambda p: (p[0] - p[1], p))[:PAIRS]


def _pairs(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    table = {int(n): np.array(_spread(int(n))) for n in np.unique(lengths)}
    pairs = np.concatenate([table[int(n)] for n in lengths])
    return pairs[:, 0], pairs[:, 1]


__all__ = ["triangulate"]
