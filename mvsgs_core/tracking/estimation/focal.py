"""The focal length where it was only guessed: an unknown of initialization and bundle adjustment until it is certain.

Turning makes it observable: a camera that only shifts gives the same images with every focal length and depths scaled
to match. So what is found is believed where a focal length that is off by some percent fits the matches clearly worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core.setting_ranges import at_least
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, adjust
from mvsgs_core.tracking.estimation.radial import TOGETHER
from mvsgs_core.tracking.estimation.structure_from_motion import Reconstruction, ReconstructionCriteria, reconstructing
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.steps import Steps

# Parts of the keyframes, in their order, each of which is asked alone where it has the least number of keyframes; more
# than the fewest where each has enough.
FEWEST, MOST, LEAST, ENOUGH = 3, 6, 4, 12
# Standard deviations that 95 % lie within: the normal distribution's, and Student's by the number of parts.
NORMAL, STUDENT = 1.96, {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57}


@dataclass(frozen=True)
class FocalConfig:
    factors: tuple[float, ...] = (1.0, 1.35, 0.75, 1.8, 0.55)  # on the guess: 100 to 40 degrees around one of 65
    bounds: tuple[float, float] = (0.35, 3.0)  # on the guess: what lies outside is no solution
    min_keyframes: int = 12  # before anything is certain
    max_keyframes: int = 30  # that wait for it
    probe: float = 0.1  # fraction by which the focal length is made wrong ...
    certain: float = 0.03  # ... and that of the cost which it must then rise by to be certain,
    usable: float = 0.002  # or, at the limit, to be better than the guess
    doubt: float = 0.03  # standard deviation, as a fraction, above which it is warned of
    drift: float = 0.01  # fraction by which the whole stream may contradict what was used, beyond its own uncertainty

    def __post_init__(self) -> None:
        at_least(self, min_keyframes=2, max_keyframes=2, certain=0, usable=0, doubt=0, drift=0)
        if not self.factors or not all(factor > 0 for factor in self.factors):
            raise ValueError(f"factors={self.factors}: one at least, each above 0")
        if not 0 < self.bounds[0] < self.bounds[1]:
            raise ValueError(f"bounds={self.bounds}: the lower one above 0, and below the upper one")
        if not 0 < self.probe < 1:
            raise ValueError(f"probe={self.probe}: must be above 0 and below 1")


def reconstructing_with_unknown_focal(
    graph: KeyframeGraph,
    order: list[int],
    criteria: ReconstructionCriteria,
    config: FocalConfig,
    guess: np.ndarray,
    threads: int,
) -> Steps[Reconstruction]:
    """`reconstructing` from several focal lengths, each then free; the lowest cost wins and is written to the graph.

    In steps, between which the graph has the focal length that it had. guess: intrinsics (4,) that came with the
    frames; what the graph has may be far off, from another part of the map.
    """
    criteria = replace(criteria, certain_cost=0.0)  # with a free focal length, a wrong start can be cheap too
    best: tuple[Reconstruction, np.ndarray] | None = None
    failed: Reconstruction | None = None
    for factor in config.factors:
        tried = guess * [factor, factor, 1.0, 1.0]
        start = yield from _with_intrinsics(graph, tried, reconstructing(graph, order, criteria, threads, True))
        if not start.failure and not config.bounds[0] < factor * start.focal_factor < config.bounds[1]:
            start = replace(
                start, failure=f"no focal length in a sensible range: {factor * start.focal_factor:.2f} times the guess"
            )
        if start.failure:
            failed = failed or start
        elif best is None or start.cost < best[0].cost:
            best = start, tried * [start.focal_factor, start.focal_factor, 1.0, 1.0]
    if best is None:
        assert failed is not None
        return failed
    graph.intrinsics = best[1]
    return best[0]


def _with_intrinsics(
    graph: KeyframeGraph, intrinsics: np.ndarray, steps: Steps[Reconstruction]
) -> Steps[Reconstruction]:
    """The same steps, each with other intrinsics (4,) of the graph."""
    before = graph.intrinsics
    while True:
        graph.intrinsics = intrinsics
        try:
            next(steps)
        except StopIteration as end:
            found: Reconstruction = end.value
            return found
        finally:
            graph.intrinsics = before
        yield


def refine_focal(graph: KeyframeGraph, members: list[int], threads: int) -> str:
    """Bundle adjustment of these keyframes with the focal length; returns why it failed, or nothing."""
    solver = Solver(steps=15, robust_scale=1.0, tolerance=1e-4, threads=threads)
    return graph.optimize(members, graph.but_first(members), set(members), solver, free_focal=True).failure


def observability(graph: KeyframeGraph, members: list[int], probe: float, threads: int, factor: float = 1.0) -> float:
    """Fraction by which the cost rises where the focal length is wrong by `probe`, the rest adjusted to it; the graph
    stays as it is. The lesser of both directions. factor: on the graph's focal length, what is taken for right."""
    problem = graph.problem(members, graph.but_first(members), set(members))
    problem.intrinsics = problem.intrinsics * [factor, factor, 1.0, 1.0]
    solver = Solver(steps=10, robust_scale=1.0, tolerance=1e-4, threads=threads).reaching(problem)
    here = adjust(problem, solver)
    rises = []
    for off in (1.0 - probe, 1.0 / (1.0 - probe)):
        wrong = replace(problem, intrinsics=problem.intrinsics * [off, off, 1.0, 1.0])
        solution = adjust(wrong, solver)
        if here.failure or solution.failure or here.cost <= 0.0:
            return 0.0
        rises.append(solution.cost / here.cost - 1.0)
    return min(rises)


