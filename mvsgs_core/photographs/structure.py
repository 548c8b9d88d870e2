"""Photographs in, models out: features, pairs, focal length, tracks, incremental reconstruction, in this order.

Photographs that are not `mapped` add nothing to a model: they get their poses from it when it is done.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mvsgs_core.photographs.config import PhotographsConfig
from mvsgs_core.photographs.features import Features, find_features
from mvsgs_core.photographs.focal import BY_HOMOGRAPHY, focal_factor
from mvsgs_core.photographs.lens import SharedLens
from mvsgs_core.photographs.matching import EXHAUSTIVE, match, near_pairs, propose_pairs
from mvsgs_core.photographs.reconstruction import all_models
from mvsgs_core.photographs.registration import register
from mvsgs_core.photographs.sparse_map import Model
from mvsgs_core.photographs.tracks import Tracks, link
from mvsgs_core.photographs.two_views import TwoViews, verify
from mvsgs_core.stats import Stats

Pairs = dict[tuple[int, int], TwoViews]


@dataclass
class Photographs:
    """Takes photographs one by one, in any order, and then solves them all."""

    config: PhotographsConfig = field(default_factory=PhotographsConfig)
    stats: Stats = field(default_factory=Stats)
    features: list[Features] = field(default_factory=list)
    pairs: Pairs = field(default_factory=dict)  # that were verified, once solved
    _intrinsics: list[np.ndarray] = field(default_factory=list)
    _sizes: list[tuple[int, int]] = field(default_factory=list)
    _places: list[np.ndarray | None] = field(default_factory=list)
    _guessed: bool = False

    def add(
        self, image: np.ndarray, intrinsics: np.ndarray, guessed: bool, place: np.ndarray | None = None,
        mask: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """An RGB image (H, W, 3) uint8 with (fx, fy, cx, cy); guessed: the focal length is not known at all.

        place: (3,) latitude, longitude (degrees) and altitude (m), by GPS. mask: (H, W) bool, False where a pixel is to
        be ignored.
        """
        with self.stats.time("features"):
            self.features.append(find_features(image, self.config.features, mask))
        self._intrinsics.append(np.asarray(intrinsics, np.float64))
        self._sizes.append((image.shape[0], image.shape[1]))
        self._places.append(place)
        self._guessed |= guessed

    def solve(self, mapped: np.ndarray | None = None) -> list[Model]:
        """Models, the largest first, that share no photograph; none where no two photographs could be put together.

        mapped: (P,) bool, see above; None: all are.
        """
        if len(self.features) < 2:
            return []
        mapped = np.ones(len(self.features), bool) if mapped is None else mapped
        pairs = self.pairs = self._pairs()
        lens = SharedLens(np.stack(self._intrinsics))
        if self._guessed:
            lens = replace(lens, factor=self._focal_factor(pairs))
        points = [found.points for found in self.features]
        inner = {pair: views for pair, views in pairs.items() if mapped[list(pair)].all()}
        tracks = link(points, {pair: views.matches for pair, views in inner.items()})
        sizes, free = np.array(self._sizes), self.config.refine_lens
        with self.stats.time("reconstruction"):
            models = list(all_models(inner, points, tracks, lens, sizes, mapped, free))
            models.sort(key=lambda model: -int(model.registered.sum()))
            for index in np.flatnonzero(~mapped):
                self._localize(int(index), models, pairs, tracks)
        return models

    def _pairs(self) -> Pairs:
        """The verified ones."""
        with self.stats.time("proposed pairs"):
            proposed = propose_pairs(self.features, self.config.neighbors)
            alike = set(proposed)
            near = near_pairs(self._places, self.config.near) if len(self.features) > EXHAUSTIVE else []
            proposed += [pair for pair in near if pair not in alike]
        pairs: Pairs = {}
        for i, j in proposed:
            with self.stats.time("matching"):
                matches = match(self.features[i], self.features[j])
            with self.stats.time("verification"):
                views = verify(self.features[i].points, self.features[j].points, matches)
            if views is not None:
                pairs[i, j] = views
        if any(place is not None for place in self._places):
            self.stats.counts["pairs of photographs that only GPS proposed"] = len(proposed) - len(alike)
        self.stats.counts["pairs of photographs that were matched"] = len(proposed)
        self.stats.counts["pairs of photographs that agree with one geometry"] = len(pairs)
        return pairs

    def _focal_factor(self, pairs: Pairs) -> float:
        telling = {pair: views for pair, views in pairs.items() if views.by_homography < BY_HOMOGRAPHY}
        found = focal_factor(
            [views.fundamental for views in telling.values()],
            [(self._intrinsics[i], self._intrinsics[j]) for i, j in telling],
            [float(len(views.matches)) for views in telling.values()],
        )
        if found is None:
            self.stats.warn("the pairs of photographs do not tell the focal length: the guess is where it starts from")
        return 1.0 if found is None else found

    def _localize(self, index: int, models: list[Model], pairs: Pairs, tracks: Tracks) -> None:
        """A photograph that adds nothing gets its pose in the first model that has enough of its matches."""
        theirs = np.full(len(self.features[index].points), -1)  # the track that each of its features was matched with
        for (i, j), views in pairs.items():
            if index not in (i, j):
                continue
            other, mine = (i, 1) if index == j else (j, 0)
            of = tracks.of_features(other, len(self.features[other].points))[views.matches[:, 1 - mine]]
            theirs[views.matches[of >= 0, mine]] = of[of >= 0]
        seen = np.flatnonzero(theirs >= 0)
        for model in models:
            place = np.full(tracks.count, -1)
            place[model.tracks] = np.arange(len(model.tracks))
            known = seen[place[theirs[seen]] >= 0]
            points = model.points[place[theirs[known]]]
            pose = register(index, points, self.features[index].points[known], model.lens)
            if pose is not None:
                model.cam_from_world[index] = pose
                return


__all__ = ["Photographs"]
