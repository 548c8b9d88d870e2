"""Lenses: intrinsics with their distortion, and the undistortion of images and depth maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from mvsgs_core.camera import check_intrinsics, matrix, scale_intrinsics

_LARGEST_COEFFICIENT = 1e6  # of distortion: real ones are below 100
_MAX_ZOOM = 3.0  # a lens that needs more to hide its black border is no pinhole in any useful sense
_GUESSED_FIELD_OF_VIEW = math.radians(65.0)  # across the longer side: phones 60 to 69, webcams 60 to 70


@dataclass(frozen=True)
class Lens:
    """A calibrated camera. Raises ValueError for numbers that no camera has.

    `distortion` is OpenCV's: (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1 .. s4[, tx, ty]]]]), fisheye (k1, k2, k3, k4).
    Without any, a fisheye is the ideal one, whose four are zero.
    """

    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels at `size`, (0, 0) is a pixel's center
    size: tuple[int, int]  # (height, width) that the intrinsics are for
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    guessed: bool = False  # the focal length is a guess

    def __post_init__(self) -> None:
        check_intrinsics(np.array(self.intrinsics), self.size)
        if self.fisheye and not self.distortion:
            object.__setattr__(self, "distortion", (0.0,) * 4)
        if not all(math.isfinite(v) and abs(v) < _LARGEST_COEFFICIENT for v in self.distortion):
            raise ValueError(f"distortion must be finite and of sensible size, got {self.distortion}")
        allowed = (0, 4) if self.fisheye else (0, 4, 5, 8, 12, 14)
        if len(self.distortion) not in allowed:
            raise ValueError(f"distortion must have {allowed} coefficients, got {len(self.distortion)}")

    @property
    def distorted(self) -> bool:
        return self.fisheye or any(k != 0.0 for k in self.distortion)

    def at(self, size: tuple[int, int]) -> Lens:
        """The same lens for images scaled to `size` (distortion acts on normalized coordinates, so it stays)."""
        if size == self.size:
            return self
        fx, fy, cx, cy = scale_intrinsics(np.array(self.intrinsics), self.size, size)
        return replace(self, intrinsics=(float(fx), float(fy), float(cx), float(cy)), size=size)


def guess_lens(size: tuple[int, int]) -> Lens:
    """A lens of 65 degrees across the longer side, principal point in the middle: a guess, to be announced as one."""
    focal = 0.5 * max(size) / math.tan(0.5 * _GUESSED_FIELD_OF_VIEW)
    return Lens((focal, focal, 0.5 * (size[1] - 1), 0.5 * (size[0] - 1)), size, guessed=True)


class Undistortion:
    """The pinhole image of a lens, at the lens's own size.

    fill: zooms in, about the principal point, by as little as leaves no pixel without a source (at most 3x); otherwise
    the focal length is kept, as published results on TUM RGB-D do, which cut the black border off afterwards.
    Raises ValueError if the lens bends so much that no such zoom exists.
    """

    def __init__(self, lens: Lens, *, fill: bool = True) -> None:
        self.lens = lens
        fx, fy, cx, cy = lens.intrinsics
        zoom = _smallest_zoom(lens) if fill and lens.distorted else 1.0
        self.intrinsics = np.array([fx * zoom, fy * zoom, cx, cy])
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        if lens.distorted:
            undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
            camera, pinhole = matrix(np.array(lens.intrinsics)), matrix(self.intrinsics)
            size = lens.size[1], lens.size[0]
            self._maps = undistort(camera, np.array(lens.distortion), np.eye(3), pinhole, size, cv2.CV_32FC1)

    def image(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8, bilinear; black where the lens saw nothing."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR))

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """(H, W) float32, nearest neighbor: depth must not be averaged across an edge; 0 outside."""
        if self._maps is None:
            return depth
        return np.asarray(cv2.remap(depth, *self._maps, interpolation=cv2.INTER_NEAREST))

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """(H, W) bool, nearest neighbor; False outside."""
        return self.depth(mask.astype(np.uint8)) > 0


def distorted(lens: Lens, intrinsics: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Where pixels (N, 2) of the pinhole image lie in the distorted one, (N, 2)."""
    fx, fy, cx, cy = intrinsics
    rays = (pixels - (cx, cy)) / (fx, fy)
    camera, distortion = matrix(np.array(lens.intrinsics)), np.array(lens.distortion)
    if lens.fisheye:
        return np.asarray(cv2.fisheye.distortPoints(rays[:, None], camera, distortion))[:, 0]
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, distortion)[0])[:, 0]


def _smallest_zoom(lens: Lens) -> float:
    height, width = lens.size
    x, y = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    border = np.concatenate(
        [
            np.stack([x, np.zeros_like(x)], 1), np.stack([x, np.full_like(x, height - 1)], 1),
            np.stack([np.zeros_like(y), y], 1), np.stack([np.full_like(y, width - 1), y], 1),
        ]
    )  # fmt: skip
    fx, fy, cx, cy = lens.intrinsics

    def filled(zoom: float) -> bool:
        source = distorted(lens, np.array([fx * zoom, fy * zoom, cx, cy]), border)
        return bool(np.all((source >= 0) & (source <= (width - 1, height - 1))))

    if filled(1.0):
        return 1.0
    low, high = 1.0, _MAX_ZOOM
    if not filled(high):
        raise ValueError(f"distortion {lens.distortion} leaves no image without a border: are the coefficients right?")
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if filled(middle) else (middle, high)
    return high
