"""What stands along the streets of the town: houses in rows, shops, lamps, railings; meters, fronts to -y, z up."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.scene import materials, prints
from mvsgs_core.scene.buildings import ROOFS, WALLS
from mvsgs_core.scene.noise import blend, fractal, to_texture
from mvsgs_core.scene.patches import Material, Patch, blob, box, cylinder, quad, surface

DENSITY = 15.0  # texels a meter of a front: a pixel of a 320 wide image, from across the street
SIDE = 6.0  # of what is seen from aslant or above


def rough(rng: np.random.Generator, color: materials.RGB, contrast: float = 0.16, density: float = SIDE) -> Material:
    """Stains over grain: the paint of most of a town, at a hundredth of the time of finer ones."""

    def paint(height: float, width: float) -> np.ndarray:
        shape = materials.shape_of(height, width, density)
        shade = 1.0 + contrast * fractal(rng, shape, (0.6 * height, 0.6 * width), 4, 0.85)
        return to_texture(np.asarray(color, np.float32) * shade[..., None])

    return paint


def front(rng: np.random.Generator, shop: bool, plain: bool = False) -> Material:
    """A front: plaster or brick, windows of one kind a house in uneven columns, curtains, a door; a shop has a sign."""
    color = np.array(WALLS[rng.integers(len(WALLS))]) * rng.uniform(0.75, 1.05)

    def paint(height: float, width: float) -> np.ndarray:
        if plain:
            return np.tile(color.astype(np.uint8), (4, 4, 1))
        colors = _wall(rng, color, height, width)
        columns, storey = max(1, round(width / rng.uniform(1.9, 2.9))), 2.9
        w, h, sill = rng.uniform(0.42, 0.62), rng.uniform(0.6, 0.85), rng.uniform(0.08, 0.2)
        frame = rng.uniform(150, 250) * np.array([1.0, 0.98, 0.94])
        door = int(rng.integers(columns))
        for floor in range(int(height / storey)):
            for column in range(columns):
                x = (column + 0.5 + rng.normal(0, 0.03)) * width / columns
                if floor == 0 and column == door:
                    _door(rng, colors, x, height)
                elif floor > 0 or not shop:
                    _window(rng, colors, x, height - storey * floor - 1.65, w, h, sill, frame)
        if shop:
            _shop(rng, colors, height, width, door * width / columns)
        return to_texture(colors)

    return paint


def _wall(rng: np.random.Generator, color: np.ndarray, height: float, width: float) -> np.ndarray:
    """Stains that run down, patches of another tone, rough plaster or courses of brick."""
    shape = materials.shape_of(height, width, DENSITY)
    stain = fractal(rng, shape, (0.4 * height, 1.2 * width), 5, 0.75)
    rough = fractal(rng, shape, (height * 3.5, width * 3.5), 2, 0.9)
    if rng.random() < 0.4:
        y = np.arange(shape[0])[:, None] // max(2, round(rng.uniform(0.16, 0.3) * DENSITY))
        x = (np.arange(shape[1])[None] + 4 * (y % 2)) // 8
        rough = rough + 1.1 * rng.uniform(-1, 1, (int(y.max()) + 1, int(x.max()) + 1))[y, x]
    shade = 1.0 + 0.1 * stain + 0.07 * rough
    return np.asarray((color[None, None] * shade[..., None]).astype(np.float32))


def _rectangle(colors: np.ndarray, x0: float, y0: float, x1: float, y1: float, ink: np.ndarray) -> None:
    """Filled, in meters from the upper left."""
    low, high = ((round(x * DENSITY), round(y * DENSITY)) for x, y in ((x0, y0), (x1, y1)))
    cv2.rectangle(colors, low, high, [float(c) for c in ink], -1)


def _window(
    rng: np.random.Generator, colors: np.ndarray, x: float, y: float, w: float, h: float, sill: float, frame: np.ndarray
) -> None:
    glass = rng.uniform(25, 90) * np.array([0.85, 0.95, 1.05])
    _rectangle(colors, x - w - sill, y - h - sill, x + w + sill, y + h + 1.5 * sill, frame)
    _rectangle(colors, x - w, y - h, x + w, y + h, glass)
    if rng.random() < 0.6:  # a curtain, drawn so far
        cloth = prints.random_color(rng, (0.05, 0.6), (0.5, 0.95))
        side, wide = rng.choice([-1.0, 1.0]), rng.uniform(0.3, 1.3) * w
        _rectangle(colors, x + side * w, y - h, x + side * (w - wide), y + h * rng.uniform(0.2, 1.0), cloth)
    if rng.random() < 0.35:  # shutters
        tone = prints.random_color(rng, (0.2, 0.6), (0.25, 0.6))
        for side in (-1.0, 1.0):
            _rectangle(colors, x + side * (w + 0.05), y - h, x + side * (1.9 * w + 0.05), y + h, tone)
    _rectangle(colors, x - 0.04, y - h, x + 0.04, y + h, frame)
    if rng.random() < 0.5:
        _rectangle(colors, x - w, y - 0.2 * h, x + w, y - 0.2 * h + 0.06, frame)


def _door(rng: np.random.Generator, colors: np.ndarray, x: float, height: float) -> None:
    tone = prints.random_color(rng, (0.3, 0.8), (0.2, 0.6))
    _rectangle(colors, x - 0.75, height - 2.6, x + 0.75, height, 0.5 * tone + 90)
    _rectangle(colors, x - 0.55, height - 2.35, x + 0.55, height, tone)
    _rectangle(colors, x - 0.3, height - 2.1, x + 0.3, height - 1.4, 0.4 * tone)


def _shop(rng: np.random.Generator, colors: np.ndarray, height: float, width: float, door: float) -> None:
    """Panes with goods in them, and a sign of letters over all."""
    x = 0.5
    while x < width - 2.2:
        wide = rng.uniform(1.6, 2.8)
        if abs(x + wide / 2 - door) > wide / 2 + 0.8:
            _rectangle(colors, x, height - 2.5, min(x + wide, width - 0.4), height - 0.6, rng.uniform(30, 70, 3))
            for _ in range(int(5 * wide)):
                u, v = rng.uniform((x, height - 1.6), (min(x + wide, width - 0.4) - 0.3, height - 0.7))
                w, h = rng.uniform(0.1, 0.45, 2)
                _rectangle(colors, u, v, u + w, v + h, prints.random_color(rng, (0.1, 0.9), (0.2, 1.0)))
        x += wide + 0.3
    ground, ink = prints.random_color(rng, (0.3, 0.9), (0.2, 0.7)), rng.uniform(180, 255, 3)
    left, right = rng.uniform(0.3, 0.25 * width), rng.uniform(0.75 * width, width - 0.3)
    _rectangle(colors, left, height - 3.3, right, height - 2.65, ground)
    x = left + 0.3
    while x < right - 0.5:
        for _ in range(3):  # a letter: strokes
            a, b = rng.uniform((x, height - 3.2), (x + 0.3, height - 2.75), (2, 2)) * DENSITY
            cv2.line(colors, tuple(map(int, a)), tuple(map(int, b)), [float(c) for c in ink], 2)
        x += rng.choice([0.38, 0.42, 0.75])


def town_house(rng: np.random.Generator, width: float, depth: float, plain: bool = False) -> list[Patch]:
    """A house in a row: 0 to `width` along x, its front at y = 0; some with a bay, a balcony or an awning."""
    shop = rng.random() < 0.3
    eaves = rng.uniform(5.9, 11.5)
    ridge, middle = eaves + rng.uniform(1.8, 3.2), 0.5 * depth
    low, high = ROOFS[rng.integers(len(ROOFS))]
    wall = WALLS[rng.integers(len(WALLS))]
    parts = [surface(quad((0, 0, eaves), (width, 0, 0), (0, 0, -eaves)), front(rng, shop, plain))]
    sides = rough(rng, wall)
    for x, along in ((0.0, -1.0), (width, 1.0)):  # seen over a lower neighbor, or across a gap; and its gable
        start = (x, middle - along * middle, eaves)
        parts.append(surface(quad(start, (0, along * depth, 0), (0, 0, -eaves)), sides))
        base = [(x, middle - along * middle, eaves), (x, middle + along * middle, eaves)]
        parts.append(surface(np.array([[(x, middle, ridge)] * 2, base]), sides))
    parts.append(surface(quad((-0.1, middle, ridge), (width + 0.2, 0, 0), (0, -middle - 0.4, eaves - ridge - 0.2)),
                         _tiles(rng, low, high), two_sided=True))  # fmt: skip
    parts.append(Patch(quad((width, depth, ridge), (-width, 0, 0), (0, 0, -ridge)), np.full((4, 4, 3), 150, np.uint8)))
    at = rng.uniform(0.15, 0.75) * width
    brick = rough(rng, (140, 84, 66), 0.3)
    parts += box((at, middle - 0.9, ridge - 1.2), (at + 0.9, middle - 0.1, ridge + 1.1), brick, skip=("bottom", "back"))
    return parts + _before_front(rng, width, shop)


def _tiles(rng: np.random.Generator, low: tuple[int, int, int], high: tuple[int, int, int]) -> Material:
    def paint(height: float, width: float) -> np.ndarray:
        shape = materials.shape_of(height, width, SIDE)
        rows = 0.3 * np.sin(np.arange(shape[0]) * 2 * np.pi / 3.3)[:, None]
        moss = fractal(rng, shape, (0.7 * height, 0.7 * width), 5, 0.8)
        return to_texture(blend(np.array([low, high]), 0.5 + 0.4 * moss + rows))

    return paint


def _before_front(rng: np.random.Generator, width: float, shop: bool) -> list[Patch]:
    """What stands out of a front and hides part of it: depth where a wall has none."""
    if shop:
        stripe = materials.fabric(rng, prints.random_color(rng, (0.4, 0.9), (0.4, 0.9)), (235, 230, 220), density=9)
        return [surface(quad((0.4, -0.02, 3.4), (width - 0.8, 0, 0), (0, -1.3, -0.7)), stripe, two_sided=True)]
    kind, x = rng.random(), rng.uniform(0.5, width - 2.8)
    if kind < 0.3:
        bay = front(rng, False)
        return box((x, -0.9, 3.0), (x + 2.2, 0, 5.8), bay, skip=("back",))
    if kind < 0.6:
        rail = rough(rng, (104, 96, 88), 0.4, 10)
        return box((x, -0.8, 3.1), (x + 2.4, 0, 3.9), rail, skip=("back",))
    if kind < 0.8:
        step = rough(rng, (150, 146, 138), 0.2, 9)
        return box((x, -0.7, 0), (x + 1.5, 0, 0.45), step, skip=("back", "bottom"))
    return []


def lamp(rng: np.random.Generator) -> list[Patch]:
    """A post with a lantern and a notice on it."""
    iron, notice = materials.plain((52, 60, 58)), rough(rng, prints.random_color(rng, (0.2, 0.9), (0.5, 1)), 0.6, 14)
    return [
        *cylinder((0, 0, 0), 0.09, 4.4, iron, segments=6)[:1],
        *box((-0.22, -0.22, 4.4), (0.22, 0.22, 5.0), materials.plain((230, 226, 200)), skip=()),
        surface(quad((-0.3, -0.12, 2.3), (0.6, 0, 0), (0, 0, -0.8)), notice, two_sided=True),
    ]


def kiosk(rng: np.random.Generator) -> list[Patch]:
    """A column with posters on it."""
    wood = rough(rng, (120, 108, 96), 0.3, 16)

    def posters(height: float, width: float) -> np.ndarray:
        colors = wood(height, width).astype(np.float32)
        for _ in range(9):
            x, y, w, h = rng.uniform((0, 0, 0.4, 0.5), (width - 0.4, height - 0.5, 1.1, 1.4))
            _rectangle(colors, x, y, x + w, y + h, prints.random_color(rng, (0.2, 0.9), (0.4, 1.0)))
            for line in np.arange(y + 0.1, y + h - 0.1, 0.16):
                _rectangle(colors, x + 0.1, line, x + rng.uniform(0.2, 0.9) * w, line + 0.06, rng.uniform(0, 255, 3))
        return to_texture(colors)

    column = cylinder((0, 0, 0), 0.7, 2.9, posters, segments=10)[:1]
    return [*column, *cylinder((0, 0, 2.9), 0.85, 0.3, wood, segments=10)]


def street_tree(rng: np.random.Generator, radius: float) -> list[Patch]:
    """A crown of two lobes on a trunk."""
    leaves = rough(rng, np.array([62.0, 88.0, 38.0]) * rng.uniform(0.7, 1.3) + rng.normal(0, 9, 3), 0.6, 9)
    trunk = cylinder((0, 0, 0), 0.13, 1.6 * radius, materials.plain((70, 54, 40)), segments=5)[:1]
    lobe, lift, size = rng.normal(0, 0.35 * radius, 2), 2.2 * radius, 0.65 * radius
    crown = blob((0, 0, lift), (radius,) * 3, leaves, bumps=0.1, rng=rng, rows=6, columns=9)
    top = blob((*lobe, lift + 0.6 * radius), (size,) * 3, leaves, bumps=0.1, rng=rng, rows=4, columns=7)
    return [*trunk, crown, top]


def parked_car(rng: np.random.Generator) -> list[Patch]:
    """A car heading along x, with wheels and windows."""
    color = prints.random_color(rng, (0.1, 0.8), (0.2, 0.95))
    skin, glass = rough(rng, color, 0.08, 8), materials.plain((44, 52, 60))

    def body(height: float, width: float) -> np.ndarray:
        texture = skin(height, width)
        if width > 3.0:
            for x in (0.8, 3.4):
                at = round(x / 4.2 * texture.shape[1]), texture.shape[0] - 1
                cv2.circle(texture, at, round(0.33 * 8), (30, 30, 32), -1)
            cv2.line(texture, (0, 1), (texture.shape[1], 1), [int(0.6 * c) for c in color], 1)
        return texture

    return [
        *box((-2.1, -0.85, 0.1), (2.1, 0.85, 0.95), body),
        *box((-1.3, -0.75, 0.95), (1.0, 0.75, 1.5), glass, skip=("bottom", "top")),
        surface(quad((-1.3, 0.75, 1.51), (2.3, 0, 0), (0, -1.5, 0)), skin),
    ]


def fence(rng: np.random.Generator, width: float) -> list[Patch]:
    """A garden wall with a hedge behind it, along x."""
    stone = rough(rng, (160, 150, 134), 0.3, 9)
    green = np.array([58.0, 84.0, 40.0]) * rng.uniform(0.8, 1.3)
    leaves = rough(rng, green, 0.5)
    return [
        *box((0, 0, 0), (width, 0.3, rng.uniform(0.7, 1.2)), stone, skip=("bottom", "back")),
        *box((0, 0.6, 0), (width, 1.6, rng.uniform(1.6, 2.6)), leaves, skip=("bottom", "back")),
    ]
