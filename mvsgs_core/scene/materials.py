"""Paint for surfaces: each function returns a material that paints a texture for a surface of given size in meters."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mvsgs_core.scene.noise import blend, fractal, smooth, to_texture, warped
from mvsgs_core.scene.patches import Material, Texture

RGB = Sequence[float] | np.ndarray  # 0 to 255, sRGB


def shape_of(height: float, width: float, density: float) -> tuple[int, int]:
    """Texels (rows, columns) of a surface at `density` texels a meter."""
    return max(4, round(height * density)), max(4, round(width * density))


def plain(color: RGB) -> Material:
    """No texture at all."""
    return lambda height, width: np.tile(np.array(color, np.uint8), (4, 4, 1))


def plaster(rng: np.random.Generator, color: RGB, contrast: float = 14.0, density: float = 220.0) -> Material:
    """Brushed paint: stains, trowel marks, speckles and a few cracks."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        stains = fractal(rng, shape, (height * 1.2, width * 1.2), 4)
        trowel = warped(fractal(rng, shape, (height * 9, width * 4), 4), rng, (height * 2, width * 2), 12)
        speckle = smooth(rng, shape, (height * 110, width * 110))
        shade = contrast * (0.8 * stains + 1.1 * np.abs(trowel) - 0.4 + 0.5 * speckle)
        colors = np.asarray(color, np.float32) + shade[..., None] * np.array([1.0, 0.98, 0.9], np.float32)
        for _ in range(int(height * width * 1.5)):
            steps = rng.normal(0, 4, (rng.integers(6, 40), 2)) + rng.normal(0, 4, 2)
            line = np.cumsum(steps, axis=0) + rng.uniform(0, 1, 2) * (shape[1], shape[0])
            tone = [float(c) - contrast * 2.2 for c in color]
            cv2.polylines(colors, [line.astype(np.int32)], False, tone, 1, cv2.LINE_AA)
        return to_texture(colors)

    return paint


def wood(rng: np.random.Generator, dark: RGB, light: RGB, density: float = 300.0) -> Material:
    """Grain along the longer side, with rings, fibers and a knot here and there."""

    def paint(height: float, width: float) -> Texture:
        if height > width:
            return np.ascontiguousarray(paint(width, height).transpose(1, 0, 2))
        shape = shape_of(height, width, density)
        rings = _rings(rng, shape, height, width, np.zeros(shape, np.float32))
        return to_texture(blend(np.array([dark, light]), 0.5 + 0.5 * rings))

    return paint


def _rings(
    rng: np.random.Generator, shape: tuple[int, int], height: float, width: float, phase: np.ndarray
) -> np.ndarray:
    """Grain (h, w) in about [-1, 1] along the columns; `phase` (h, w) sets boards apart."""
    across = np.linspace(0.0, height, shape[0], dtype=np.float32)[:, None]
    bend = fractal(rng, shape, (height * 4, width * 1.1), 3)
    rings = np.sin(2 * np.pi * (across * 38.0 + 1.6 * bend + phase))
    fibers = fractal(rng, shape, (height * 150, width * 5), 3, 0.7)
    tone = fractal(rng, shape, (height * 3, width * 2), 4)
    knots = fractal(rng, shape, (height * 6, width * 3), 2)
    return np.asarray(0.24 * rings + 0.55 * fibers + 0.5 * tone - 1.3 * np.clip(knots - 0.75, 0, 1))


