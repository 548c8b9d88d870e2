"""How much the lens bends, beside a focal length that nobody gave: the radial distortion k1, as far as matches tell.

Distorted = x (1 + k1 r²), x the point on the plane at distance 1 and r its distance from the axis (Brown 1971). A
pinhole's focal length makes up for it, about 1.5 % for each 0.01, so that how little is known of k1 is most of how
little is known of the focal length.

Errors are measured in pixels of the image as it was taken: in those of the straightened image they shrink where it
shrinks, and a lens that bends fits any noise better (exact matches with 0.3 pixels of noise: k1 of 0.02).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import camera
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solution, Solver, adjust
from mvsgs_core.tracking.graph import KeyframeGraph

# Matches that count as one: points of an image share its lens, shutter and pose, and err together. So many make the
# curvature's deviation that of what was found on hand-held sequences whose focal length is known.
TOGETHER = 64
REACH = 9  # pixels from a match that its window and gradients see (lucas_kanade.cpp)
COMMON = 0.045  # standard deviation of k1 among lenses that people film with (`bench.lenses`)
SLOPE = 1.5  # of the logarithm of the focal length over k1, where it can't be measured
STEP = 0.04  # of k1, between the three that the cost is solved for
PASSES = 6  # at most: a lens that bends much is looked for around where it was found


@dataclass(frozen=True)
class Radial:
    """What the matches say together with what lenses are like."""

    k1: float
    k1_sigma: float
    focal_factor: float  # on the problem's focal length, with this k1
    slope: float  # of the logarithm of the focal length over k1

    @property
    def error(self) -> float:
        """Root of the mean square by which the problem's focal length is off for want of k1, as a fraction."""
        return float(np.hypot(np.log(self.focal_factor), self.slope * self.k1_sigma))

    @property
    def clear(self) -> bool:
        """Whether the lens does bend."""
        return abs(self.k1) > 2.0 * self.k1_sigma


def lens_problem(graph: KeyframeGraph, members: Sequence[int]) -> Graph:
    """The adjustment of these keyframes that tells of the lens: by matches whose windows see nothing but the image.

    Beyond its border they see the border repeated, which holds matches back, by 0.08 pixels on the synthetic room, in
    the very part of the image that tells most of the lens.
    """
    problem = graph.problem(members, graph.but_first(members), set(members))
    height, width = graph.keyframes[members[0]].image.size
    inside = _inside(problem.pixels, height, width)[problem.source] & _inside(problem.target, height, width)
    return replace(problem, information=problem.information * inside[:, None])


def straightened(problem: Graph, k1: float) -> Graph:
    """The same matches through a lens without distortion, their errors still in pixels of the image as it was taken."""
    pixels, targets = (_straight(at, problem.intrinsics, k1) for at in (problem.pixels, problem.target))
    x, y = _rays(targets, problem.intrinsics)
    bent = 1.0 + k1 * (x * x + y * y)
    # How a pixel of the image as it was taken moves with one of the straightened image: [[a, b], [b, c]].
    a, b, c = bent + 2.0 * k1 * x * x, 2.0 * k1 * x * y, bent + 2.0 * k1 * y * y
    xx, xy, yy = (problem.information[:, n] for n in (0, 1, 2))
    ax, ay, bx, by = xx * a + xy * b, xy * a + yy * b, xx * b + xy * c, xy * b + yy * c
    information = np.stack([a * ax + b * ay, b * ax + c * ay, b * bx + c * by], axis=1)
    return replace(problem, pixels=pixels, target=targets, information=information)


