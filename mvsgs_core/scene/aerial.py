"""A landscape for an overflight: hills, fields, roads, a village, trees; meters, x east, y north."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from mvsgs_core.scene import materials
from mvsgs_core.scene.buildings import car, house, tree
from mvsgs_core.scene.lighting import Lighting
from mvsgs_core.scene.noise import blend, fractal, smooth, to_texture, warped
from mvsgs_core.scene.patches import Patch, box, transformed

HALF = 260.0  # half the side of the land
DENSITY = 4.4  # texels a meter of the ground
CROPS = (
    ((96, 112, 52), (128, 140, 66)),
    ((146, 128, 74), (188, 166, 104)),
    ((84, 66, 44), (122, 96, 66)),
    ((70, 100, 46), (104, 128, 58)),
    ((168, 152, 92), (206, 190, 128)),
    ((112, 120, 70), (142, 148, 90)),
)

LIGHTING = Lighting(
    texel=1.3,
    horizon=(0.62, 0.70, 0.80),
    zenith=(0.30, 0.42, 0.66),
    below=(0.2, 0.2, 0.16),
    to_sun=(0.55, -0.5, 0.75),
    sun=(5.2, 4.8, 4.2),
    sun_radius=0.012,
    bounce_rays=30,
    gloss_at=(550.0, -500.0, 750.0),
)


class Ground:
    """Height of the land, and where its roads run."""

    def __init__(self, rng: np.random.Generator) -> None:
        side = 521
        broad = smooth(rng, (side, side), (5, 5))
        fine = fractal(rng, (side, side), (16, 16), 3)
        self.heights = (9.0 * broad + 1.4 * fine).astype(np.float64)  # [row: north to south, column: west to east]
        t = np.linspace(-HALF, HALF, 131)
        bends = rng.uniform(0.8, 1.2, 4)
        self.roads = [
            np.stack([t, 18 * np.sin(0.013 * bends[0] * t + 1) + 6], axis=1),
            np.stack([22 * np.sin(0.011 * bends[1] * t) - 25, t], axis=1),
            np.stack([t, 0.35 * t + 95 + 12 * np.sin(0.02 * bends[2] * t)], axis=1),
            np.stack([t, -0.2 * t - 105 + 15 * np.sin(0.016 * bends[3] * t)], axis=1),
        ]

    def height(self, x: float, y: float) -> float:
        n = len(self.heights) - 1
        column, row = np.clip((x + HALF) / (2 * HALF), 0, 1) * n, np.clip((HALF - y) / (2 * HALF), 0, 1) * n
        i, j = min(int(row), n - 1), min(int(column), n - 1)
        a, b = row - i, column - j
        h = self.heights
        low = (1 - b) * h[i, j] + b * h[i, j + 1]
        return float((1 - a) * low + a * ((1 - b) * h[i + 1, j] + b * h[i + 1, j + 1]))

    def road_distance(self, x: float, y: float) -> float:
        """Meters to the nearest road."""
        return float(min(np.min(np.hypot(road[:, 0] - x, road[:, 1] - y)) for road in self.roads))


def build(seed: int, plain_fields: int = 0) -> list[Patch]:
    """Patches of the landscape. `plain_fields`: quarters (0 to 4) of the fields that have no texture."""
    rng = np.random.default_rng([seed, 6])
    ground = Ground(rng)
    axis = np.linspace(-HALF, HALF, 131)
    x, y = np.meshgrid(axis, axis[::-1])
    z = np.array([[ground.height(a, b) for a, b in zip(*line)] for line in zip(x, y)])
    points = np.stack([x, y, z], axis=-1)
    texture, hedges = _fields(rng, ground, plain_fields)
    return [
        Patch(points, texture),
        *_village(rng, ground),
        *_trees(rng, ground, hedges),
        *_traffic(rng, ground),
    ]


def _fields(rng: np.random.Generator, ground: Ground, plain_fields: int) -> tuple[np.ndarray, np.ndarray]:
    """The ground's texture, and points (N, 2) x, y along the borders of its fields."""
    side = round(2 * HALF * DENSITY)
    shape = (side, side)
    half, _ = materials.cells(rng, (side // 2, side // 2), 70)
    crooked = warped(half.astype(np.float32), rng, (9, 9), 10).round().astype(np.uint8)
    labels = cv2.resize(crooked, (side, side), interpolation=cv2.INTER_NEAREST)

    def of_field(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.LUT(labels, np.resize(values, 256).astype(np.float32)[None]))

    count = int(labels.max()) + 1
    crop = rng.integers(len(CROPS), size=count)
    tint = rng.normal(0, 9, (count, 3))
    angle, pitch = rng.uniform(0, np.pi, count), rng.uniform(1.2, 3.2, count)
    axis = np.arange(side, dtype=np.float32) / np.float32(DENSITY)
    bend = 2.0 * smooth(rng, shape, (14, 14))
    turns = axis[None] * of_field(np.cos(angle) / pitch) + axis[:, None] * of_field(np.sin(angle) / pitch)
    rows = np.sin(np.float32(2 * np.pi) * (turns + bend * of_field(1.0 / pitch)))
    growth = fractal(rng, shape, (40, 40), 6, 0.75)
    clods = smooth(rng, shape, (side / 2.2, side / 2.2))
    field = np.clip(0.5 + 0.25 * rows + 0.42 * growth + 0.32 * clods, -0.3, 1.4)
    low, high = (np.array([pair[k] for pair in CROPS])[crop] + tint for k in (0, 1))
    colors = cv2.merge([of_field(low[:, c]) + field * of_field(high[:, c] - low[:, c]) for c in range(3)])
    if plain_fields:
        bare = labels % 4 < plain_fields
        colors[bare] = (140, 130, 96)
    edge = np.zeros(shape, np.uint8)
    edge[1:, 1:] = (labels[1:, 1:] != labels[:-1, 1:]) | (labels[1:, 1:] != labels[1:, :-1])
    verge = cv2.dilate(edge, np.ones((5, 5), np.uint8)) > 0
    meadow = blend(np.array([(58, 78, 34), (104, 118, 60)]), 0.5 + 0.5 * growth)
    colors[verge] = meadow[verge]
    _draw_roads(rng, ground, colors)
    rows_at, columns_at = np.nonzero(edge[1:-1, 1:-1])
    return to_texture(colors), np.stack([columns_at / DENSITY - HALF, HALF - rows_at / DENSITY], axis=1)


def _draw_roads(rng: np.random.Generator, ground: Ground, colors: np.ndarray) -> None:
    shape = colors.shape[:2]
    wear = fractal(rng, shape, (130, 130), 4, 0.8)
    for k, road in enumerate(ground.roads):
        at = ((road * (1, -1) + HALF) * DENSITY).astype(np.int32)
        for width, tone, rough in ((9.0, (116, 112, 82), 16), (6.2 if k < 2 else 4.2, (104, 102, 100), 13)):
            mask = np.zeros(shape, np.uint8)
            cv2.polylines(mask, [at], False, 1, round(width * DENSITY))
            on = mask > 0
            colors[on] = np.asarray(tone, np.float32) + rough * wear[on][:, None]
        if k < 2:
            for a, b in itertools.pairwise(road):
                p, q = (((e * (1, -1) + HALF) * DENSITY).astype(int) for e in (a, a + 0.5 * (b - a)))
                cv2.line(colors, tuple(map(int, p)), tuple(map(int, q)), (226.0, 224.0, 214.0), 1, cv2.LINE_AA)


def _village(rng: np.random.Generator, ground: Ground) -> list[Patch]:
    parts: list[Patch] = []
    taken: list[tuple[float, float, float]] = []
    for k, road in enumerate(ground.roads):
        i = 2.0
        while i < len(road) - 3:
            at, ahead = road[int(i)], road[int(i) + 1] - road[int(i)]
            i += rng.uniform(2.5, 5.0) if k < 2 else rng.uniform(4.0, 12.0)
            for side in (-1.0, 1.0):
                if rng.random() < (0.25 if k < 2 else 0.55):
                    continue
                yaw = float(np.arctan2(ahead[1], ahead[0])) + (0.0 if rng.random() < 0.6 else np.pi / 2)
                yaw += rng.normal(0, 0.06)
                out = side * rng.uniform(12, 22)
                x, y = at + out * np.array([-ahead[1], ahead[0]]) / np.hypot(*ahead)
                length, width = rng.uniform(8, 20), rng.uniform(7, 11)
                reach = 0.6 * np.hypot(length, width)
                if ground.road_distance(x, y) < 0.5 * width + 5:
                    continue
                if any(np.hypot(x - a, y - b) < reach + r for a, b, r in taken):
                    continue
                taken.append((x, y, reach))
                corners = [ground.height(x + a, y + b) for a in (-5, 5) for b in (-5, 5)]
                parts += transformed(house(rng, length, width), yaw, (x, y, min(corners) - 0.4))
    return parts


def _trees(rng: np.random.Generator, ground: Ground, hedges: np.ndarray) -> list[Patch]:
    spots = [(*hedges[rng.integers(len(hedges))], rng.uniform(1.2, 3.0)) for _ in range(420)]
    for _ in range(9):
        grove = rng.uniform(-0.85 * HALF, 0.85 * HALF, 2)
        spots += [(*(grove + rng.normal(0, 11, 2)), rng.uniform(2.4, 4.6)) for _ in range(26)]
    for road in ground.roads[:2]:
        for at in road[4:-4:3]:
            spots.append((*(at + rng.normal(0, 0.5, 2) + 6.5), rng.uniform(1.8, 3.0)))
    parts: list[Patch] = []
    for x, y, radius in spots:
        if ground.road_distance(x, y) < radius + 2.5 or max(abs(x), abs(y)) > HALF - 4:
            continue
        parts += transformed(tree(rng, radius), 0.0, (x, y, ground.height(x, y)))
    return parts


def _traffic(rng: np.random.Generator, ground: Ground) -> list[Patch]:
    parts: list[Patch] = []
    for road in ground.roads[:2]:
        for i in rng.choice(np.arange(5, len(road) - 5), 16, replace=False):
            at, ahead = road[i], road[i + 1] - road[i]
            lane = rng.choice([-1.6, 1.6]) * np.array([-ahead[1], ahead[0]]) / np.hypot(*ahead)
            x, y = at + lane
            yaw = float(np.arctan2(ahead[1], ahead[0]))
            parts += transformed(car(rng), yaw, (x, y, ground.height(x, y) + 0.05))
    for _ in range(40):
        x, y = rng.uniform(-0.8 * HALF, 0.8 * HALF, 2)
        if ground.road_distance(x, y) > 9:
            bale = materials.wood(rng, (150, 122, 60), (214, 188, 112), density=14)
            low = ground.height(x, y) - 0.2
            block = box((-1.1, -0.8, 0), (1.1, 0.8, 1.5), bale)
            parts += transformed(block, rng.uniform(0, 3), (x, y, low))
    return parts
