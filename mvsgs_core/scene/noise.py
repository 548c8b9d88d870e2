"""Random fields on a texture grid, from smooth to rough, without a period."""

from __future__ import annotations

import cv2
import numpy as np


def smooth(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float]) -> np.ndarray:
    """Value noise (h, w) float32 of about unit range [-1, 1] with cells[0] x cells[1] cells (v, u) over the texture."""
    rows, columns = (max(2, int(np.ceil(c)) + 1) for c in cells)
    rows, columns = min(rows, shape[0] + 1), min(columns, shape[1] + 1)
    grid = rng.uniform(-1.0, 1.0, (rows + 2, columns + 2)).astype(np.float32)
    field = cv2.resize(grid, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field)


def fractal(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cells: tuple[float, float],
    octaves: int = 5,
    gain: float = 0.55,
) -> np.ndarray:
    """Sum (h, w) float32 of value noise whose cells halve and amplitude shrinks by `gain` an octave; about [-1, 1]."""
    total = np.zeros(shape, dtype=np.float32)
    amplitude, norm = 1.0, 0.0
    for octave in range(octaves):
        factor = 2.0**octave
        if octave > 0 and cells[0] * factor > shape[0] and cells[1] * factor > shape[1]:
            break
        total += amplitude * smooth(rng, shape, (cells[0] * factor, cells[1] * factor))
        norm += amplitude**2
        amplitude *= gain
    return total / np.float32(norm**0.5)


def warped(field: np.ndarray, rng: np.random.Generator, cells: tuple[float, float], texels: float) -> np.ndarray:
    """`field` (h, w) or (h, w, 3) shifted by smooth noise of up to about `texels`."""
    h, w = field.shape[:2]
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    dx, dy = (texels * fractal(rng, (h, w), cells, 3) for _ in range(2))
    return np.asarray(cv2.remap(field, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def blend(palette: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Colors (h, w, 3) float32 from a palette (k, 3) by a field (h, w) clipped to [0, 1], in 256 steps."""
    stops = np.linspace(0.0, 1.0, len(palette))
    table = np.stack(
        [np.interp(np.linspace(0.0, 1.0, 256), stops, channel) for channel in np.asarray(palette).T], axis=-1
    )
    steps = (np.clip(field, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    steps = np.ascontiguousarray(np.broadcast_to(steps, field.shape))
    return np.asarray(cv2.LUT(cv2.merge([steps] * 3), table[None].astype(np.float32)))


def to_texture(colors: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 of colors in 0 to 255."""
    return np.clip(colors + 0.5, 0, 255).astype(np.uint8)