def estimate_radial(problem: Graph, threads: int) -> Radial:
    """k1 and the focal length that goes with it. `problem` is for a pinhole camera; where it can't be solved, what is
    known is what lenses are like.

    Two things make k1 uncertain: chance, and that nobody knows whether errors are as large in all of the image as it
    was taken or as it should be. Between the two the cost differs by 4 k1 r² of itself; half of that is the deviation.
    """
    solver = Solver(steps=20, robust_scale=1.0, tolerance=1e-5, threads=threads).reaching(problem)
    first = adjust(replace(problem, free_focal=True), solver)
    matches = int(np.count_nonzero(problem.information[:, 0]))
    radial = Radial(0.0, COMMON, 1.0, SLOPE)
    if first.failure or matches == 0:
        return radial
    pinhole = _with(problem, first)  # its focal length is what radii are measured with, whatever the true one is
    x, y = _rays(pinhole.target, pinhole.intrinsics)
    spread = float(np.mean((x * x + y * y)[pinhole.information[:, 0] > 0]))  # of r²
    center, start = 0.0, replace(first, focal_factor=1.0)
    for _ in range(PASSES):
        tried = center + STEP * np.array([-1.0, 0.0, 1.0])
        solutions = [_solved(straightened(pinhole, float(k1)), start, solver) for k1 in tried]
        if any(s.failure or s.cost <= 0.0 for s in solutions):
            break
        costs = np.array([s.cost for s in solutions]) / solutions[1].cost
        bend, slope_of_cost, _ = np.polyfit(tried - center, costs, 2)
        if bend > 0.0:
            chance, where = TOGETHER / (matches * bend), spread / bend
            informed = COMMON**2 / (COMMON**2 + chance + where**2)  # the rest is what lenses are like
            k1 = float(informed * (center - 0.5 * slope_of_cost / bend))
            log_focal = np.polyfit(tried, np.log([s.focal_factor for s in solutions]), 1)
            factor, slope = float(np.exp(np.polyval(log_focal, k1))), float(log_focal[0])
            sigma = COMMON * float(1.0 - informed) ** 0.5
            radial = Radial(k1 * factor**2, sigma * factor**2, first.focal_factor * factor, slope / factor**2)
            if abs(k1 - center) < STEP:
                break
        else:  # far from the least cost, or there is none
            k1 = float(tried[np.argmin(costs)])
            unlikely = (k1**2 - center**2) / COMMON**2
            if (1.0 - costs.min()) * matches / TOGETHER <= unlikely or k1 == center:
                break
        start = solutions[int(np.argmin(np.abs(tried - k1)))]
        center = float(np.clip(k1, center - 2.0 * STEP, center + 2.0 * STEP))
    return radial


def _solved(problem: Graph, start: Solution, solver: Solver) -> Solution:
    """With a free focal length, from where another one was solved; its factor is on the problem's focal length."""
    solution = adjust(replace(_with(problem, start), free_focal=True), solver)
    return replace(solution, focal_factor=start.focal_factor * solution.focal_factor)


def _with(problem: Graph, solution: Solution) -> Graph:
    """The problem from where it was solved."""
    factor = solution.focal_factor
    intrinsics = problem.intrinsics * [factor, factor, 1.0, 1.0]
    poses, depths = solution.cam_from_world, solution.inverse_depth
    return replace(problem, cam_from_world=poses, inverse_depth=depths, intrinsics=intrinsics)


def _inside(at: np.ndarray, height: int, width: int) -> np.ndarray:
    """(N, M) bool of pixels (N, 2, M): whether all that a match sees is in the image."""
    u, v = at[:, 0], at[:, 1]
    return (u >= REACH) & (v >= REACH) & (u <= width - 1 - REACH) & (v <= height - 1 - REACH)


def _rays(at: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y (N, M) on the plane at distance 1 of pixels (N, 2, M)."""
    fx, fy, cx, cy = intrinsics
    return (at[:, 0] - cx) / fx, (at[:, 1] - cy) / fy


def _straight(at: np.ndarray, intrinsics: np.ndarray, k1: float) -> np.ndarray:
    """Where pixels (N, 2, M) would be without distortion."""
    fx, fy, cx, cy = intrinsics
    x, y = camera.straightened(*_rays(at, intrinsics), k1)
    return np.stack([fx * x + cx, fy * y + cy], axis=1)


__all__ = ["Radial", "estimate_radial", "lens_problem", "straightened"]
