"""Pictures of a camera that moves, and what is fixed to it drawn over them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

SIZE = (120, 160)
Draw = Callable[[np.ndarray, int], np.ndarray]  # draws into an image; where: (H, W) bool


def texture(size: tuple[int, int], seed: int, grain: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.clip(120.0 + 60.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


WORLD = texture((400, 500), 0)


def frames(count: int, step: float = 1.0) -> Iterator[np.ndarray]:
    """A camera that moves sideways and up and down before a textured wall."""
    for n in range(count):
        u, v = 150 + 120 * np.sin(0.11 * n * step), 120 + 90 * np.sin(0.17 * n * step)
        yield cv2.getRectSubPix(WORLD, SIZE[::-1], (u + SIZE[1] / 2, v + SIZE[0] / 2))


def bars(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[:14] = where[-14:] = True
    image[where] = 3
    return where


def side_bars(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[:, :30] = where[:, -30:] = True
    image[where] = 0
    return where


def logo(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[10:30, 20:60] = True
    image[where] = (200, 20, 20)
    cv2.putText(image, "TV", (25, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
    return where


def hood(image: np.ndarray, n: int) -> np.ndarray:
    where = np.arange(SIZE[0])[:, None] > 95 + 0.004 * (np.arange(SIZE[1])[None] - 80) ** 2
    image[where] = texture(SIZE, 1, 4.0)[where] // 2
    return where


def mirror(image: np.ndarray, n: int) -> np.ndarray:
    """A smooth hood, in which a bright scene is seen weakly."""
    image[:] = image // 4 + 130
    where = np.arange(SIZE[0])[:, None] > 80 + 0.006 * (np.arange(SIZE[1])[None] - 80) ** 2
    image[where] = (20 + 0.2 * image[::-1].astype(np.float32))[where].astype(np.uint8)
    return where


def rim(image: np.ndarray, n: int) -> np.ndarray:
    """Of an undistorted picture, whose upper half is dark at times: there no edge stays."""
    y, x = (np.arange(side) - (side - 1) / 2 for side in SIZE)
    where = (x[None] / 88) ** 2 + (y[:, None] / 60) ** 2 > 1.0
    image[: 60 * (n % 3 == 0)] //= 16
    image[where] = n % 2
    return where
