"""Pinhole cameras. Pixel (0, 0) is the CENTER of the first pixel; intrinsics are (fx, fy, cx, cy) in pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

_NARROWEST, _WIDEST = 1000.0, 0.01  # focal lengths as multiples of the longer side: 0.06 and 179 degrees of view
FOCAL_RANGE = 0.05, 100.0  # of the longer side of an image without distortion: 170 degrees of view to half a degree
_OFF_CENTER = 2.0  # image sizes from the middle: a principal point farther out is not even that of a cropped picture
_SAME = 1e-3  # relative difference of intrinsics that is no other camera
_LONGEST_SIDE = 2**20  # pixels
CONTRAST, REST = 96, 0.98  # gray levels between the darkest and brightest of an image, without 1 % of it at each end
BLACK, FLAT = 10, 4  # of an image that shows nothing: less bright, or with less contrast
DARK, LIGHTS = 48, 0.08  # an image that is darker, but for this part of it, is of a dark place with lights in it
DARKEST = 16  # gray level where contrast begins once it is stretched: some is darker
MAX_READOUT_TIME = 0.2  # seconds from the first row to the last: a longer one is a mistake, of the unit for one


def is_readout_time(seconds: float) -> bool:
    """Whether a rolling shutter may take so long from the first row to the last.

    Below 0 the last row is read first, as of a camera that is held upside down, whose images are turned.
    """
    return abs(seconds) <= MAX_READOUT_TIME


def told_readout_time(seconds: float, each: str = "", reads_columns: bool = False) -> str:
    """As people read it. each: of what, such as " a frame"."""
    end, line = "last" if seconds < 0.0 else "first", "column" if reads_columns else "row"
    usual = seconds == 0.0 or (end, line) == ("first", "row")
    return f"{1e3 * abs(seconds):.1f} ms{each}" + ("" if usual else f", the {end} {line} first")


def check_intrinsics(intrinsics: np.ndarray, size: tuple[int, int]) -> None:
    """Raises ValueError for (fx, fy, cx, cy) that no camera with images of `size` (height, width) has."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    height, width = size
    if not (1 <= height <= _LONGEST_SIDE and 1 <= width <= _LONGEST_SIDE):
        raise ValueError(f"an image of {width}x{height} pixels is none")
    if not all(math.isfinite(v) for v in (fx, fy, cx, cy)):
        raise ValueError(f"intrinsics must be finite, got fx, fy, cx, cy = {fx:g}, {fy:g}, {cx:g}, {cy:g}")
    if fx <= 0 or fy <= 0:
        raise ValueError(f"focal lengths must be positive, got fx, fy = {fx:g}, {fy:g}")
    longer = max(size)
    if not all(_WIDEST * longer <= f <= _NARROWEST * longer for f in (fx, fy)):
        raise ValueError(f"focal lengths fx, fy = {fx:g}, {fy:g} are no camera's with {width}x{height} pixels")
    if not is_near_middle(intrinsics, size):
        raise ValueError(f"principal point cx, cy = {cx:g}, {cy:g} is far outside of {width}x{height} pixels")


def is_near_middle(intrinsics: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether the principal point lies where that of an image (height, width) can; NaN does not."""
    off = np.abs(np.asarray(intrinsics, dtype=np.float64)[2:] - [0.5 * size[1], 0.5 * size[0]])
    return bool(np.all(off <= [_OFF_CENTER * size[1], _OFF_CENTER * size[0]]))


def same_intrinsics(a: np.ndarray | Sequence[float], b: np.ndarray | Sequence[float]) -> bool:
    """Whether both (4,) are those of one camera, but for what rounding and scaling leave."""
    return bool(np.allclose(a, b, rtol=_SAME))


def scale_intrinsics(intrinsics: np.ndarray, from_size: tuple[int, int], to_size: tuple[int, int]) -> np.ndarray:
    """Intrinsics (4,) of the same field of view at another size; sizes are (height, width)."""
    sy, sx = to_size[0] / from_size[0], to_size[1] / from_size[1]
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    return np.array([fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5])


def matrix(intrinsics: np.ndarray) -> np.ndarray:
    """(3, 3) float64 camera matrix K."""
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(u, v), each (height, width) float64."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return u, v


def unproject(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Camera-frame points (H, W, 3) float64 of a depth map (H, W)."""
    u, v = pixel_grid(*depth.shape)
    fx, fy, cx, cy = intrinsics
    z = depth.astype(np.float64)
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)


