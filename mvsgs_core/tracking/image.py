"""A frame as the tracker sees it: reduced, gray, with what is computed from it once and kept while it is needed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from mvsgs_core.camera import fit_size, mask_at, resize_image, shrunk, stretching
from mvsgs_core.tracking.estimation.gray_levels import Levels, Samples

CELL = 8  # pixels: one point a cell
WIDEST = 16 / 9  # longer over shorter side of an image from which on it is tracked with more pixels
BORDER = 24  # pixels around every pyramid level, so that windows need no bounds checks
LEVELS = 4
MASK_MARGIN = 4  # pixels beside a masked one where no point lies: half of a window


@dataclass(frozen=True)
class Cells:
    """One point per 8x8 cell, at its most textured pixel. M = (H / 8) * (W / 8), by rows."""

    points: np.ndarray  # (M, 2) float32 u, v
    information: np.ndarray  # (M, 3) float64 xx, xy, yy: 1 along well textured directions, down to 0
    textured: np.ndarray  # (M,) bool: can be tracked


@dataclass
class TrackingImage:
    """A gray image (H, W) uint8, both sizes multiples of 8."""

    index: int
    timestamp: float  # seconds
    gray: np.ndarray
    color: np.ndarray | None = None  # (H, W, 3) uint8 RGB: only for a flow that wants it
    half_color: np.ndarray | None = None  # (H / 2, W / 2, 3) uint8 RGB: what is known of the light; None: nothing
    exposure: float = 0.0  # see `msgs.Frame`
    velocity: np.ndarray | None = None  # (H / 8, W / 8, 2) float32 pixels a second, where it is known
    mask: np.ndarray | None = None  # (H, W) bool: where points may lie; None: everywhere
    _features: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)

    @staticmethod
    def of(
        index: int, timestamp: float, image: np.ndarray, size: tuple[int, int], color: bool, exposure: float = 0.0,
        mask: np.ndarray | None = None,
    ) -> TrackingImage:  # fmt: skip
        """From an RGB image of any size, and a mask (bool) of any size: False where a pixel is to be ignored."""
        resized = _resized(image, size)
        gray = cv2.cvtColor(resized, cv2.COLOR_RGB2GRAY)
        half = np.asarray(cv2.resize(resized, (size[1] // 2, size[0] // 2), interpolation=cv2.INTER_AREA))
        seen = mask_at(mask, size)
        table = stretching(gray, seen)
        if table is not None:  # before it is rounded
            gray = cv2.cvtColor(_resized(np.asarray(cv2.LUT(image, table)), size), cv2.COLOR_RGB2GRAY)
        seen = None if seen is None else shrunk(seen, MASK_MARGIN)
        return TrackingImage(index, timestamp, gray, resized if color else None, half, exposure, mask=seen)

    def bare(self) -> TrackingImage:
        """The same with nothing computed yet: what is kept of a frame that may not be needed again."""
        return replace(self, _features=None)

    @property
    def size(self) -> tuple[int, int]:
        return self.gray.shape[0], self.gray.shape[1]

    @property
    def longer_side(self) -> int:
        """What motion is measured by, in pixels: a camera that is held upright moves by the same part of it."""
        return max(self.size)

    @cached_property
    def pyramid(self) -> list[np.ndarray]:
        """Levels (H / 2^l + 48, W / 2^l + 48) float32, bordered."""
        level: np.ndarray = self.gray.astype(np.float32)
        levels: list[np.ndarray] = []
        for n in range(LEVELS):
            if n:
                level = np.asarray(cv2.pyrDown(level))
            levels.append(np.asarray(cv2.copyMakeBorder(level, *(BORDER,) * 4, cv2.BORDER_REPLICATE)))
        return levels

    @cached_property
    def half(self) -> np.ndarray:
        """(H / 2, W / 2) uint8, for flow from frame to frame."""
        return np.asarray(cv2.resize(self.gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))

    @cached_property
    def cells(self) -> Cells:
        return find_cells(self.gray, mask=self.mask)

    @cached_property
    def levels(self) -> Levels | None:
        """Gray levels for photometry, where colors are known."""
        if self.half_color is None:
            return None
        return Levels(self.half_color, mask_at(self.mask, self.half_color.shape[:2]))

    @cached_property
    def flat_places(self) -> tuple[np.ndarray, Samples]:
        """(M, 2) the flattest place of every cell, and the gray levels there."""
        assert self.levels is not None
        places = self.levels.flattest(CELL)
        return places, self.levels.at(places)

    def velocity_at(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixels a second by which what is seen at points (N, 2) moves; 0 where it is not known."""
        if self.velocity is None:
            return np.zeros(points.shape)
        at = np.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0)
        rows, columns = self.velocity.shape[:2]
        v = np.clip(at[:, 1] / CELL, 0, rows - 1).astype(int)
        u = np.clip(at[:, 0] / CELL, 0, columns - 1).astype(int)
        return np.asarray(self.velocity[v, u])

    def masked(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 2) lie where nothing is to be seen; points outside, or NaN, do not."""
        if self.mask is None:
            return np.zeros(len(points), dtype=bool)
        with np.errstate(invalid="ignore"):
            inside = np.all((points > -0.5) & (points < [self.size[1] - 0.5, self.size[0] - 0.5]), axis=1)
        u, v = np.rint(np.where(inside[:, None], points, 0.0)).astype(int).T
        return np.asarray(inside & ~self.mask[v, u])

    @cached_property
    def cell_velocity(self) -> np.ndarray:
        """`velocity_at` the cells' points (M, 2)."""
        return self.velocity_at(self.cells.points)

    def features(self, count: int = 800) -> tuple[np.ndarray, np.ndarray]:
        """ORB keypoints (N, 2) float32 and descriptors (N, 32) uint8."""
        if self._features is None:
            orb = cv2.ORB.create(nfeatures=count, scaleFactor=1.2, nlevels=6, fastThreshold=7)
            seen = None if self.mask is None else self.mask.astype(np.uint8)
            keypoints, descriptors = orb.detectAndCompute(self.gray, seen)
            if descriptors is None:
                self._features = np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
            else:
                self._features = np.array([k.pt for k in keypoints], np.float32), descriptors
        return self._features

    def release(self) -> None:
        """Forgets what can be computed again: a keyframe outside the window keeps its pixels and features only."""
        for name in ("pyramid", "half", "levels", "flat_places"):
            self.__dict__.pop(name, None)


