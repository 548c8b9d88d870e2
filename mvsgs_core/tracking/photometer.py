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

from mvsgs_core.photometry import is_exposure, is_vignetting
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.gray_levels import (
    BESIDE,
    MIN_SAMPLES,
    TERMS,
    backward,
    log_ratio_moments,
    surrounded,
)
from mvsgs_core.tracking.estimation.photometry import PhotometricCalibration, PhotometricEdges, solve_photometry
from mvsgs_core.tracking.estimation.response import radial_terms, vignetting_polynomial
from mvsgs_core.tracking.graph import Edge, KeyframeGraph
from mvsgs_core.tracking.image import CELL, RecentImages, TrackingImage
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.steps import Steps, timed, whole

GROWTH = 1.1  # of the keyframes, at which all are solved again
AT_ONCE = 300  # keyframes that are solved together
NO_LIGHT = "exposures or a vignetting that no camera has were found, and left out"

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


class Photometer:
    def __init__(self, graph: KeyframeGraph, stats: Stats) -> None:
        self.graph = graph
        self.stats = stats
        self.photometry = PhotometricCalibration.steady(0)
        self._order: list[int] = []  # keyframes of the last solution
        self._lights: dict[int, np.ndarray] = {}  # (5,) of the keyframes, see `PhotometricCalibration.lights`
        self._moments: dict[tuple[int, int], tuple[Edge, np.ndarray | None]] = {}  # of every edge as it was matched
        self._looked_at = 0  # changes of the graph's edges
        self._refused: set[int | None] = set()  # frames whose exposure no camera has; None: the vignetting

    @property
    def vignetting(self) -> np.ndarray | None:
        """(3,) float32, see `msgs`; None: there is none, or none that a lens has."""
        if not np.any(self.photometry.vignetting):
            return None
        found = vignetting_polynomial(self.photometry.vignetting, self.photometry.vignetting_response)
        found = found.astype(np.float32)
        if not is_vignetting(found):
            self._refuse(None)
            return None
        return found

    @property
    def varies(self) -> bool:
        return self.photometry.varies

    def exposure(self, index: int) -> np.ndarray | None:
        """(3, 4) float32 color affine of a keyframe; None where exposures do not vary, or it is one of no camera."""
        if not self.photometry.varies or index not in self._lights:
            return None
        return self._affine(index, self._lights[index])

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

    def _affine(self, index: int, light: np.ndarray) -> np.ndarray | None:
        """(3, 4) float32 of a frame's light (5,); None for one that no camera has: no reader takes it."""
        affine = self.photometry.affine(light)
        if not is_exposure(affine):
            self._refuse(index)
            return None
        return affine

    def _refuse(self, whose: int | None) -> None:
        """Counts it once, however often it is asked for."""
        if whose not in self._refused:
            self._refused.add(whose)
            self.stats.refuse("exposures", 1, NO_LIGHT)

    def update(self, at_the_end: bool = False) -> None:
        """Takes in the graph's new edges and keyframes. at_the_end: the stream has ended, all is solved for again."""
        whole(self.updating(at_the_end))

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
                    self._attach(index)

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
        number = {index: n for n, index in enumerate(order)}
        pairs: dict[tuple[int, int], np.ndarray] = {}
        for (a, b), (_, moments) in self._moments.items():
            if moments is not None and a in number and b in number:
                pair = min(a, b), max(a, b)
                pairs[pair] = pairs.get(pair, 0.0) + (moments if a < b else backward(moments))
        return PhotometricEdges(
            np.array([number[a] for a, _ in pairs], np.int64),
            np.array([number[b] for _, b in pairs], np.int64),
            np.array(list(pairs.values())).reshape(-1, 3, TERMS, TERMS),
        )

    def _solve(self, order: list[int], at_the_end: bool) -> None:
        if len(order) > AT_ONCE:
            return self._solve_newest(order, at_the_end)
        exposures = np.array([self.graph.keyframes[index].image.exposure for index in order])
        known = np.where(exposures > 0.0, np.log(np.maximum(exposures, 1e-300)), np.nan)
        try:
            self.photometry = p = solve_photometry(self.edges(order), len(order), known)
        except (np.linalg.LinAlgError, ValueError) as error:
            self.stats.warn(f"exposures could not be solved for: {error}")
            return
        if p.warning:
            self.stats.warn(p.warning)
        self.graph.vignetting = p.vignetting
        lights = dict(zip(order, p.lights))
        if p.varies and not at_the_end:
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
                self._attach(index)
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

    def _attach(self, index: int) -> None:
        """The light of a new keyframe, from those it was matched with."""
        found: list[tuple[float, np.ndarray]] = []
        for a, b in self.graph.edges.of([index]):
            other, moments = b if a == index else a, self._moments[a, b][1]
            if moments is not None and other in self._lights:
                there = moments if b == index else backward(moments)
                information = 1.0 / (self.photometry.edge_sigma[0] ** 2 + 1.0 / there[:, 0, 0].mean())
                found.append((float(information), self._lights[other] + self.photometry.step(there)))
        if found:
            weights, lights = zip(*found)
            self._lights[index] = np.asarray(np.average(lights, axis=0, weights=weights))

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
