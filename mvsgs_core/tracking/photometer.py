"""The light of the keyframe graph, kept up as it grows: exposures of keyframes and frames, vignetting.

Every edge is looked at once, when it is matched; the whole graph is solved again when it has grown by a tenth, and
keyframes between take their exposure from their edges. The gauge stays as it is while the graph grows; the end's
solution has the mean over the keyframes. Of a large graph the newest keyframes are solved, beside the others as they
are: the equations are dense.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.gray_levels import (
    BESIDE,
    MIN_SAMPLES,
    TERMS,
    backward,
    log_ratio_moments,
    surrounded,
)
from mvsgs_core.tracking.estimation.lights import ImageLights, edges_between
from mvsgs_core.tracking.estimation.photometry import PhotometricEdges
from mvsgs_core.tracking.estimation.response import radial_terms
from mvsgs_core.tracking.graph import Edge, KeyframeGraph
from mvsgs_core.tracking.image import CELL, RecentImages, TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.steps import Steps, timed, whole

GROWTH = 1.1  # of the keyframes, at which all are solved again
AT_ONCE = 300  # keyframes that are solved together

_OBSERVATION = np.dtype(
    [("reference", "<i8"), ("moments", "<f4", (3, 2, TERMS))]
)  # the rows that `PhotometricCalibration.step` asks


class Seen(Protocol):
    """What is asked of a frame's record."""

    @property
    def index(self) -> int: ...

    @property
    def light(self) -> bytes: ...


def observed(graph: KeyframeGraph, reference: int, image: TrackingImage, matches: Matches) -> bytes:
    """What a frame's matches of a keyframe's points say of its light: 224 bytes, none where it is too little."""
    moments = _compared(graph, reference, image, matches.target, matches.alive)
    if moments is None:
        return b""
    return np.array((reference, moments[:, :2]), _OBSERVATION).tobytes()


@dataclass(frozen=True)
class FrameLight:
    """What is known of the light of a frame that has no other record."""

    index: int
    light: bytes = b""  # see `observed`


