"""Incremental structure from motion of photographs in any order (Schoenberger and Frahm 2016).

Two views begin; then, one by one, the photograph that sees most of the map, best spread over its image, gets its pose
from it (PnP), adds points, and bundle adjustment mends what is around it, or everything once the map has grown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.registration import BENT, MAX_ERROR, MIN_SEEN, register
from mvsgs_core.photographs.sparse_map import MIN_ANGLE, Model, SparseMap
from mvsgs_core.photographs.tracks import Tracks
from mvsgs_core.photographs.two_views import TwoViews, relative_poses

FIRST_ANGLE = np.radians(5.0)  # of the first two views, median
FIRST_PAIRS, FIRST_TRIES = 12, 3  # pairs that are looked at, at least, and that may begin a map
PLANE = 0.8  # of the matches: where one homography explains so many, they may lie on a plane
MIN_PHOTOGRAPHS = 3  # of a model
AGAIN = 1.2  # times as many points of the map must a photograph see to be tried again
GROWTH = 1.2  # of the number of photographs, between two adjustments of everything
FOR_OTHERS = 10  # photographs of a model whose lens holds for what is put together after it
SAME_CAMERA = 1.05  # between focal lengths that were given for one camera
GRIDS = (2, 4, 8, 16)  # boxes along a side, over which a photograph's points are spread


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
        self.tracks, self.lens, self.sizes = tracks, lens, sizes
        self.map = SparseMap(tracks, lens, len(sizes), free_lens)
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
                    self.map.triangulate()
                    self._adjust_all(last=True)
                    grown.append(self.map.model())
            best = max(grown, key=lambda model: (len(model.order), len(model.residual)), default=None)
            if best is not None and len(best.order) >= MIN_PHOTOGRAPHS:
                return best
        return None

    def _grow(self, left: np.ndarray) -> None:
        settled, bent = 0, False  # photographs when those that failed were last tried again, and how
        while len(self.map.order) >= 2:
            chosen = self._next(left)
            if chosen is None:
                if not self._failed:
                    return
                if len(self.map.order) > self._adjusted:
                    self._adjust_all()  # which may take poses back: what came and went again is no gain
                gained = len(self.map.order) > settled
                if bent and not gained:
                    return
                bent = not gained  # the mended map has brought no more: it may be bent there
                settled = max(settled, len(self.map.order))
                self._failed.clear()  # once more
                continue
            index, seen = chosen
            if not self._register(index, BENT * MAX_ERROR if bent else MAX_ERROR):
                self._failed[index] = seen
                continue
            self.map.triangulate(index)
            self.map.adjust_around(index)
            if len(self.map.order) >= GROWTH * self._adjusted:
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
        self.map.begin(pair, second_from_first)
        self._adjusted = 0
        self._failed.clear()
        if self.map.known.sum() < MIN_SEEN:
            return False
        self._adjust_all()
        return len(self.map.order) == len(pair)

    def _next(self, left: np.ndarray) -> tuple[int, int] | None:
        """The photograph whose points of the map are best spread over it, and how many it sees."""
        mapped = self.map.known[self.tracks.track]
        open_ = left & ~self.map.posed
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
        mine = np.flatnonzero((self.tracks.photograph == index) & self.map.known[self.tracks.track])
        world = self.map.points[self.tracks.track[mine]]
        pose = register(index, world, self.tracks.pixels[mine], self.map.lens, max_error)
        if pose is None:
            return False
        self.map.add(index, pose)
        return True

    def _adjust_all(self, last: bool = False) -> None:
        self._failed |= self.map.adjust_all(last)  # only with more points than are there now are they tried again
        self._adjusted = len(self.map.order)

    def _boxes(self, side: int) -> np.ndarray:
        size = self.sizes[self.tracks.photograph]
        at = np.clip((self.tracks.pixels + 0.5) / size[:, ::-1] * side, 0, side - 1).astype(int)
        return np.asarray(at[:, 1] * side + at[:, 0])


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


__all__ = ["Reconstruction", "all_models", "connected"]
