"""A town of streets between rows of houses; meters, x east, y north, z up. By default 4 kilometers of one-way streets.

Streets run along a grid that is not quite regular. Each is driven in one direction, in turns east and west, north and
south; the outer ones make a ring. So whoever comes a second time sees the same: a loop.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.scene import materials
from mvsgs_core.scene.lighting import Lighting
from mvsgs_core.scene.noise import fractal, to_texture
from mvsgs_core.scene.patches import Material, Patch, transformed
from mvsgs_core.scene.townhouses import fence, kiosk, lamp, parked_car, rough, street_tree, town_house

STREETS = 6  # in either direction; even, so that the outer ones make a ring
PITCH = (72.0, 60.0)  # meters from one street to the next, west to east and south to north
HALF_WIDTH = 6.5  # of a street, from its middle to the fronts
SIDEWALK = 2.4
DEPTH = 9.0  # of a house
GROUND = 13.0  # texels a meter of the streets

LIGHTING = Lighting(
    texel=1.6,
    horizon=(0.66, 0.74, 0.84),
    zenith=(0.34, 0.48, 0.72),
    below=(0.2, 0.2, 0.18),
    to_sun=(0.45, -0.6, 0.8),
    sun=(3.4, 3.2, 2.8),
    sun_radius=0.05,
    direct_rays=16,
    bounce_rays=16,
    ambient=(0.05, 0.05, 0.05),
    gloss_at=(450.0, -600.0, 800.0),
)


@dataclass(frozen=True)
class Plan:
    """Where the streets run: x of those along y, y of those along x."""

    x: np.ndarray  # (N,) meters, ascending
    y: np.ndarray  # (M,)

    @staticmethod
    def of(seed: int, streets: int = STREETS) -> Plan:
        rng = np.random.default_rng([seed, 8])
        return Plan(*(pitch * np.arange(streets) + rng.uniform(-8.0, 8.0, streets) for pitch in PITCH))

    def at(self, node: tuple[int, int]) -> np.ndarray:
        """(2,) where street i along y crosses street j along x."""
        return np.array([self.x[node[0]], self.y[node[1]]])

    def ways(self, node: tuple[int, int]) -> list[tuple[int, int]]:
        """Crossings that the streets lead to from this one: along x, and along y."""
        i, j = node
        steps = ((i + (1 if j % 2 == 0 else -1), j), (i, j + (1 if i % 2 else -1)))
        return [(a, b) for a, b in steps if 0 <= a < len(self.x) and 0 <= b < len(self.y)]


def build(seed: int, plain: int = 0, streets: int = STREETS) -> list[Patch]:
    """Patches of the town. `plain`: quarters (0 to 4) of the houses whose fronts have no texture."""
    plan = Plan.of(seed, streets)
    rng = np.random.default_rng([seed, 9])
    low, high = (np.array([f(plan.x), f(plan.y)]) for f in (np.min, np.max))
    reach = HALF_WIDTH + 90.0
    corner, size = low - reach, high - low + 2 * reach
    far = rough(rng, (96, 104, 74), 0.25, 0.8)
    parts = [_flat((*corner, -0.08), size, far)]
    for i, j in itertools.product(range(len(plan.x)), range(len(plan.y))):
        parts += _crossing(rng, plan.at((i, j)))
        for ahead in ((i + 1, j), (i, j + 1)):
            if ahead[0] < len(plan.x) and ahead[1] < len(plan.y):
                parts += _street(rng, plan.at((i, j)), plan.at(ahead))
    for a, b, yaw in _frontages(plan):
        parts += _row(rng, a, b, yaw, plain)
    return parts


def _flat(corner: tuple[float, float, float], size: np.ndarray, material: Material) -> Patch:
    """Ground seen from above, in cells of at most 40 meters, for light and texture; `corner` south-west."""
    x, y, z = corner
    columns, rows = (max(1, int(np.ceil(s / 40.0))) for s in size)
    u, v = np.meshgrid(np.linspace(x, x + size[0], columns + 1), np.linspace(y + size[1], y, rows + 1))
    return Patch(np.stack([u, v, np.full_like(u, z)], axis=-1), material(float(size[1]), float(size[0])))


def _asphalt(rng: np.random.Generator, marks: bool) -> Material:
    """Tarmac with patches and cracks; of a street, along u: sidewalks of slabs, gutters, a broken line."""

    def paint(height: float, width: float) -> np.ndarray:
        shape = materials.shape_of(height, width, GROUND)
        tone = 92 + 13 * fractal(rng, shape, (0.3 * height, 0.3 * width), 6, 0.85)
        colors = cv2.merge([tone.astype(np.float32)] * 3)
        for _ in range(int(width * height / 40)):  # repaired
            at, size = rng.uniform(0, 1, 2) * (width, height), rng.uniform(0.4, 2.4, 2)
            _mark(colors, at, at + size, rng.uniform(60, 118))
        for _ in range(int(width * height / 9)):  # cracks
            steps = np.cumsum(rng.normal(0, 5, (rng.integers(4, 16), 2)) + rng.normal(0, 3, 2), axis=0)
            line = steps + rng.uniform(0, 1, 2) * (shape[1], shape[0])
            cv2.polylines(colors, [line.astype(np.int32)], False, (52.0,) * 3, 1, cv2.LINE_AA)
        for _ in range(int(width * height / 60)):  # lids
            center = tuple(int(c) for c in rng.uniform(0, 1, 2) * (shape[1], shape[0]))
            cv2.circle(colors, center, round(0.35 * GROUND), (rng.uniform(45, 75),) * 3, -1, cv2.LINE_AA)
        if marks:
            for start in np.arange(1.0, width - 2.0, 4.0):
                at = np.array([start + rng.normal(0, 0.1), 0.5 * height - 0.07])
                _mark(colors, at, at + np.array([2.0, 0.14]), rng.uniform(170, 230))
            for top in (0.0, height - SIDEWALK):
                _slabs(rng, colors[round(top * GROUND) : round((top + SIDEWALK) * GROUND)])
        return to_texture(colors)

    return paint


def _mark(colors: np.ndarray, low: np.ndarray, high: np.ndarray, tone: float) -> None:
    a, b = (tuple(int(c * GROUND) for c in corner) for corner in (low, high))
    cv2.rectangle(colors, a, b, (tone,) * 3, -1)


def _slabs(rng: np.random.Generator, colors: np.ndarray) -> None:
    """Paints a sidewalk of slabs over this part of a texture."""
    side = round(0.6 * GROUND)
    rows, columns = (-(-n // side) for n in colors.shape[:2])
    slabs = 150 + 16 * rng.standard_normal((rows, columns))
    tone = np.repeat(np.repeat(slabs, side, axis=0), side, axis=1)[: colors.shape[0], : colors.shape[1]]
    tone[::side], tone[:, ::side] = 96.0, 96.0
    tone += 9 * fractal(rng, tone.shape, (6, 40), 4, 0.8)
    colors[:] = tone[..., None] * np.array([1.0, 0.97, 0.92])


def _crossing(rng: np.random.Generator, center: np.ndarray) -> list[Patch]:
    size = np.full(2, 2 * HALF_WIDTH)
    return [_flat((*(center - HALF_WIDTH), 0.0), size, _asphalt(rng, False))]


def _street(rng: np.random.Generator, a: np.ndarray, b: np.ndarray) -> list[Patch]:
    """From one crossing to the next, east or north, with what stands on it."""
    length = float(np.abs(b - a).sum()) - 2 * HALF_WIDTH
    x = np.linspace(HALF_WIDTH, HALF_WIDTH + length, 3)
    u, v = np.meshgrid(x, [HALF_WIDTH, -HALF_WIDTH])
    material = _asphalt(rng, True)
    parts = [Patch(np.stack([u, v, np.zeros_like(u)], axis=-1), material(2 * HALF_WIDTH, length))]
    for side in (-1.0, 1.0):
        at = HALF_WIDTH + rng.uniform(2.0, 6.0)
        while at < HALF_WIDTH + length - 4.0:
            kind, y = rng.random(), side * (HALF_WIDTH - SIDEWALK)
            if kind < 0.4:
                parts += transformed(parked_car(rng), rng.choice([0.0, np.pi]), (at, y - side * 1.0, 0.02))
            elif kind < 0.65:
                parts += transformed(street_tree(rng, rng.uniform(0.9, 1.5)), 0.0, (at, y + side * 0.5, 0.0))
            elif kind < 0.85:
                parts += transformed(lamp(rng), rng.choice([0.0, np.pi / 2]), (at, y + side * 0.3, 0.0))
            elif kind < 0.9:
                parts += transformed(kiosk(rng), 0.0, (at, y + side * 1.1, 0.0))
            at += rng.uniform(5.0, 10.0)
    yaw = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
    return transformed(parts, yaw, (*a, 0.0))


def _frontages(plan: Plan) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Lines of fronts: from a to b (2,), so that the street is on the right, and the yaw of houses that face it.

    A house at a corner belongs to the row along x, and shows the other street its side.
    """
    lines, wider = [], np.array([-HALF_WIDTH, HALF_WIDTH])
    xs, ys = np.array([plan.x[0], plan.x[-1]]), np.array([plan.y[0], plan.y[-1]])
    for j, y in enumerate(plan.y):
        for side in (1.0, -1.0):  # houses north of the street, then south of it
            outer = (j == 0 and side < 0) or (j == len(plan.y) - 1 and side > 0)
            ends = [xs + wider] if outer else itertools.pairwise(plan.x)
            for west, east in ends:
                inset = 0.0 if outer else HALF_WIDTH
                a, b = np.array([west + inset, y + side * HALF_WIDTH]), np.array([east - inset, y + side * HALF_WIDTH])
                lines.append((a, b, 0.0) if side > 0 else (b, a, np.pi))
    for i, x in enumerate(plan.x):
        for side in (1.0, -1.0):  # houses east of the street, then west of it
            outer = (i == 0 and side < 0) or (i == len(plan.x) - 1 and side > 0)
            ends = [ys + wider] if outer else itertools.pairwise(plan.y)
            for south, north in ends:
                inset = 0.0 if outer else HALF_WIDTH + DEPTH
                a = np.array([x + side * HALF_WIDTH, south + inset])
                b = np.array([x + side * HALF_WIDTH, north - inset])
                lines.append((b, a, -np.pi / 2) if side > 0 else (a, b, np.pi / 2))
    return lines


def _row(rng: np.random.Generator, a: np.ndarray, b: np.ndarray, yaw: float, plain: int) -> list[Patch]:
    """Houses side by side from a to b, here and there a garden."""
    ahead = (b - a) / np.linalg.norm(b - a)
    length, at = float(np.linalg.norm(b - a)), 0.0
    parts: list[Patch] = []
    while at < length - 1e-6:
        left = length - at
        width = left if left < 13.0 else float(rng.uniform(6.5, min(12.5, left - 6.5)))
        bare = int(rng.integers(4)) < plain
        garden = rng.random() < 0.1 and 0.0 < at < length - width - 1e-6
        house = fence(rng, width) if garden else town_house(rng, width, DEPTH, bare)
        parts += transformed(house, yaw, (*(a + at * ahead), 0.0))
        at += width
    return parts


__all__ = ["HALF_WIDTH", "LIGHTING", "Plan", "build"]
