"""Whether the camera zoomed while it filmed. One focal length is used for all frames, and a zoom looks like a camera
that moves forward: it bends poses and map with hardly a residual.

So short parts of the stream are asked alone, each for the focal length that its own keyframes would rather have, and
how sure they are of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mvsgs_core.tracking.estimation.focal import curvature_sigma, focal_of_all, observability
from mvsgs_core.tracking.graph import KeyframeGraph

PART = 6  # keyframes that are asked together: few, so that a part lies before a zoom or after it
PARTS = 16  # at most, spread evenly over the stream
STEPS = 30  # of their bundle adjustment: they may begin far from what they want
LEAST = 0.06  # by how much two parts differ, as a logarithm, ...
CLEAR = 3.0  # ... and by how many standard deviations, with
ALIKE = 0.015  # the deviation of one part that matches of a still lens have beyond what they say (measured)
# By how many where one part alone differs from the others. It may be wrong by itself: six keyframes of a camera that
# moves straight ahead were by 3.2, and those of a video whose wrong timestamps hide how long its shutter rolls.
ALONE = 3.5


@dataclass(frozen=True)
class Part:
    """What some keyframes that follow each other want."""

    frames: tuple[int, int]  # indices of the first and the last
    factor: float  # on the focal length that was used
    sigma: float  # standard deviation of its logarithm


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


def find_zoom(graph: KeyframeGraph, members: list[int], probe: float, threads: int) -> Zoom | None:
    """The zoom that parts of these keyframes, in their order, say there was; None where none is clear. The graph stays
    as it is. probe: fraction by which a focal length is made wrong to see how sure a part is."""
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
        rise = observability(graph, part, probe, threads, factor)
        parts.append(Part((part[0], part[-1]), factor, curvature_sigma(graph, part, rise, probe)))
    zooms = [Zoom(a, b) for a, b in combinations(parts, 2)]
    return surest([zoom for zoom in zooms if zoom.clear(CLEAR)])


def surest(zooms: Sequence[Zoom]) -> Zoom | None:
    """Of those that are clear by `CLEAR`; by `ALONE` where one part is in all of them."""
    if zooms and set.intersection(*({zoom.before, zoom.after} for zoom in zooms)):
        zooms = [zoom for zoom in zooms if zoom.clear(ALONE)]
    return min(zooms, key=lambda zoom: zoom.sigma, default=None)


def _sigma(part: Part) -> float:
    return float(np.hypot(part.sigma, ALIKE))


__all__ = ["Part", "Zoom", "find_zoom"]