def project(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of camera-frame points (..., 3); the caller checks that z > 0."""
    fx, fy, cx, cy = intrinsics
    z = points[..., 2]
    return np.stack([fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy], axis=-1)


def straightened(x: np.ndarray, y: np.ndarray, k1: float, k2: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the plane at distance 1, as a lens shows them, without its distortion 1 + k1 r² + k2 r⁴."""
    if k1 == 0.0 and k2 == 0.0:
        return x, y
    straight_x, straight_y = x, y
    for _ in range(10):
        r2 = straight_x * straight_x + straight_y * straight_y
        bent = np.maximum(1.0 + r2 * (k1 + r2 * k2), 0.1)
        straight_x, straight_y = x / bent, y / bent
    return straight_x, straight_y


def pixel_motion(
    x: np.ndarray, y: np.ndarray, near: np.ndarray, intrinsics: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(6, N) of each axis: how pixels move with the twist (translation, rotation) of the camera, by the interaction
    matrix of visual servoing (Chaumette and Hutchinson 2006).

    x, y: (N,) of the points on the plane at distance 1; near: (N,) their inverse depths.
    """
    zero = np.zeros_like(x)
    of_u = np.stack([-near, zero, x * near, x * y, -(1.0 + x * x), y])
    of_v = np.stack([zero, -near, y * near, 1.0 + y * y, -x * y, -x])
    fx, fy = intrinsics[:2].astype(x.dtype)
    return of_u * fx, of_v * fy


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Image at (height, width): area filter when shrinking, linear when enlarging."""
    if image.shape[:2] == tuple(size):
        return image
    shrink = size[0] < image.shape[0]
    resized = cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    return np.asarray(resized)


def resampled(image: np.ndarray, theirs: np.ndarray, ours: np.ndarray, *, nearest: bool = False) -> np.ndarray:
    """(H, W) or (H, W, C) of a camera with intrinsics `theirs` (4,) as one with `ours` takes it from the same place.

    Cubic, the border repeated; nearest: for depth and masks, no averages, and 0 where there is none.
    """
    zoom = np.asarray(theirs[:2]) / ours[:2]
    shift = theirs[2:] - zoom * ours[2:]
    theirs_from_ours = np.array([[zoom[0], 0.0, shift[0]], [0.0, zoom[1], shift[1]]])
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    size = image.shape[1], image.shape[0]
    warped = cv2.warpAffine(image, theirs_from_ours, size, flags=how | cv2.WARP_INVERSE_MAP, borderMode=border)
    return np.asarray(warped)


def stretching(gray: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray | None:
    """(256,) uint8: the gray levels of a dark or hazy image (H, W) uint8 spread, so that texture shows as in any other.

    In a dark place lights do not count: with each that comes into view all would change otherwise. None for what needs
    it not, and for a black image, as of a covered lens, or a flat one, which show nothing.
    seen: (H, W) bool, where it counts; None: everywhere.
    """
    values = gray if seen is None else gray[seen]
    below = np.cumsum(np.bincount(values.ravel(), minlength=256))
    ends = 0.5 * np.array([1.0 - REST, 1.0 + REST])
    low, high = np.searchsorted(below, ends * below[-1])
    dark = np.searchsorted(below, (1.0 - LIGHTS) * below[-1])
    if high - low >= CONTRAST and dark < DARK:  # lights: what is white where the rest has contrast
        low, high = np.searchsorted(below, ends * below[dark * (255 - DARKEST) // CONTRAST])
    if high < BLACK or high - low < FLAT or high - low >= CONTRAST:
        return None
    gain = CONTRAST / float(high - low)
    return np.clip(gain * (np.arange(256.0) - low) + DARKEST, 0.0, 255.0).astype(np.uint8)


def mean_of_colors(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 of an image (H, W, 3) float32. NumPy's mean over an axis of three takes many times as long."""
    return np.asarray(cv2.transform(image, np.full((1, 3), 1.0 / 3.0, np.float32)))


def mask_at(mask: np.ndarray | None, size: tuple[int, ...]) -> np.ndarray | None:
    """A mask (H, W) bool at (height, width): True where all that a pixel covers counts; None: all pixels do."""
    if mask is None or mask.shape == size:
        return mask
    return np.asarray(resize_image(mask.astype(np.float32), (size[0], size[1])) > 0.999)


def shrunk(mask: np.ndarray, radius: int) -> np.ndarray:
    """The mask (H, W) bool without what is within `radius` pixels of its border; the image's own border takes none."""
    side = 2 * radius + 1
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def fit_size(height: int, width: int, area: int, multiple: int = 8) -> tuple[int, int]:
    """(height, width) of about `area` pixels, same aspect, both multiples of `multiple`; never enlarges."""
    factor = min(1.0, (area / (height * width)) ** 0.5)
    return (
        max(multiple, round(height * factor / multiple) * multiple),
        max(multiple, round(width * factor / multiple) * multiple),
    )
