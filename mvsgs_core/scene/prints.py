"""Printed and painted things: pictures, book covers, papers. Texture that no two objects share."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from mvsgs_core.scene.materials import cells, shape_of
from mvsgs_core.scene.noise import blend, fractal, smooth, to_texture, warped
from mvsgs_core.scene.patches import Material, Texture

# Hues of dyes, inks and pigments as a home has them: many warm ones and blues, few greens, hardly a purple.
HUES = (0.0, 0.02, 0.05, 0.07, 0.09, 0.11, 0.13, 0.16, 0.27, 0.36, 0.5, 0.56, 0.59, 0.62, 0.95)


def random_color(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> np.ndarray:
    """(3,) sRGB 0 to 255 of random hue."""
    hue = (HUES[rng.integers(len(HUES))] + rng.normal(0.0, 0.012)) % 1.0
    return 255.0 * np.array(colorsys.hsv_to_rgb(hue, 0.85 * rng.uniform(*saturation), rng.uniform(*value)))


def painting(rng: np.random.Generator, kind: str, density: float = 420.0) -> Material:
    """A painting in brush strokes: "landscape", "abstract" or "still_life"."""
    compose = {"landscape": _landscape, "abstract": _abstract, "still_life": _still_life}[kind]

    def paint(height: float, width: float) -> Texture:
        shape = shape_of(height, width, density)
        colors = np.ascontiguousarray(compose(rng, shape), dtype=np.float32)
        for _ in range(int(2600 * height * width) + 150):
            x, y = int(rng.integers(shape[1])), int(rng.integers(shape[0]))
            tone = [float(c) for c in colors[y, x] + rng.normal(0, 15) + rng.normal(0, 6, 3)]
            axes = (int(rng.integers(3, 13)), int(rng.integers(1, 4)))
            cv2.ellipse(colors, (x, y), axes, float(rng.normal(20, 40)), 0, 360, tone, -1, cv2.LINE_AA)
        canvas = smooth(rng, shape, (height * 200, width * 200))
        return to_texture(colors + 5 * canvas[..., None])

    return paint


def _landscape(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    h, w = shape
    y = np.linspace(0, 1, h, dtype=np.float32)[:, None]
    skies = (((96, 140, 190), (226, 222, 206)), ((120, 120, 150), (240, 190, 130)), ((70, 96, 130), (190, 206, 214)))
    colors = blend(np.array(skies[rng.integers(3)]), y * 1.8 + 0.3 * fractal(rng, shape, (6, 5), 5))
    far, near = np.array([[126, 140, 150], [96, 116, 96], [150, 136, 92]]), np.array([[44, 58, 30], [92, 84, 40]])
    for level in np.linspace(0.35, 0.85, 6):
        ridge = level + 0.15 * (1.1 - level) * fractal(rng, (4, w), (2, 5), 6, 0.6)[0]
        t = (level - 0.35) * 2
        tone = (1 - t) * far[rng.integers(3)] + t * near[rng.integers(2)] + rng.normal(0, 9, 3)
        grain = fractal(rng, shape, (18, 14), 5, 0.7)
        land = tone.astype(np.float32) * (1.0 + 0.35 * grain)[..., None]
        colors = np.where((y > ridge[None])[..., None], land, colors)
    return np.asarray(colors)


def _abstract(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    labels, distance = cells(rng, shape, 26)
    palette = np.array([random_color(rng, (0.15, 0.9), (0.2, 1.0)) for _ in range(labels.max() + 1)], np.float32)
    colors = warped(palette[labels] + 0.5 * distance[..., None], rng, (4, 4), 14)
    for _ in range(24):
        points = np.cumsum(rng.normal(0, 0.09, (7, 2)), axis=0) + rng.uniform(0, 1, 2)
        tone = [float(c) for c in random_color(rng, (0.2, 1.0), (0.05, 1.0))]
        line = (points * (shape[1], shape[0])).astype(np.int32)
        cv2.polylines(colors, [line], False, tone, int(rng.integers(1, 9)), cv2.LINE_AA)
    return colors


def _still_life(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    h, w = shape
    ground = np.array([random_color(rng, (0.2, 0.5), (0.1, 0.35)), random_color(rng, (0.3, 0.6), (0.4, 0.6))])
    colors = blend(ground, np.linspace(0.1, 0.9, h)[:, None] + 0.35 * fractal(rng, shape, (4, 4), 5))
    for _ in range(17):
        center = (int(rng.uniform(0.1, 0.9) * w), int(rng.uniform(0.35, 0.85) * h))
        radius, tone = rng.uniform(0.05, 0.17) * min(h, w), random_color(rng, (0.5, 1.0), (0.4, 0.95))
        stretch, turn = rng.uniform(0.7, 1.6), rng.uniform(0, 180)
        for k in np.linspace(1.0, 0.15, 7):
            axes = (int(radius * k), int(radius * k * stretch))
            shifted = (int(center[0] - 0.3 * radius * (1 - k)), int(center[1] - 0.3 * radius * (1 - k)))
            shade = [float(c) for c in tone * (1.25 - 0.75 * k) + 40 * (1 - k) ** 2]
            cv2.ellipse(colors, shifted, axes, turn, 0, 360, shade, -1, cv2.LINE_AA)
    return colors


def spine(rng: np.random.Generator, density: float = 650.0) -> Material:
    """The back of a book: cloth or paper, bands, a title in marks like letters, a publisher's sign, wear."""

    def paint(height: float, width: float) -> Texture:
        h, w = shape_of(height, width, density)
        ground = random_color(rng, (0.1, 0.85), (0.12, 0.95))
        ink = np.clip(255.0 - ground + rng.normal(0, 50, 3), 0, 255)
        if abs(float(ink.mean() - ground.mean())) < 70:
            ink = np.full(3, 235.0) if ground.mean() < 128 else np.full(3, 25.0)
        colors = np.broadcast_to(ground.astype(np.float32), (h, w, 3)).copy()
        for _ in range(rng.integers(0, 5)):
            y, thick = int(rng.uniform(0.03, 0.95) * h), int(rng.integers(1, max(2, h // 14)))
            colors[y : y + thick] = random_color(rng, (0.2, 0.9), (0.2, 0.95))
        if rng.random() < 0.35:
            a, b = np.sort(rng.uniform(0.1, 0.9, 2) * h).astype(int)
            colors[a : b + 1, 1:-1] = random_color(rng, (0.1, 0.7), (0.3, 1.0))
        _title(rng, colors, ink, rng.uniform(0.1, 0.3), rng.uniform(0.55, 0.8))
        if rng.random() < 0.6:
            _title(rng, colors, ink, 0.84, 0.96)
        wear = fractal(rng, (h, w), (height * 25, width * 25), 4, 0.7)
        edge = np.linspace(-1, 1, w)[None] ** 4
        return to_texture(colors * (1.0 + 0.1 * wear - 0.35 * edge)[..., None])

    return paint


def _title(rng: np.random.Generator, colors: np.ndarray, ink: np.ndarray, start: float, end: float) -> None:
    """Letters down the spine from `start` to `end` of its height."""
    h, w = colors.shape[:2]
    y, size = int(start * h), max(2, int(rng.uniform(0.3, 0.65) * w))
    left = int(rng.uniform(0.1, 0.9) * max(1, w - size))
    tone = [float(c) for c in ink]
    while y < end * h:
        tall = int(rng.integers(2, max(4, int(0.6 * size) + 2)))
        if rng.random() < 0.82:
            for _ in range(rng.integers(1, 4)):
                a = (left + int(rng.integers(size)), y + int(rng.integers(tall)))
                b = (left + int(rng.integers(size)), y + int(rng.integers(tall)))
                cv2.line(colors, a, b, tone, 1, cv2.LINE_AA)
        y += tall + 1


def cover(rng: np.random.Generator, density: float = 420.0) -> Material:
    """A book cover or magazine: a picture under a title and lines of print."""

    def paint(height: float, width: float) -> Texture:
        h, w = shape_of(height, width, density)
        picture = _abstract if rng.random() < 0.5 else _still_life
        colors = np.ascontiguousarray(picture(rng, (h, w)), dtype=np.float32)
        band = int(rng.uniform(0.02, 0.6) * h)
        tall = int(rng.uniform(0.14, 0.3) * h)
        colors[band : band + tall] = random_color(rng, (0.1, 0.9), (0.1, 1.0))
        _lines(rng, colors, band, band + tall, int(rng.integers(5, 13)))
        return to_texture(colors)

    return paint


def paper(rng: np.random.Generator, density: float = 420.0) -> Material:
    """A printed sheet: headline, columns of text, a photograph."""

    def paint(height: float, width: float) -> Texture:
        h, w = shape_of(height, width, density)
        sheet = np.array([232.0, 228.0, 214.0], np.float32)
        colors = sheet + 5 * fractal(rng, (h, w), (6, 6), 4)[..., None]
        _lines(rng, colors, int(0.04 * h), int(0.16 * h), max(4, h // 14))
        _lines(rng, colors, int(0.2 * h), int(0.96 * h), 4)
        a, b = int(rng.uniform(0.2, 0.6) * h), int(rng.uniform(0.05, 0.45) * w)
        tall, wide = int(0.3 * h), int(0.45 * w)
        colors[a : a + tall, b : b + wide] = _landscape(rng, (tall, wide))[: h - a, : w - b]
        return to_texture(colors)

    return paint


def _lines(rng: np.random.Generator, colors: np.ndarray, top: int, bottom: int, size: int) -> None:
    """Lines of words made of strokes, `size` texels high."""
    w = colors.shape[1]
    tone = [20.0, 20.0, 26.0] if float(colors[top : max(bottom, top + 1)].mean()) > 110 else [235.0, 232.0, 220.0]
    for y in range(top + 1, bottom - size, int(size * 1.6) + 1):
        x = int(0.05 * w)
        while x < 0.93 * w:
            for _ in range(rng.integers(2, 9)):
                points = rng.uniform(0, 1, (3, 2)) * (0.7 * size, size) + (x, y)
                cv2.polylines(colors, [points.astype(np.int32)], False, tone, max(1, size // 6), cv2.LINE_AA)
                x += max(2, int(0.8 * size))
                if x > 0.93 * w:
                    break
            x += max(2, size // 2)
