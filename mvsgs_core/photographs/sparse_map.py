"""A map of photographs that are put together: their poses, the points that they see, and their lens.

An observation takes part while its point has a place and its photograph a pose that agree with it; bundle adjustment
mends what is around one photograph, or everything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.photographs.adjustment import SparseProblem, adjust_sparse, reprojection
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.registration import MAX_ERROR, MIN_SEEN, ROBUST
from mvsgs_core.photographs.tracks import Tracks
from mvsgs_core.photographs.triangulation import triangulate

MIN_ANGLE = np.radians(1.5)  # between the rays of a point
AROUND = 6  # photographs that a local adjustment moves
SETTLED = 1e-3  # of the observations: where fewer came or went, adjusting everything once more changes nothing
ROUGH = 1e-3  # of the cost: a smaller gain ends an adjustment while the map still grows
FOR_FOCAL, FOR_DISTORTION = 3, 5  # photographs, from which on these are estimated


@dataclass(frozen=True)
class Model:
    """A part of the photographs, in one frame and unit of its own."""

    cam_from_world: np.ndarray  # (P, 4, 4), NaN of those that are not in it
    lens: SharedLens
    points: np.ndarray  # (M, 3)
    tracks: np.ndarray  # (M,) of which each point is
    photograph: np.ndarray  # (N,) of each observation
    point: np.ndarray  # (N,)
    pixels: np.ndarray  # (N, 2)
    residual: np.ndarray  # (N,) pixels
    order: list[int]  # photographs as they were registered

    @property
    def registered(self) -> np.ndarray:
        """(P,) bool."""
        return np.asarray(np.isfinite(self.cam_from_world).all(axis=(1, 2)))


class SparseMap:
    """Grows by photographs and points, and is adjusted."""

    def __init__(self, tracks: Tracks, lens: SharedLens, count: int, free_lens: bool) -> None:
        """count: photographs, P. free_lens: focal length and distortion are estimated too."""
        self.tracks, self.lens, self.free_lens = tracks, lens, free_lens
        self._given = lens
        self.poses = np.full((count, 4, 4), np.nan)  # cam_from_world
        self.points = np.full((tracks.count, 3), np.nan)
        self.order: list[int] = []  # photographs as they came

    def begin(self, pair: tuple[int, int], second_from_first: np.ndarray) -> None:
        """Two views alone, in the place of whatever there was; second_from_first: (4, 4)."""
        self.lens, self.order = self._given, list(pair)
        self.poses[:], self.points[:] = np.nan, np.nan
        self.poses[pair[0]], self.poses[pair[1]] = np.eye(4), second_from_first
        self.triangulate()

    def add(self, index: int, pose: np.ndarray) -> None:
        """Another photograph with its pose (4, 4)."""
        self.poses[index] = pose
        self.order.append(index)

    @property
    def posed(self) -> np.ndarray:
        """(P,) bool."""
        return np.asarray(np.isfinite(self.poses[:, 0, 0]))

    @property
    def known(self) -> np.ndarray:
        """(tracks,) bool: those with a point."""
        return np.asarray(np.isfinite(self.points[:, 0]))

    def seen(self) -> np.ndarray:
        """(P,) how many points of the map each photograph sees, posed or not."""
        return np.bincount(self.tracks.photograph[self.known[self.tracks.track]], minlength=len(self.poses))

    def triangulate(self, index: int | None = None) -> None:
        """New points, of the tracks that photograph `index` sees; None: of all."""
        posed = self.posed
        wanted = ~self.known
        if index is not None:
            seen = np.zeros(self.tracks.count, bool)
            seen[self.tracks.track[self.tracks.photograph == index]] = True
            wanted &= seen
        use = np.flatnonzero(wanted[self.tracks.track] & posed[self.tracks.photograph])
        points, tracks = triangulate(
            self.poses, self.lens, self.tracks.photograph[use], self.tracks.track[use], self.tracks.pixels[use],
            MAX_ERROR, MIN_ANGLE,
        )  # fmt: skip
        self.points[tracks] = points

    def adjust_around(self, index: int) -> None:
        """The photographs that share most points with `index` move, with the points that they see."""
        use, _ = self._agreeing()
        seen = np.zeros(self.tracks.count, bool)
        seen[self.tracks.track[use[self.tracks.photograph[use] == index]]] = True
        shared = np.bincount(self.tracks.photograph[use[seen[self.tracks.track[use]]]], minlength=len(self.poses))
        near = [int(n) for n in np.argsort(-shared, kind="stable")[: AROUND + 1] if shared[n] > 0]
        free = np.zeros(len(self.poses), bool)
        free[near] = True
        free[self.order[:2] if len(near) >= len(self.order) else self.order[:1]] = False  # frame of reference and unit
        moved = np.zeros(self.tracks.count, bool)
        moved[self.tracks.track[use[free[self.tracks.photograph[use]]]]] = True
        self._solve(use[moved[self.tracks.track[use]]], free, steps=5, lens=False, tolerance=ROUGH)

    def adjust_all(self, last: bool = False) -> dict[int, int]:
        """Everything moves; observations that miss are left out and come back, tracks without a point try again.

        last: to the last digit. Returns the photographs that lost their poses, with how many points they see.
        """
        before, dropped = 0, dict[int, int]()
        for _ in range(2):
            use, _ = self._agreeing()
            if len(self.order) < 2 or abs(len(use) - before) < SETTLED * before:
                break
            before = len(use)
            dropped |= self._adjust(use, steps=10, tolerance=ROUGH)
        if last and len(self.order) >= 2:
            dropped |= self._adjust(self._agreeing()[0], steps=25, tolerance=1e-5)
        return dropped

    def _adjust(self, use: np.ndarray, steps: int, tolerance: float) -> dict[int, int]:
        free = self.posed
        free[self.order[0]] = False
        self._solve(use, free, steps, lens=True, tolerance=tolerance)
        self._normalize()
        self._forget()
        dropped = self._drop()
        self.triangulate()
        seen = self.seen()
        return {index: int(seen[index]) for index in dropped}

    def _solve(self, use: np.ndarray, free: np.ndarray, steps: int, lens: bool, tolerance: float) -> None:
        views = len(self.order) if lens and self.free_lens else 0
        problem = replace(
            self._problem(use, free),
            free_focal=views >= FOR_FOCAL,
            free_distortion=views >= FOR_DISTORTION,
            known_factor=self._given.factor,
        )
        solution = adjust_sparse(problem, steps, ROBUST, tolerance)
        self.poses[free] = solution.cam_from_world[free]
        self.points[np.unique(self.tracks.track[use])] = solution.points
        self.lens = solution.lens

    def _problem(self, use: np.ndarray, free: np.ndarray) -> SparseProblem:
        names, point = np.unique(self.tracks.track[use], return_inverse=True)
        poses = np.where(np.isfinite(self.poses), self.poses, np.eye(4))
        return SparseProblem(
            poses, self.points[names], self.lens, self.tracks.photograph[use], point, self.tracks.pixels[use], free
        )

    def _agreeing(self) -> tuple[np.ndarray, np.ndarray]:
        """Observations of points of the map in posed photographs that hit them, and their errors in pixels."""
        posed = self.posed
        use = np.flatnonzero(self.known[self.tracks.track] & posed[self.tracks.photograph])
        residual, z = reprojection(self._problem(use, posed))
        error = np.where(z > 1e-6, np.linalg.norm(residual, axis=1), np.inf)
        good = error < MAX_ERROR
        good &= (np.bincount(self.tracks.track[use], good, minlength=self.tracks.count) >= 2)[self.tracks.track[use]]
        return use[good], error[good]

    def _forget(self) -> None:
        """Points that two observations no longer hit, or whose rays are too close to say how far they are."""
        use, _ = self._agreeing()
        track = self.tracks.track[use]
        centers = geometry.inverse(np.where(np.isfinite(self.poses), self.poses, np.eye(4)))[:, :3, 3]
        rays = self.points[track] - centers[self.tracks.photograph[use]]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        total = np.stack([np.bincount(track, rays[:, n], minlength=self.tracks.count) for n in range(3)], axis=1)
        count = np.bincount(track, minlength=self.tracks.count)
        mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        off = np.zeros(self.tracks.count)  # largest angle of a ray from the mean: half of the widest pair, or more
        np.maximum.at(off, track, np.arccos(np.clip(np.sum(rays * mean[track], axis=1), -1.0, 1.0)))
        self.points[(count < 2) | (2.0 * off < MIN_ANGLE)] = np.nan

    def _drop(self) -> list[int]:
        """Photographs that too few points hold any more lose their poses; which."""
        use, _ = self._agreeing()
        held = np.bincount(self.tracks.photograph[use], minlength=len(self.poses))
        dropped = [n for n in self.order if held[n] < MIN_SEEN]
        self.poses[dropped] = np.nan
        self.order = [n for n in self.order if n not in dropped]
        return dropped

    def _normalize(self) -> None:
        """The unit is the cameras' spread: nothing runs away from the solver's thresholds."""
        posed = self.posed
        centers = geometry.inverse(self.poses[posed])[:, :3, 3]
        scale = float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
        if scale > 0.0:
            self.poses[:, :3, 3] /= scale
            self.points /= scale

    def model(self) -> Model:
        """A copy of what there is, without the observations that do not agree."""
        use, error = self._agreeing()
        names, point = np.unique(self.tracks.track[use], return_inverse=True)
        return Model(
            self.poses.copy(), self.lens, self.points[names], names, self.tracks.photograph[use], point,
            self.tracks.pixels[use], error, list(self.order),
        )  # fmt: skip


__all__ = ["MIN_ANGLE", "Model", "SparseMap"]
