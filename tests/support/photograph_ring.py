"""Cameras on an arc around a cloud of points: what each sees, in pixels of a lens that is known to the test alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.two_views import TwoViews, verify

SIZE = (480, 640)
FOCAL = 600.0


@dataclass(frozen=True)
class Ring:
    """P photographs of M points; `points` has NaN where a photograph does not see one."""

    cam_from_world: np.ndarray  # (P, 4, 4)
    world: np.ndarray  # (M, 3)
    pixels: np.ndarray  # (P, M, 2)
    lens: SharedLens  # the true one

    @property
    def features(self) -> list[np.ndarray]:
        """(M, 2) of each photograph: feature m is point m; one that is not seen is somewhere off the image."""
        return [np.where(np.isfinite(seen), seen, -1e4) for seen in self.pixels]

    def pairs(self, wrong: float = 0.0, seed: int = 0) -> dict[tuple[int, int], TwoViews]:
        """Verified pairs; wrong: fraction of the matches that are of two different points, before verification."""
        random, found = np.random.default_rng(seed), {}
        for i, j in combinations(range(len(self.pixels)), 2):
            both = np.flatnonzero(np.isfinite(self.pixels[i, :, 0]) & np.isfinite(self.pixels[j, :, 0]))
            matches = np.stack([both, both], axis=1)
            mixed = random.random(len(both)) < wrong
            matches[mixed, 1] = random.permutation(matches[mixed, 1])
            views = verify(self.features[i], self.features[j], matches)
            if views is not None:
                found[i, j] = views
        return found


def ring(
    count: int = 8,
    points: int = 400,
    step: float = 12.0,
    noise: float = 0.3,
    k1: float = 0.0,
    k2: float = 0.0,
    flat: bool = False,
    depths: float = 0.4,
    seed: int = 0,
) -> Ring:
    """step: degrees between two cameras; depths: how their distances differ; noise: pixels; flat: all on a plane."""
    random = np.random.default_rng(seed)
    world = random.uniform(-1.0, 1.0, (points, 3))
    if flat:
        world[:, 2] *= 0.0
    poses = []
    for n in range(count):
        turn = geometry.so3_exp(np.array([0.1 * np.sin(2.0 * n), np.radians(step) * (n - 0.5 * (count - 1)), 0.05 * n]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, [0.1 * np.cos(n), 0.1 * np.sin(3.0 * n), 4.0 + depths * np.sin(1.7 * n)]
        poses.append(pose)
    middle = [0.5 * (SIZE[1] - 1), 0.5 * (SIZE[0] - 1)]
    lens = SharedLens(np.tile([FOCAL, FOCAL, *middle], (count, 1)), 1.0, k1, k2)
    pixels = np.full((count, points, 2), np.nan)
    for n, pose in enumerate(poses):
        seen = world @ pose[:3, :3].T + pose[:3, 3]
        at = lens.project(np.full(points, n), seen) + noise * random.standard_normal((points, 2))
        inside = np.all((at >= 0) & (at < [SIZE[1], SIZE[0]]), axis=1) & (seen[:, 2] > 0)
        pixels[n, inside] = at[inside]
    return Ring(np.stack(poses), world, pixels, lens)


def position_error(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square, over the length of the path, after alignment; poses (N, 4, 4) cam_from_world."""
    here, there = (geometry.inverse(poses)[:, :3, 3] for poses in (found, true))
    off = geometry.umeyama(here, there).apply(here) - there
    path = float(np.linalg.norm(np.diff(there, axis=0), axis=1).sum())
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) / path


__all__ = ["FOCAL", "SIZE", "Ring", "position_error", "ring"]
