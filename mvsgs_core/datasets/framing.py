"""From the picture that a camera took to the one that is delivered: undistorted, resized, cropped."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.camera import fit_size, resize_image, scale_intrinsics
from mvsgs_core.datasets.lens import Lens, Undistortion

Size = tuple[int, int] | Sequence[int] | int | None
# Pixels of a frame where no size was asked for: robots' cameras (1280x1024) stay as they are; 4K would take hours.
LARGEST = 1_500_000
SMALLEST = 12  # pixels of a side: on smaller ones nothing is found, and flows fail
_KEPT = 4  # undistortion maps in memory: most sequences have one camera, some a camera for each image


def target_size(size: Size, native: tuple[int, int]) -> tuple[int, int]:
    """(height, width) to deliver: `size` itself, or at most `size` pixels at the same aspect if it is one number, by
    default LARGEST. Raises ValueError for a size that is none.
    """
    if size is None:
        return native if native[0] * native[1] <= LARGEST else fit_size(*native, area=LARGEST)
    if isinstance(size, int):
        fitted = fit_size(*native, area=size) if size > 0 else (0, 0)
        if min(fitted) < SMALLEST:
            raise ValueError(
                f"size={size} is too few pixels: a side of {native[1]}x{native[0]} would be below {SMALLEST}"
            )
        return fitted
    if len(size) != 2 or any(side < SMALLEST for side in size):
        raise ValueError(
            f"size is [height, width] of at least {SMALLEST} pixels each, a count of pixels or null; got {size}"
        )
    return int(size[0]), int(size[1])


def resize_depth(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth map at (height, width): the nearest sample, taken at pixel centers, never an average."""
    if depth.shape == size:
        return depth
    return np.asarray(cv2.resize(depth, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT))


def same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Sizes of one aspect ratio, to a percent (a scaled copy is rounded to whole pixels)."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= 0.01 * a[1] * b[0]


class Framing:
    """Brings every frame of a sequence to one size; the intrinsics follow.

    size: [height, width], or a number of pixels at the same aspect; null: as it is, up to LARGEST pixels.
    crop: null zooms in until undistortion leaves no empty pixel; a number keeps the focal length, resizes to `size`
    plus that many pixels on each side and cuts them off. Raises ValueError for a size or crop that is none.
    """

    def __init__(self, size: Size = None, crop: int | None = None) -> None:
        if crop is not None and crop < 0:
            raise ValueError(f"crop is a number of pixels, got {crop}")
        target_size(size, (480, 640))
        self._size = size
        self._crop = crop
        self._undistortions: dict[Lens, Undistortion] = {}

    def size_of(self, native: tuple[int, int]) -> tuple[int, int]:
        """(height, width) of what an image of size `native` becomes. Raises BadFileError where that is too small."""
        if self._size is None and self._crop:  # nothing to resize to, so cropping makes the image smaller
            size = native[0] - 2 * self._crop, native[1] - 2 * self._crop
        else:
            size = target_size(self._size, native)
        if min(size) < SMALLEST:
            less, remedy = (f" less {self._crop} on each side", " or a smaller crop") if self._crop else ("", "")
            raise BadFileError(
                f"images of {native[1]}x{native[0]} pixels{less} are too small, {SMALLEST} a side are the least: "
                f"take larger ones{remedy}"
            )
        return size

    def notice(self, native: tuple[int, int]) -> list[str]:
        """What to say where images of size `native` are made smaller though nobody asked for that."""
        size = self.size_of(native)
        if self._size is not None or self._crop or size == native:
            return []
        return [
            f"frames of {native[1]}x{native[0]} are processed at {size[1]}x{size[0]}; another size: dataset.size="
            f"[height,width], or a number of pixels ({native[0] * native[1]} for as they are)"
        ]

    def image(self, image: np.ndarray, lens: Lens, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 of a lens's own size -> image at `size`, which has intrinsics (4,)."""
        undistortion = self._undistortion(lens)
        padded, inside = self._border(size)
        border = self._crop or 0
        intrinsics = scale_intrinsics(undistortion.intrinsics, lens.size, padded) - (0.0, 0.0, border, border)
        return np.ascontiguousarray(resize_image(undistortion.image(image), padded)[inside]), intrinsics

    def depth(self, depth: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
        """(h, w) float32 of any size, registered to that lens's image -> depth map at `size`."""
        padded, inside = self._border(size)
        whole = self._undistortion(lens).depth(resize_depth(depth, lens.size))
        return np.ascontiguousarray(resize_depth(whole, padded)[inside])

    def mask(self, mask: np.ndarray, lens: Lens, size: tuple[int, int]) -> np.ndarray:
        """(h, w) bool of any size, of that lens's image -> mask at `size`; False where the lens saw nothing."""
        return self.depth(mask.astype(np.uint8), lens, size) > 0

    def _border(self, size: tuple[int, int]) -> tuple[tuple[int, int], tuple[slice, slice]]:
        border = self._crop or 0
        inside = slice(border, border + size[0]), slice(border, border + size[1])
        return (size[0] + 2 * border, size[1] + 2 * border), inside

    def _undistortion(self, lens: Lens) -> Undistortion:
        if lens not in self._undistortions:
            if len(self._undistortions) == _KEPT:
                del self._undistortions[next(iter(self._undistortions))]
            self._undistortions[lens] = Undistortion(lens, fill=self._crop is None)
        return self._undistortions[lens]
