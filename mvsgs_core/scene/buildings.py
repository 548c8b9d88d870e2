"""What stands in the landscape: houses, trees, cars; each at the origin on z = 0, meters."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.scene import materials, prints
from mvsgs_core.scene.noise import fractal, to_texture
from mvsgs_core.scene.patches import Material, Patch, blob, box, cylinder, quad, surface

ROOFS = (
    ((120, 52, 36), (176, 92, 64)),
    ((92, 48, 40), (150, 84, 70)),
    ((66, 66, 72), (112, 112, 118)),
    ((140, 80, 52), (194, 124, 86)),
    ((82, 62, 52), (128, 100, 84)),
)
WALLS = ((216, 206, 184), (196, 178, 146), (226, 220, 208), (178, 120, 92), (200, 190, 170), (188, 196, 196))


def facade(rng: np.random.Generator, color: tuple[int, int, int], density: float = 9.0) -> Material:
    """A wall with windows in uneven rows, doors, stains."""

    def paint(height: float, width: float) -> np.ndarray:
        shape = materials.shape_of(height, width, density)
        stain = fractal(rng, shape, (height, width), 5, 0.7)
        colors = np.asarray(color, np.float32) * (1.0 + 0.09 * stain)[..., None]
        columns = max(1, int(width / rng.uniform(2.0, 3.2)))
        for floor in range(max(1, int(height / 2.8))):
            for column in range(columns):
                if rng.random() < 0.18:
                    continue
                x = (column + 0.5 + rng.normal(0, 0.06)) * width / columns
                door = floor == 0 and rng.random() < 0.2
                y = height - 2.75 * floor - (1.0 if door else 1.6)
                w, h = rng.uniform(0.45, 0.75), 1.0 if door else rng.uniform(0.5, 0.75)
                tone = (90, 60, 40) if door else tuple(float(c) for c in rng.uniform(30, 110) + rng.normal(0, 8, 3))
                for grow, ink in ((0.18, (236.0, 232.0, 224.0)), (0.0, tone)):
                    a = (int((x - w - grow) * density), int((y - h - grow) * density))
                    b = (int((x + w + grow) * density), int((y + h + grow) * density))
                    cv2.rectangle(colors, a, b, [float(c) for c in ink], -1)
        return to_texture(colors)

    return paint


def house(rng: np.random.Generator, length: float, width: float) -> list[Patch]:
    """A house with a gable roof, the ridge along x, a chimney and sometimes dormers."""
    x, y = length / 2, width / 2
    eaves, rise, hang = rng.uniform(3.2, 7.5), rng.uniform(0.35, 0.6) * width, 0.5
    color = WALLS[rng.integers(len(WALLS))]
    wall = facade(rng, color)
    low, high = ROOFS[rng.integers(len(ROOFS))]
    tiles = materials.masonry(rng, [low, high], tuple(0.6 * c for c in low), (0.7, 0.9), 0.12, density=8, relief=13)
    parts = box((-x, -y, 0), (x, y, eaves), wall, skip=("bottom", "top"))
    slope = rise / y
    edge = eaves - hang * slope
    ridge = eaves + rise
    for side in (1.0, -1.0):
        # Seen from outside, the ridge is the upper edge.
        corner, across = (-side * -(x + hang), 0.0, ridge), (-side * 2 * (x + hang), 0.0, 0.0)
        parts.append(surface(quad(corner, across, (0.0, side * (y + hang), edge - ridge)), tiles, two_sided=True))
        gable = np.array([[[side * x, 0, ridge]] * 2, [[side * x, -side * y, eaves], [side * x, side * y, eaves]]])
        parts.append(surface(gable, materials.plaster(rng, color, 10, density=8)))
    brick = materials.masonry(rng, [(130, 70, 54), (170, 104, 82)], (150, 146, 138), (0.3, 0.5), 0.08, density=10)
    at = rng.uniform(-0.6, 0.6) * x
    parts += box((at - 0.4, 0.3, ridge - 1.4), (at + 0.4, 1.1, ridge + 0.9), brick)
    if length > 11:
        for dormer in rng.uniform(-0.7, 0.7, 2) * x:
            parts += box((dormer - 0.8, -0.75 * y, eaves), (dormer + 0.8, -0.2 * y, eaves + 0.62 * rise), tiles)
    if rng.random() < 0.6:
        shed = materials.plaster(rng, WALLS[rng.integers(len(WALLS))], 14, density=8)
        parts += box((x, -y, 0), (x + rng.uniform(2.5, 5), y - rng.uniform(1, 4), rng.uniform(2.4, 3.2)), shed)
    return parts


def tree(rng: np.random.Generator, radius: float) -> list[Patch]:
    """A crown of two lobes on a trunk."""
    green = np.array([62.0, 88.0, 38.0]) * rng.uniform(0.7, 1.3) + rng.normal(0, 9, 3)
    leaves = materials.marbled(rng, [0.4 * green, 0.9 * green, 1.5 * green], density=7, grain=0.9)
    trunk = cylinder((0, 0, -0.5), 0.12 * radius, radius + 0.5, materials.plain((70, 54, 40)), segments=5)[:1]
    lift = 1.5 * radius
    crown = blob((0, 0, lift), (radius, radius, 1.1 * radius), leaves, bumps=0.1, rng=rng, rows=7, columns=10)
    lobe = (*rng.normal(0, 0.35 * radius, 2), lift + 0.6 * radius)
    size = 0.65 * radius
    return [*trunk, crown, blob(lobe, (size, size, size), leaves, bumps=0.1, rng=rng, rows=5, columns=8)]


def car(rng: np.random.Generator) -> list[Patch]:
    """A car heading along x."""
    color = prints.random_color(rng, (0.1, 0.8), (0.2, 0.95))
    paint = materials.marbled(rng, [0.85 * color, color], density=12, grain=0.6)
    glass = materials.plain((44, 52, 60))
    return [
        *box((-2.1, -0.85, 0.3), (2.1, 0.85, 0.95), paint),
        *box((-1.2, -0.75, 0.95), (0.9, 0.75, 1.45), glass, skip=("bottom", "top")),
        surface(quad((-1.2, 0.75, 1.46), (2.1, 0, 0), (0, -1.5, 0)), paint),
    ]