class Photometer(ImageLights):
    def __init__(self, graph: KeyframeGraph, stats: Stats) -> None:
        super().__init__(stats)
        self.graph = graph
        self._order: list[int] = []  # keyframes of the last solution
        self._moments: dict[tuple[int, int], tuple[Edge, np.ndarray | None]] = {}  # of every edge as it was matched
        self._looked_at = 0  # changes of the graph's edges

    def known(self, index: int) -> object:
        """What `exposure` is made of: an object that is another one whenever that changes."""
        return self._lights.get(index) if self.photometry.varies else None

    def of_frames(self, records: Sequence[Seen], posed: np.ndarray) -> np.ndarray | None:
        """(N, 3, 4) float32 color affines of frames, NaN where they are not known or not `posed` (N,); None where
        exposures do not vary."""
        if not self.photometry.varies:
            return None
        found = np.full((len(records), 3, 4), np.nan, np.float32)
        for k, record in enumerate(records):
            light = self._of_frame(record) if posed[k] else None
            affine = None if light is None else self._affine(record.index, light)
            if affine is not None:
                found[k] = affine
        return found

    def update(self, at_the_end: bool = False) -> None:
        """Takes in the graph's new edges and keyframes. at_the_end: the stream has ended, all is solved for again."""
        whole(self.updating(at_the_end))

    def take_up(self) -> None:
        """Takes in a map that another run left, part by part as it grew there; the mean is over all its keyframes."""
        with self.stats.time("photometry"):
            whole(self._looking_at_edges())
            order = sorted(self.graph.keyframes)
            for known in range(AT_ONCE, len(order), AT_ONCE // 2):
                self._solve(order[:known], False)
            self._solve(order, True)

    def updating(self, at_the_end: bool = False) -> Steps[None]:
        """`update`, an edge a step."""
        yield from timed(self.stats, "photometry", self._updating(at_the_end))

    def _updating(self, at_the_end: bool) -> Steps[None]:
        yield from self._looking_at_edges()
        order = sorted(self.graph.keyframes)
        known = len(self._order)
        if at_the_end or len(order) >= min(GROWTH * known, known + AT_ONCE // 2):
            self._solve(order, at_the_end)
        elif self.photometry.varies:
            for index in order:
                if index not in self._lights:
                    self._attach_keyframe(index)

    def _looking_at_edges(self) -> Steps[None]:
        graph = self.graph
        changed, self._looked_at = graph.edges.changes(self._looked_at)
        images = RecentImages()
        for a, b in tuple(changed):
            edge, known = graph.edges.get((a, b)), self._moments.get((a, b))
            if edge is None:
                self._moments.pop((a, b), None)
            elif known is None or known[0] is not edge:
                _, image = (images.use(graph.keyframes[index].image) for index in (a, b))
                self._moments[a, b] = edge, _compared(graph, a, image, edge.target.T, edge.found)
                yield

    def edges(self, order: Sequence[int]) -> PhotometricEdges:
        """Of the keyframes `order`, by their places in it: a pair's both directions in one, from the earlier one."""
        among = set(order)
        pairs: dict[tuple[int, int], np.ndarray] = {}
        for (a, b), (_, moments) in self._moments.items():
            if moments is not None and a in among and b in among:
                pair = min(a, b), max(a, b)
                pairs[pair] = pairs.get(pair, 0.0) + (moments if a < b else backward(moments))
        return edges_between(order, pairs)

    def _solve(self, order: list[int], at_the_end: bool) -> None:
        if len(order) > AT_ONCE:
            return self._solve_newest(order, at_the_end)
        exposures = [self.graph.keyframes[index].image.exposure for index in order]
        lights = self._solved(order, self.edges(order), exposures)
        if lights is None:
            return
        self.graph.vignetting = self.photometry.vignetting
        if self.photometry.varies and not at_the_end:
            lights = self._kept_still(lights)
        self._order, self._lights = order, lights

    def _solve_newest(self, order: list[int], at_the_end: bool) -> None:
        """Those of a large graph; where their light is steady and the others' was not, it is taken from their edges."""
        others, varied, lights, vignetting = order[:-AT_ONCE], self.photometry, self._lights, self.graph.vignetting
        self._solve(order[-AT_ONCE:], False)
        if varied.varies and not self.photometry.varies:
            self.photometry, self._lights, self.graph.vignetting = varied, lights, vignetting
        # copies: the response that their affines follow is another one, see `known`
        self._lights = {index: lights[index].copy() for index in others if index in lights} | self._lights
        self._order = order
        for index in order if self.photometry.varies else ():
            if index not in self._lights:
                self._attach_keyframe(index)
        if at_the_end and self._lights:
            mean = np.mean(list(self._lights.values()), axis=0)
            self._lights = {index: light - mean for index, light in self._lights.items()}

    def _kept_still(self, lights: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
        """The same in the gauge of before: what is known does not change as a whole with each keyframe that comes."""
        both = self._lights.keys() & lights.keys()
        if not both:
            return lights
        shift = np.mean([self._lights[i] - lights[i] for i in both], axis=0)
        return {index: light + shift for index, light in lights.items()}

    def _attach_keyframe(self, index: int) -> None:
        """The light of a new keyframe, from those it was matched with."""
        self._attach(index, ((pair, self._moments[pair][1]) for pair in self.graph.edges.of([index])))

    def _of_frame(self, record: Seen) -> np.ndarray | None:
        if record.index in self._lights:
            return self._lights[record.index]
        if not record.light:
            return None
        seen = np.frombuffer(record.light, _OBSERVATION)[0]
        start = self._lights.get(int(seen["reference"]))
        if start is None:
            return None
        return np.asarray(start + self.photometry.step(seen["moments"].astype(np.float64)))


def _compared(
    graph: KeyframeGraph, reference: int, image: TrackingImage, target: np.ndarray, alive: np.ndarray
) -> np.ndarray | None:
    """Moments (3, 6, 6) of the log ratios of a keyframe's cells and an image, where its points were found, (M, 2).

    The flattest place of a cell is looked up as far beside the match as it is beside the cell's point. Of one that does
    not lie among points which were found less is believed.
    """
    keyframe = graph.keyframes[reference].image
    if keyframe.levels is None or image.levels is None or alive.sum() < MIN_SAMPLES:
        return None
    places, samples = keyframe.flat_places
    points = keyframe.cells.points
    inside = surrounded(places, points, alive, (keyframe.size[0] // CELL, keyframe.size[1] // CELL))[alive]
    places = places[alive]
    there = target[alive] + places - points[alive]
    here, across = (radial_terms(at, graph.intrinsics, image.size) for at in (places, there))
    doubt = np.where(inside, 0.0, BESIDE)
    return log_ratio_moments(samples[alive], image.levels.at(there), (here, across), graph.vignetting, doubt)


__all__ = ["FrameLight", "Photometer", "observed"]