def planks(rng: np.random.Generator, dark: RGB, light: RGB, board: float = 0.13, density: float = 240.0) -> Material:
    """A floor of boards of different length and tone, dark joints between them; boards run along the columns."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        y = np.linspace(0.0, height, shape[0], dtype=np.float32)
        row = (y / board).astype(int)
        tone, phase = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        joint = np.zeros(shape, bool)
        x = np.linspace(0.0, width, shape[1], dtype=np.float32)
        for r in range(row.max() + 1):
            ends = np.cumsum(rng.uniform(0.5, 1.5, int(width) * 2 + 4)) - rng.uniform(0, 1)
            piece = np.searchsorted(ends, x)
            lines = row == r
            tone[lines] = rng.normal(0, 0.28, len(ends) + 1).astype(np.float32)[piece]
            phase[lines] = rng.uniform(0, 9, len(ends) + 1).astype(np.float32)[piece]
            joint[lines] = (np.abs(x[:, None] - ends[None]).min(axis=1) < 0.003)[None]
        joint |= ((y / board) % 1.0 < 0.03)[:, None]
        field = 0.5 + 0.45 * _rings(rng, shape, height, width, phase) + tone
        colors = blend(np.array([dark, light]), field)
        scuffs = fractal(rng, shape, (height * 2, width * 2), 6, 0.7)
        colors += 9.0 * scuffs[..., None]
        colors[joint] *= 0.35
        return to_texture(colors)

    return paint


def masonry(
    rng: np.random.Generator,
    palette: Sequence[RGB],
    mortar: RGB,
    brick: tuple[float, float] = (0.075, 0.23),
    joint: float = 0.012,
    shift: float = 0.5,
    density: float = 260.0,
    relief: float = 22.0,
) -> Material:
    """Bricks or tiles of (height, width) meters, each of its own tone; `shift` offsets every second row."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        wobble = 0.004 * fractal(rng, shape, (height * 5, width * 5), 3)
        y = np.linspace(0.0, height, shape[0], dtype=np.float32)[:, None] + wobble
        x = np.linspace(0.0, width, shape[1], dtype=np.float32)[None] + wobble
        row = np.floor(y / brick[0]).astype(int)
        offsets = (shift * (np.arange(row.max() + 3) % 2) + rng.uniform(-0.06, 0.06, row.max() + 3)) * brick[1]
        column_at = (x + offsets[row + 1]) / brick[1]
        column = np.floor(column_at).astype(int)
        table = rng.random((row.max() + 3, column.max() + 4))
        tint = rng.normal(0, 9, (*table.shape, 3)).astype(np.float32)
        colors = blend(np.array(palette), table[row + 1, column + 1]) + tint[row + 1, column + 1]
        rough = fractal(rng, shape, (height * 16, width * 16), 5, 0.75)
        colors += relief * (rough + 0.4 * smooth(rng, shape, (height * 120, width * 120)))[..., None]
        fy, fx = (y / brick[0]) % 1.0 * brick[0], column_at % 1.0 * brick[1]
        grout = (fy < joint) | (fx < joint)
        colors[grout] = (np.asarray(mortar) + 0.7 * relief * rough[grout][:, None]).astype(np.float32)
        return to_texture(colors)

    return paint


def fabric(rng: np.random.Generator, color: RGB, second: RGB | None = None, density: float = 320.0) -> Material:
    """Woven cloth: melange threads, folds and wear; with a second color, uneven stripes."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        warp = smooth(rng, shape, (2, width * 160)) + fractal(rng, shape, (height * 14, width * 90), 2)
        weft = smooth(rng, shape, (height * 160, 2)) + fractal(rng, shape, (height * 90, width * 14), 2)
        wear = fractal(rng, shape, (height * 3, width * 3), 5, 0.7)
        colors = np.broadcast_to(np.asarray(color, np.float32), (*shape, 3)).copy()
        if second is not None:
            edges = np.cumsum(rng.uniform(0.01, 0.09, 400))
            x = np.linspace(0, width, shape[1]) + 0.004 * np.asarray(wear)
            stripe = np.searchsorted(edges, x) % 2 == 1
            colors[stripe] = np.asarray(second, np.float32)
        return to_texture(colors * (1.0 + 0.13 * (warp + weft) + 0.16 * wear)[..., None])

    return paint


def cells(rng: np.random.Generator, shape: tuple[int, int], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Voronoi cells: number (h, w) int32 from 1 to `count`, distance (h, w) float32 in texels to the seed."""
    mask = np.ones(shape, np.uint8)
    mask[rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)] = 0
    distance, labels = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    return np.asarray(labels), np.asarray(distance)