class RecentImages:
    """Images of which something is computed in a walk over a whole map: those that it came by long ago release it."""

    LIMIT = 64  # images: about a megabyte each

    def __init__(self) -> None:
        self._images: dict[int, TrackingImage] = {}  # by index, the one used last at the end

    def use(self, image: TrackingImage) -> TrackingImage:
        """The image, which keeps what is computed of it until `LIMIT` others have been used."""
        self._images.pop(image.index, None)
        self._images[image.index] = image
        if len(self._images) > self.LIMIT:
            self._images.pop(next(iter(self._images))).release()
        return image


def tracking_size(height: int, width: int, area: int) -> tuple[int, int]:
    """(height, width) at which images of a size are tracked: about `area` pixels, multiples of 8, at most doubled.

    Windows and cells have a fixed size in pixels: on small images they span objects of different depth, and the map
    comes out bent (160x120: depths 9 % off, 1 % when enlarged). So an image that is wider than WIDEST, of which `area`
    would leave few rows, is as high as one of that shape: KITTI's 370 rows become 208, not 152.
    """
    area = round(area * max(1.0, max(height, width) / min(height, width) / WIDEST))
    factor = max(1.0, min(2.0, (area / (height * width)) ** 0.5))
    return fit_size(round(height * factor), round(width * factor), area)


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Cubic where it is enlarged: linear interpolation blurs at every other pixel."""
    if size[0] > image.shape[0]:
        return np.asarray(cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_CUBIC))
    return resize_image(image, size)


def find_cells(gray: np.ndarray, noise: float = 20.0, mask: np.ndarray | None = None) -> Cells:
    """Points and their information matrices, from the structure tensor (mean over 7x7 pixels).

    noise: squared gradient (gray levels² per pixel²) at which a direction counts half. mask: (H, W) bool, False where
    no point is to lie.
    """
    height, width = gray.shape
    image = cv2.GaussianBlur(gray, (3, 3), 0).astype(np.float32)
    gx = 0.5 * (np.roll(image, -1, 1) - np.roll(image, 1, 1))
    gy = 0.5 * (np.roll(image, -1, 0) - np.roll(image, 1, 0))
    gx[:, [0, -1]] = 0.0
    gy[[0, -1]] = 0.0
    xx, xy, yy = (cv2.blur(product, (7, 7)) for product in (gx * gx, gx * gy, gy * gy))
    half_trace = 0.5 * (xx + yy)
    root = np.sqrt(np.maximum(half_trace**2 - (xx * yy - xy * xy), 0.0))
    smallest = half_trace - root
    score = smallest + 0.05 * (half_trace + root)
    score[:3] = score[-3:] = 0.0
    score[:, :3] = score[:, -3:] = 0.0
    if mask is not None:
        score[~mask] = -1.0
    rows, columns = height // CELL, width // CELL
    tiles = score.reshape(rows, CELL, columns, CELL).transpose(0, 2, 1, 3).reshape(rows * columns, CELL * CELL)
    best = np.argmax(tiles, axis=1)
    cell_v, cell_u = np.divmod(np.arange(rows * columns), columns)
    v, u = cell_v * CELL + best // CELL, cell_u * CELL + best % CELL
    tensor = np.stack([xx[v, u], xy[v, u], yy[v, u]], axis=1).astype(np.float64)
    largest = (half_trace + root)[v, u]
    # λ / (λ + noise) for both eigenvalues keeps the eigenvectors: G (G + noise I)^-1.
    a, b, c = tensor[:, 0] + noise, tensor[:, 1], tensor[:, 2] + noise
    det = a * c - b * b
    information = np.stack([1.0 - noise * c / det, noise * b / det, 1.0 - noise * a / det], axis=1)
    points = np.stack([u, v], axis=1).astype(np.float32)
    textured = (largest > noise) & (smallest[v, u] > 0.05 * noise)
    return Cells(points, information, textured if mask is None else textured & mask[v, u])


__all__ = ["BORDER", "CELL", "LEVELS", "Cells", "RecentImages", "TrackingImage", "find_cells", "tracking_size"]
