"""The way through the town: along its one-way streets without an end, or round some blocks and back."""

from __future__ import annotations

import bisect
import itertools
from collections import Counter

import numpy as np

from mvsgs_core.scene.path import Shake, look_at
from mvsgs_core.scene.town import STREETS, Plan

Node = tuple[int, int]  # a crossing


class Route:
    """A line through crossings with rounded corners, by its arc length."""

    RADIUS = 8.0  # meters, of a turn

    def __init__(self, plan: Plan, nodes: list[Node]) -> None:
        """nodes: the first two crossings at least."""
        self.plan = plan
        self.nodes = list(nodes)
        self.ends: list[float] = []  # arc length at the end of each piece
        self._pieces: list[tuple[np.ndarray, np.ndarray, float]] = []  # start, heading, turn to the left (-1, 0, 1)
        self._taken = 0  # crossings that the pieces lead past
        self._cut = 0.0  # length of the street that the last turn has used

    @property
    def length(self) -> float:
        """Meters, up to the last corner that is known."""
        return self.ends[-1] if self.ends else 0.0

    def extend(self, node: Node) -> None:
        """Goes on to another crossing: the street to the last one is known now, and the turn there."""
        self.nodes.append(node)
        a, b, c = (self.plan.at(n) for n in self.nodes[self._taken : self._taken + 3])
        self._taken += 1
        into, out = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
        turn = float(np.round(into[0] * out[1] - into[1] * out[0]))
        cut = self.RADIUS if turn else 0.0
        self._add(a + self._cut * into, into, 0.0, float(np.linalg.norm(b - a)) - self._cut - cut)
        if turn:
            self._add(b - cut * into, into, turn, 0.5 * np.pi * self.RADIUS)
        self._cut = cut

    def _add(self, start: np.ndarray, heading: np.ndarray, turn: float, length: float) -> None:
        self._pieces.append((start, heading, turn))
        self.ends.append(self.length + length)

    def point(self, s: float) -> np.ndarray:
        """(2,) at `s` meters; before the start straight on."""
        k = min(bisect.bisect_right(self.ends, s), len(self.ends) - 1)
        start, heading, turn = self._pieces[k]
        along = s - (self.ends[k - 1] if k else 0.0)
        if not turn:
            return np.asarray(start + along * heading)
        left = turn * np.array([-heading[1], heading[0]])
        angle = along / self.RADIUS
        return np.asarray(start + self.RADIUS * (np.sin(angle) * heading + (1.0 - np.cos(angle)) * left))


class TownPath:
    """As from a car's roof: straight streets, turns, the view swinging to either side of the way."""

    SPEED = 0.25  # meters a frame, 18 km/h
    HEIGHT = 1.9
    START = 10.0  # meters past the first crossing
    SMOOTH = 2.5  # meters before and after, between which the heading lies
    SWING = np.radians(14.0)
    HABIT = 1.6  # how readily a street is driven again that has been: higher, and loops come sooner

    def __init__(self, seed: int, loop_frames: int | None = None, streets: int = STREETS) -> None:
        """loop_frames: round some blocks and back to the first pose after so many frames; None: on and on."""
        rng = np.random.default_rng([seed, 10])
        self.plan = Plan.of(seed, streets)
        self.shake = Shake(rng, 0.015, np.radians(0.25), loop_frames)
        self.loop_frames = loop_frames
        self.phases = rng.uniform(0.0, 2.0 * np.pi, 2)
        self._choices = np.random.default_rng([seed, 11])
        self._driven: Counter[tuple[Node, Node]] = Counter()
        if loop_frames is None:
            self.speed = self.SPEED
            self.route = Route(self.plan, [(1, 0), (2, 0)])
            return
        nodes = round_trip(self.plan, self.SPEED * loop_frames)
        self.route = Route(self.plan, nodes[:2])
        for node in [*nodes[2:], *nodes[:2]]:
            self.route.extend(node)
        self.lap = self.route.length - Route.RADIUS  # all of them turned, the last into the street of the first
        self.speed = self.lap / loop_frames
        for node in nodes[2:4]:
            self.route.extend(node)

    def pose(self, s: float) -> np.ndarray:
        at = self.START + self.speed * s
        step = self._point(at + self.SMOOTH) - self._point(at - self.SMOOTH)
        turn = 0.013 * s if self.loop_frames is None else 2.0 * np.pi * s / self.loop_frames
        sway = np.sin(np.array([1.0, 2.0]) * turn + self.phases)
        heading, pitch = np.arctan2(step[1], step[0]) + self.SWING * sway[0], np.radians(4.0 + 2.5 * sway[1])
        eye = np.array([*self._point(at), self.HEIGHT])
        ahead = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
        return look_at(eye, eye + ahead) @ self.shake.pose(s)

    def _point(self, at: float) -> np.ndarray:
        if self.loop_frames is not None:
            at = Route.RADIUS + (at - Route.RADIUS) % self.lap
        while self.route.length < at:
            self._go_on()
        return self.route.point(at)

    def _go_on(self) -> None:
        """Another street: one of those that was driven the least, or not quite."""
        here = self.route.nodes[-1]
        ways = self.plan.ways(here)
        tired = [self._driven[here, way] + self.HABIT * self._choices.random() for way in ways]
        way = ways[int(np.argmin(tired))]
        self._driven[here, way] += 1
        self.route.extend(way)


def round_trip(plan: Plan, length: float) -> list[Node]:
    """Corners of the round along one-way streets, once each, that is nearest to a length in meters."""
    best: tuple[float, list[Node]] | None = None
    columns, rows = len(plan.x), len(plan.y)
    for (i0, i1), (j0, j1) in itertools.product(*(itertools.combinations(range(n), 2) for n in (columns, rows))):
        # To the left: south side east, east side north, north side west, west side south; to the right: all the others.
        left = j0 % 2 == 0 and i1 % 2 == 1 and j1 % 2 == 1 and i0 % 2 == 0
        right = j0 % 2 == 1 and i1 % 2 == 0 and j1 % 2 == 0 and i0 % 2 == 1
        if not (left or right):
            continue
        around = 2.0 * (plan.x[i1] - plan.x[i0] + plan.y[j1] - plan.y[j0])
        corners = [(i0, j0), (i1, j0), (i1, j1), (i0, j1)]
        nodes = corners if left else [corners[0], *corners[:0:-1]]
        if best is None or abs(around - length) < best[0]:
            best = abs(around - length), nodes
    assert best is not None  # the ring is one
    return best[1]


__all__ = ["Route", "TownPath", "round_trip"]