def rug(rng: np.random.Generator, palette: Sequence[RGB], density: float = 260.0) -> Material:
    """A woven rug: patchwork of colored cells inside uneven borders."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        colors_of = np.array(palette, np.float32)
        labels, distance = cells(rng, shape, int(90 * height * width))
        picked = colors_of[rng.integers(0, len(palette), labels.max() + 1)]
        colors = picked[labels] + rng.normal(0, 14, (labels.max() + 1, 3)).astype(np.float32)[labels]
        rings = np.sin(distance * rng.uniform(0.2, 0.9, labels.max() + 1).astype(np.float32)[labels])
        colors = warped(colors + 16 * rings[..., None], rng, (height * 5, width * 5), 7)
        y, x = np.mgrid[0 : shape[0], 0 : shape[1]] / density
        border = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
        for edge, color in ((0.16, palette[0]), (0.12, palette[-1]), (0.04, palette[1])):
            inside = border < edge + 0.004 * fractal(rng, shape, (height * 12, width * 12), 2)
            colors[inside] = np.asarray(color, np.float32)
        for _ in range(int(260 * (height + width))):
            t, along = rng.uniform(0.05, 0.11), rng.uniform(0, 2 * (height + width))
            at = _on_border(along, t, height, width)
            tone = [float(c) for c in colors_of[rng.integers(len(palette))] + rng.normal(0, 12, 3)]
            size = (int(rng.integers(2, 7)), int(rng.integers(1, 5)))
            center = (int(at[0] * density), int(at[1] * density))
            cv2.ellipse(colors, center, size, float(rng.uniform(0, 180)), 0, 360, tone, -1, cv2.LINE_AA)
        weave = smooth(rng, shape, (height * 130, width * 130)) + fractal(rng, shape, (height * 4, width * 4), 5, 0.7)
        return to_texture(colors * (1.0 + 0.12 * weave)[..., None])

    return paint


def _on_border(along: float, depth: float, height: float, width: float) -> tuple[float, float]:
    """(x, y) at length `along` around a rectangle, `depth` inside its edge."""
    for side, length in enumerate((width, height, width, height)):
        if along < length or side == 3:
            return ((along, depth), (width - depth, along), (along, height - depth), (depth, along))[side]
        along -= length
    raise AssertionError("a rectangle has four sides")


def wallpaper(rng: np.random.Generator, ground: RGB, palette: Sequence[RGB], density: float = 260.0) -> Material:
    """Hand-painted foliage: stems and leaves strewn without a repeat."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        tone = 7 * fractal(rng, shape, (height * 2, width * 2), 5, 0.7) + 4 * smooth(
            rng, shape, (height * 120, width * 120)
        )
        colors = np.asarray(ground, np.float32) + tone[..., None]
        for _ in range(int(26 * height * width)):
            at, heading = rng.uniform(0, 1, 2) * (width, height) * density, rng.uniform(0, 2 * np.pi)
            color = np.asarray(palette[int(rng.integers(len(palette)))]) + rng.normal(0, 12, 3)
            bend, count, size = rng.normal(0, 0.12), rng.integers(5, 13), rng.uniform(0.55, 1.35)
            for leaf in range(count):
                step = rng.uniform(0.02, 0.04) * size * density
                following = at + step * np.array([np.cos(heading), np.sin(heading)])
                dark = [float(c) for c in 0.62 * color]
                cv2.line(colors, _pixel(at), _pixel(following), dark, 2, cv2.LINE_AA)
                side = heading + (0.9 if leaf % 2 else -0.9) + rng.normal(0, 0.25)
                length = rng.uniform(0.025, 0.05) * size * density * (1.1 - leaf / count)
                middle = following + length * np.array([np.cos(side), np.sin(side)])
                axes = (max(1, int(length)), max(1, int(length * rng.uniform(0.25, 0.45))))
                shade = [float(c) for c in color + rng.normal(0, 13, 3)]
                cv2.ellipse(colors, _pixel(middle), axes, float(np.degrees(side)), 0, 360, shade, -1, cv2.LINE_AA)
                cv2.line(colors, _pixel(following), _pixel(2 * middle - following), dark, 1, cv2.LINE_AA)
                at, heading = following, heading + bend + rng.normal(0, 0.1)
        return to_texture(colors + 3 * fractal(rng, shape, (height * 40, width * 40), 3)[..., None])

    return paint


def _pixel(at: np.ndarray) -> tuple[int, int]:
    return int(at[0]), int(at[1])


def marbled(rng: np.random.Generator, palette: Sequence[RGB], density: float = 350.0, grain: float = 6.0) -> Material:
    """Glaze, stone, leather, peel, metal: colors flowing into each other, with veins."""

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        flow = fractal(rng, shape, (height * grain, width * grain), 5, 0.65)
        veins = 1.0 - np.abs(warped(fractal(rng, shape, (height * grain, width * grain), 4), rng, (4, 4), 6)) * 2.5
        colors = blend(np.array(palette), 0.5 + 0.42 * flow)
        return to_texture(colors * (1.0 - 0.28 * np.clip(veins, 0, 1) ** 3)[..., None])

    return paint
