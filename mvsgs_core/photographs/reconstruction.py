"""Incremental structure from motion of photographs in any order (Schoenberger and Frahm 2016).

Two views begin; then, one by one, the photograph that sees most of the map, best spread over its image, gets its pose
from it (PnP), adds points, and bundle adjustment mends what is around it, or everything once the map has grown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.photographs.adjustment import SparseProblem, adjust_sparse, reprojection
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.registration import BENT, MAX_ERROR, MIN_SEEN, ROBUST, register
from mvsgs_core.photographs.tracks import Tracks
from mvsgs_core.photographs.triangulation import triangulate
from mvsgs_core.photographs.two_views import TwoViews, relative_poses

MIN_ANGLE = np.radians(1.5)  # between the rays of a point
FIRST_ANGLE = np.radians(5.0)  # of the first two views, median
FIRST_PAIRS, FIRST_TRIES = 12, 3  # pairs that are looked at, at least, and that may begin a map
PLANE = 0.8  # of the matches: where one homography explains so many, they may lie on a plane
MIN_PHOTOGRAPHS = 3  # of a model
AGAIN = 1.2  # times as many points of the map must a photograph see to be tried again
GROWTH = 1.2  # of the number of photographs, between two adjustments of everything
AROUND = 6  # photographs that a local adjustment moves
SETTLED = 1e-3  # of the observations: where fewer came or went, adjusting everything once more changes nothing
ROUGH = 1e-3  # of the cost: a smaller gain ends an adjustment while the map still grows
FOR_FOCAL, FOR_DISTORTION = 3, 5  # photographs, from which on these are estimated
FOR_OTHERS = 10  # photographs of a model whose lens holds for what is put together after it
SAME_CAMERA = 1.05  # between focal lengths that were given for one camera
GRIDS = (2, 4, 8, 16)  # boxes along a side, over which a photograph's points are spread


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


class Reconstruction:
    """Grows one model from verified pairs."""

    def __init__(
        self,
        tracks: Tracks,
        lens: SharedLens,
        sizes: np.ndarray,
        free_lens: bool,
    ) -> None:
        """sizes: (P, 2) height and width. free_lens: focal length and distortion are estimated too."""
        self.tracks, self.lens, self.sizes, self.free_lens = tracks, lens, sizes, free_lens
        self._given = lens
        self.poses = np.full((len(sizes), 4, 4), np.nan)
        self.points = np.full((tracks.count, 3), np.nan)
        self.order: list[int] = []
        self._adjusted = 0  # photographs when everything was adjusted last
        self._failed: dict[int, int] = {}  # photograph -> points of the map that it saw when it got no pose
        self._box = [self._boxes(n) for n in GRIDS]

    def run(self, pairs: dict[tuple[int, int], TwoViews], points: list[np.ndarray], left: np.ndarray) -> Model | None:
        """The model of the photographs `left` (P,) bool; None where no three of them can be put together.

        Two alone are no model: any two that agree with one geometry seem right. points: (N, 2) features of each.
        """
        for pair, poses in self._starts(pairs, points, left):
            grown = []
            for pose in poses:
                if self._begin(pair, pose):
                    self._grow(left)
                    self._triangulate(None)
                    self._adjust_all(last=True)
                    grown.append(self._model())
            best = max(grown, key=lambda model: (len(model.order), len(model.residual)), default=None)
            if best is not None and len(best.order) >= MIN_PHOTOGRAPHS:
                return best
        return None

    def _grow(self, left: np.ndarray) -> None:
        settled, bent = 0, False  # photographs when those that failed were last tried again, and how
        while len(self.order) >= 2:
            chosen = self._next(left)
            if chosen is None:
                if not self._failed:
                    return
                if len(self.order) > self._adjusted:
                    self._adjust_all()  # which may take poses back: what came and went again is no gain
                gained = len(self.order) > settled
                if bent and not gained:
                    return
                bent = not gained  # the mended map has brought no more: it may be bent there
                settled = max(settled, len(self.order))
                self._failed.clear()  # once more
                continue
            index, seen = chosen
            if not self._register(index, BENT * MAX_ERROR if bent else MAX_ERROR):
                self._failed[index] = seen
                continue
            self._triangulate(index)
            self._adjust_around(index)
            if len(self.order) >= GROWTH * self._adjusted:
                self._adjust_all()

    def _starts(
        self, pairs: dict[tuple[int, int], TwoViews], points: list[np.ndarray], left: np.ndarray
    ) -> list[tuple[tuple[int, int], list[np.ndarray]]]:
        """Pairs with their relative poses (4, 4): those first with most points at angles wide enough.

        Looked at are those with most matches that no homography explains, until some may begin a map: copies of one
        photograph match best of all, and tell nothing.
        """
        rated = sorted(
            ((len(v.matches) * (1.05 - v.by_homography), pair) for pair, v in pairs.items() if left[list(pair)].all()),
            reverse=True,
        )
        found: list[tuple[float, tuple[int, int], list[np.ndarray]]] = []
        for looked_at, (_, (i, j)) in enumerate(rated):
            if looked_at >= FIRST_PAIRS and len(found) >= FIRST_TRIES:
                break
            matches = pairs[i, j].matches
            here = self.lens.unproject(np.full(len(matches), i), points[i][matches[:, 0]])
            there = self.lens.unproject(np.full(len(matches), j), points[j][matches[:, 1]])
            focal = 0.5 * (self.lens.focal(i) + self.lens.focal(j))
            score, poses = 0.0, []
            for pose in relative_poses(here, there, focal, pairs[i, j].by_homography > PLANE):
                wide = np.isfinite(pose.points).all(axis=1) & (pose.angle > MIN_ANGLE)
                if wide.sum() >= MIN_SEEN:
                    angle = float(np.median(pose.angle[wide]))
                    score = max(score, float(wide.sum()) * min(1.0, angle / FIRST_ANGLE))
                    poses.append(pose.second_from_first)
            if poses:
                found.append((score, (i, j), poses))
        found.sort(key=lambda start: -start[0])
        return [(pair, poses) for _, pair, poses in found[:FIRST_TRIES]]

    def _begin(self, pair: tuple[int, int], second_from_first: np.ndarray) -> bool:
        """A map of two views alone, in the place of whatever there was."""
        self.lens, self.order, self._adjusted = self._given, list(pair), 0
        self.poses[:], self.points[:] = np.nan, np.nan
        self.poses[pair[0]], self.poses[pair[1]] = np.eye(4), second_from_first
        self._failed.clear()
        self._triangulate(None)
        if self._known().sum() < MIN_SEEN:
            return False
        self._adjust_all()
        return len(self.order) == len(pair)

    def _next(self, left: np.ndarray) -> tuple[int, int] | None:
        """The photograph whose points of the map are best spread over it, and how many it sees."""
        mapped = self._known()[self.tracks.track]
        open_ = left & ~np.isfinite(self.poses[:, 0, 0])
        count = np.bincount(self.tracks.photograph[mapped], minlength=len(left))
        score = np.zeros(len(left))
        for side, box in zip(GRIDS, self._box):
            filled = np.zeros((len(left), side * side), bool)
            filled[self.tracks.photograph[mapped], box[mapped]] = True
            score += side * np.count_nonzero(filled, axis=1)
        for index, seen in self._failed.items():
            if count[index] < AGAIN * seen:
                open_[index] = False
        open_ &= count >= MIN_SEEN
        if not open_.any():
            return None
        index = int(np.argmax(np.where(open_, score, -1.0)))
        return index, int(count[index])

    def _register(self, index: int, max_error: float) -> bool:
        """PnP of one photograph against the map; whether it has a pose now."""
        mine = np.flatnonzero((self.tracks.photograph == index) & self._known()[self.tracks.track])
        world = self.points[self.tracks.track[mine]]
        pose = register(index, world, self.tracks.pixels[mine], self.lens, max_error)
        if pose is None:
            return False
        self.poses[index] = pose
        self.order.append(index)
        return True

    def _triangulate(self, index: int | None) -> None:
        """New points, of the tracks that photograph `index` sees, or of all."""
        posed = np.isfinite(self.poses[:, 0, 0])
        wanted = ~self._known()
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

    def _adjust_around(self, index: int) -> None:
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

    def _adjust_all(self, last: bool = False) -> None:
        """Everything moves; observations that miss are left out and come back, tracks without a point try again."""
        before = 0
        for _ in range(2):
            use, _ = self._agreeing()
            if len(self.order) < 2 or abs(len(use) - before) < SETTLED * before:
                break
            before = len(use)
            self._adjust(use, steps=10, tolerance=ROUGH)
        if last and len(self.order) >= 2:
            self._adjust(self._agreeing()[0], steps=25, tolerance=1e-5)
        self._adjusted = len(self.order)

    def _adjust(self, use: np.ndarray, steps: int, tolerance: float) -> None:
        free = np.isfinite(self.poses[:, 0, 0])
        free[self.order[0]] = False
        self._solve(use, free, steps, lens=True, tolerance=tolerance)
        self._normalize()
        self._forget()
        dropped = self._drop()
        self._triangulate(None)
        if dropped:  # only with more points than are there now are they tried again
            seen = np.bincount(self.tracks.photograph[self._known()[self.tracks.track]], minlength=len(self.poses))
            self._failed |= {index: int(seen[index]) for index in dropped}

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
        posed = np.isfinite(self.poses[:, 0, 0])
        use = np.flatnonzero(self._known()[self.tracks.track] & posed[self.tracks.photograph])
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
        posed = np.isfinite(self.poses[:, 0, 0])
        centers = geometry.inverse(self.poses[posed])[:, :3, 3]
        scale = float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
        if scale > 0.0:
            self.poses[:, :3, 3] /= scale
            self.points /= scale

    def _known(self) -> np.ndarray:
        """(tracks,) bool: those with a point."""
        return np.asarray(np.isfinite(self.points[:, 0]))

    def _boxes(self, side: int) -> np.ndarray:
        size = self.sizes[self.tracks.photograph]
        at = np.clip((self.tracks.pixels + 0.5) / size[:, ::-1] * side, 0, side - 1).astype(int)
        return np.asarray(at[:, 1] * side + at[:, 0])

    def _model(self) -> Model:
        use, error = self._agreeing()
        names, point = np.unique(self.tracks.track[use], return_inverse=True)
        return Model(
            self.poses.copy(), self.lens, self.points[names], names, self.tracks.photograph[use], point,
            self.tracks.pixels[use], error, list(self.order),
        )  # fmt: skip


def all_models(
    pairs: dict[tuple[int, int], TwoViews],
    points: list[np.ndarray],
    tracks: Tracks,
    lens: SharedLens,
    sizes: np.ndarray,
    mapped: np.ndarray,
    free_lens: bool,
) -> Iterator[Model]:
    """The models that grow from the photographs `mapped` (P,): of each group that pairs tie together, then of its rest.

    A model of enough photographs gives its lens to later ones by the same camera, as few views may fit any.
    """
    length = lens.intrinsics[:, :2].mean(axis=1) / sizes.max(axis=1)  # focal lengths as they were given
    held: list[tuple[np.ndarray, SharedLens]] = []  # the focal lengths in a model, and its lens
    groups = connected(pairs, mapped)
    while groups:
        left = groups.pop(0)
        known = next((found for of, found in held if _one_camera(of, length[left])), None)
        model = Reconstruction(tracks, known or lens, sizes, free_lens and known is None).run(pairs, points, left)
        if model is None:
            continue
        yield model
        if free_lens and len(model.order) >= FOR_OTHERS:
            held.append((length[model.registered], model.lens))
        groups = connected(pairs, left & ~model.registered) + groups


def connected(pairs: Iterable[tuple[int, int]], among: np.ndarray) -> list[np.ndarray]:
    """The groups of `among` (P,) bool that pairs tie together and that may be a model, as masks, the largest first."""
    group = np.arange(len(among))
    for i, j in pairs:
        if among[i] and among[j] and group[i] != group[j]:
            group[group == group[j]] = group[i]
    names, count = np.unique(group[among], return_counts=True)
    large = np.argsort(-count, kind="stable")
    return [among & (group == names[n]) for n in large if count[n] >= MIN_PHOTOGRAPHS]


def _one_camera(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether focal lengths, over the image's size, may be those of one lens."""
    return bool(np.median(b) < SAME_CAMERA * a.max() and np.median(b) > a.min() / SAME_CAMERA)


__all__ = ["Model", "Reconstruction", "all_models", "connected"]
