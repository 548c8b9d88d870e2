"""Whether the camera zoomed while it filmed. One focal length is used for all frames, and a zoom looks like a camera
that moves forward: it bends poses and map with hardly a residual.

So short parts of the stream are asked alone, each for the focal length that its own keyframes would rather have, and
how sure they are of it. One part may be wrong by more than it says: the matches of six keyframes of a camera that moves
straight ahead hardly mind a wrong focal length, and what they have in common decides. So two others must say the same,
or the two that do be surer, all the more where their matches do not mind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mvsgs_core.tracking.estimation.focal import FocalConfig, curvature_sigma, focal_of_all, observability
from mvsgs_core.tracking.graph import KeyframeGraph

PART = 6  # keyframes that are asked together: few, so that a part lies before a zoom or after it
PARTS = 16  # at most, spread evenly over the stream
STEPS = 30  # of their bundle adjustment: they may begin far from what they want
LEAST = 0.06  # by how much two parts differ, as a logarithm, ...
CLEAR = 3.0  # ... and by how many standard deviations, where
ALIKE = 2.0  # two other parts differ by so many in the same direction,
ALONE = 4.0  # or by how many without such; twice as many where one is not `certain` of its focal length; with
BEYOND = 0.015  # the deviation of one part that matches of a still lens have beyond what they say (measured)


@dataclass(frozen=True)
class Part:
    """What some keyframes that follow each other want."""

    frames: tuple[int, int]  # indices of the first and the last
    factor: float  # on the focal length that was used
    sigma: float  # standard deviation of its logarithm
    certain: bool  # a wrong focal length would fit its matches clearly worse


@dataclass(frozen=True)
class Zoom:
    """Of the parts that clearly differ the two that are surest of themselves, the earlier first. By how much is only
    roughly right: a part during a zoom wants too much, and the others began from a map that the zoom had bent."""

    before: Part
    after: Part

    @property
    def factor(self) -> float:
        return self.after.factor / self.before.factor

    @property
    def sigma(self) -> float:
        """Standard deviation of the factor's logarithm."""
        return float(np.hypot(_sigma(self.before), _sigma(self.after)))

    def clear(self, deviations: float) -> bool:
        return abs(float(np.log(self.factor))) > max(LEAST, deviations * self.sigma)

    def told_by(self, other: Zoom) -> bool:
        """Whether the other is in the same direction, and of two other parts."""
        apart = {self.before, self.after}.isdisjoint({other.before, other.after})
        return apart and (self.factor > 1.0) == (other.factor > 1.0)


def find_zoom(graph: KeyframeGraph, members: list[int], config: FocalConfig, threads: int) -> Zoom | None:
    """The zoom that parts of these keyframes, in their order, say there was; None where none is clear. The graph stays
    as it is."""
    members = [index for index in members if index >= 0]  # frames of this run, not of a map that it goes on with
    count = len(members) // PART
    if count < 2:
        return None
    every = [[int(index) for index in part] for part in np.array_split(np.array(members), count)]
    chosen = np.unique(np.linspace(0, count - 1, min(count, PARTS)).round().astype(int))
    wanted = [(every[n], focal_of_all(graph, every[n], threads, STEPS)) for n in chosen]
    asked = [(part, factor) for part, factor in wanted if factor is not None]
    logs = np.log([factor for _, factor in asked])
    if len(asked) < 2 or np.ptp(logs) <= LEAST:
        return None
    parts = list[Part]()
    for part, factor in asked:
        rise = observability(graph, part, config.probe, threads, factor)
        sigma = curvature_sigma(graph, part, rise, config.probe)
        parts.append(Part((part[0], part[-1]), factor, sigma, rise > config.certain))
    return clear_zoom(parts)


def clear_zoom(parts: Sequence[Part]) -> Zoom | None:
    """Between the two of these, in their order, that are surest of themselves; None where none is clear."""
    zooms = [Zoom(a, b) for a, b in combinations(parts, 2)]
    alike = [zoom for zoom in zooms if zoom.clear(ALIKE)]

    def believed(zoom: Zoom) -> bool:
        certain = zoom.before.certain and zoom.after.certain
        return zoom.clear(ALONE if certain else 2.0 * ALONE) or (zoom.clear(CLEAR) and any(map(zoom.told_by, alike)))

    return min(filter(believed, zooms), key=lambda zoom: zoom.sigma, default=None)


def _sigma(part: Part) -> float:
    return float(np.hypot(part.sigma, BEYOND))


__all__ = ["Part", "Zoom", "clear_zoom", "find_zoom"]
