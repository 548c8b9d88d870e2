"""Matches the points of a keyframe in another image: the flow, and features where the flow loses too many."""

from __future__ import annotations

from weakref import WeakValueDictionary

import numpy as np

from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import FeatureFlow, Flow, Matches


class Matcher:
    """`flow` refines the guess; where too few points survive, features give another guess, and the better one wins."""

    def __init__(self, flow: Flow) -> None:
        self.flow = flow
        self.features = FeatureFlow()
        self.calls = 0
        self.feature_calls = 0  # how often features had to help
        # images that were matched, by index, as long as anybody has them: what is computed of them is kept
        self.used: WeakValueDictionary[int, TrackingImage] = WeakValueDictionary()

    def match(self, a: TrackingImage, b: TrackingImage, guess: np.ndarray, enough: float) -> tuple[Matches, float]:
        """Points of a's cells (M) in b. guess: (M, 2), NaN where there is none.

        enough: fraction of the textured points below which features are tried; 0 never tries them.
        Returns the matches and the fraction of the textured points that were found.
        """
        self.calls += 1
        self.used[a.index], self.used[b.index] = a, b
        matches, fraction = self._flow(a, b, guess)
        if fraction < enough:
            self.feature_calls += 1
            propagated = self.features.match(a, b, a.cells.points, guess)
            if propagated.alive.sum() > 0:
                other, other_fraction = self._flow(a, b, propagated.target)
                if other_fraction > fraction:
                    return other, other_fraction
        return matches, fraction

    def _flow(self, a: TrackingImage, b: TrackingImage, guess: np.ndarray) -> tuple[Matches, float]:
        cells = a.cells
        height, width = b.size
        with np.errstate(invalid="ignore"):
            near = np.all((guess > -16) & (guess < [width + 15, height + 15]), axis=1)
        wanted = np.flatnonzero(cells.textured & near)
        target, weight = np.full((len(near), 2), np.nan), np.zeros(len(near))
        if len(wanted):
            found = self.flow.match(a, b, cells.points[wanted], guess[wanted])
            target[wanted], weight[wanted] = found.target, found.weight
            hidden = b.masked(target)
            target[hidden], weight[hidden] = np.nan, 0.0
        fraction = float((weight > 0).sum() / max(1, cells.textured.sum()))
        return Matches(target, weight, b.velocity_at(target)), fraction


__all__ = ["Matcher"]
