"""From a camera image to the one that the networks see, and from the 1/8 map back to the camera's field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.camera import resize_image, scale_intrinsics
from mvsgs_core.droid.config import LEAST_SIDE
from mvsgs_core.networks.droid import STRIDE

_MIN_CELLS = LEAST_SIDE // STRIDE  # each way


@dataclass(frozen=True)
class Framing:
    """Resized to an area at the same aspect, then cut at the right and below to multiples of 8. Sizes: (h, w)."""

    source: tuple[int, int]
    resized: tuple[int, int]

    @staticmethod
    def of(height: int, width: int, area: int) -> Framing:
        """Raises ValueError where the map would be too small for the correlation pyramid."""
        factor = math.sqrt(area / (height * width))
        # the sum keeps an exact product such as 480 * 0.8 from being rounded down
        framing = Framing((height, width), (int(height * factor + 1e-6), int(width * factor + 1e-6)))
        if min(framing.grid) < _MIN_CELLS:
            raise ValueError(
                f"images of {width}x{height} at an area of {area} pixels give a map of {framing.grid[1]}x"
                f"{framing.grid[0]} cells; DROID-SLAM needs {_MIN_CELLS} each way: give a larger area"
            )
        return framing

    @property
    def grid(self) -> tuple[int, int]:
        """Cells (h, w) of the 1/8 map."""
        return self.resized[0] // STRIDE, self.resized[1] // STRIDE

    def image(self, image: np.ndarray) -> np.ndarray:
        """(8h, 8w, 3) uint8 of an (H, W, 3) image."""
        h, w = self.grid
        return np.ascontiguousarray(resize_image(image, self.resized)[: STRIDE * h, : STRIDE * w])

    def intrinsics(self, intrinsics: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
        """(4,) in cells: the receptive field of cell k is centered at pixel 8k, so there is no half-pixel term.

        size: of the image that they are of, where that is not `source`.
        """
        return scale_intrinsics(intrinsics, size or self.source, self.resized) / STRIDE

    def whole_view(self, cells: np.ndarray) -> np.ndarray:
        """An (h, w) map of the cells, sampled anew so that h by w equal cells cover the whole source image."""
        h, w = self.grid
        rows = ((np.arange(h) + 0.5) * self.resized[0] / h - 0.5) / STRIDE
        columns = ((np.arange(w) + 0.5) * self.resized[1] / w - 0.5) / STRIDE
        u, v = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        sampled = cv2.remap(cells.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(sampled)


__all__ = ["Framing"]