def focal_of_all(graph: KeyframeGraph, members: list[int], threads: int, steps: int = 10) -> float | None:
    """Factor on the focal length that all these keyframes would rather have; None where they can't tell."""
    problem = replace(graph.problem(members, graph.but_first(members), set(members)), free_focal=True)
    solver = Solver(steps=steps, robust_scale=1.0, tolerance=1e-4, threads=threads).reaching(problem)
    solution = adjust(problem, solver)
    return None if solution.failure else solution.focal_factor


def curvature_sigma(graph: KeyframeGraph, members: list[int], rise: float, probe: float) -> float:
    """Standard deviation of the focal length, as a fraction, from the curvature of the cost alone, with matches of the
    same images that err together; infinite where there is none. rise: see `observability`."""
    matches = sum(graph.edges[a, b].matches for a, b in graph.edges if {a, b} <= set(members))
    if rise <= 0.0 or matches == 0:
        return float("inf")
    return TOGETHER**0.5 * probe / float(np.sqrt(matches * rise))


@dataclass(frozen=True)
class Uncertainty:
    """Of the logarithm of a focal length that keyframes give a pinhole camera; what the lens adds is in radial.py."""

    curvature: float  # standard deviation from the curvature of the cost; infinite where they don't tell
    spread: float = 0.0  # that from how far parts of the keyframes, each alone, disagree
    parts: int = 0  # that could be asked

    @property
    def sigma(self) -> float:
        """Standard deviation: as a fraction, nearly."""
        return float(np.hypot(self.curvature, self.spread))

    @property
    def interval(self) -> float:
        """Half of the interval in which the truth lies with 95 %: a spread of few is itself uncertain. Infinite where
        fewer than two parts could be asked: what errs in all matches alike is then not seen."""
        if self.parts not in STUDENT:
            return float("inf")
        return float(np.hypot(NORMAL * self.curvature, STUDENT[self.parts] * self.spread))


def uncertainty(
    graph: KeyframeGraph, members: list[int], rise: float, probe: float, threads: int, factor: float = 1.0
) -> Uncertainty:
    """That of the focal length that these keyframes give.

    rise: their `observability`. factor: what they give, on the graph's focal length.
    """
    curvature = curvature_sigma(graph, members, rise, probe)
    if curvature == float("inf"):
        return Uncertainty(curvature)
    found, weights = [], []
    for part in np.array_split(np.array(members), min(MOST, max(FEWEST, len(members) // ENOUGH))):
        if len(part) < LEAST:
            continue
        part_rise = observability(graph, part.tolist(), probe, threads, factor)
        own = focal_of_all(graph, part.tolist(), threads)
        if own is not None and part_rise > 0.0:
            found.append(float(np.log(own)))
            weights.append(part_rise)
    if len(found) < 2:
        return Uncertainty(curvature)
    logs, fractions = np.array(found), np.array(weights) / sum(weights)
    spread = float(np.sqrt(fractions @ np.square(logs - fractions @ logs) / (len(logs) - 1)))
    return Uncertainty(curvature, spread, len(logs))


__all__ = [
    "FocalConfig",
    "Uncertainty",
    "curvature_sigma",
    "focal_of_all",
    "observability",
    "reconstructing_with_unknown_focal",
    "refine_focal",
    "uncertainty",
]
