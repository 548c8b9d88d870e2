"""What multi-view stereo keeps of a keyframe: gray images at the stages' sizes, pose, the tracker's coarse depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mvsgs_core import camera


@dataclass(frozen=True)
class StereoKeyframe:
    """One keyframe at the size that stereo works at."""

    index: int
    pyramid: tuple[np.ndarray, ...]  # (h / s, w / s) float32 gray levels minus 128, finest first, one per stage scale
    scales: tuple[int, ...]  # the s of the pyramid
    intrinsics: np.ndarray  # (4,) float64 at the finest size
    world_from_cam: np.ndarray  # (4, 4) float64
    scale: float  # of the map, that pose and inverse depths are in
    inverse_depth: np.ndarray  # (gh, gw) float32 the tracker's, 0 = unknown
    weight: np.ndarray  # (gh, gw) float32 0 to 1
    segment: int = 0
    mask: np.ndarray | None = None  # (h, w) bool at the finest size, False where it is to be ignored; None: nowhere

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) at the finest scale."""
        height, width = self.pyramid[0].shape
        return height, width

    def gray(self, scale: int) -> np.ndarray:
        return self.pyramid[self.scales.index(scale)]

    def intrinsics_at(self, scale: int) -> np.ndarray:
        return camera.scale_intrinsics(self.intrinsics, self.size, self.gray(scale).shape[:2])

    def moved(self, world_from_cam: np.ndarray, scale: float, segment: int | None = None) -> StereoKeyframe:
        """The same view after the tracker corrected its pose, the map's scale, and its segment, if that is given."""
        factor = np.float32(scale / self.scale)
        return replace(
            self, world_from_cam=world_from_cam, scale=float(scale), inverse_depth=self.inverse_depth / factor,
            segment=self.segment if segment is None else segment,
        )  # fmt: skip


def prepare_keyframe(
    index: int,
    image: np.ndarray,
    intrinsics: np.ndarray,
    world_from_cam: np.ndarray,
    *,
    area: int,
    scales: tuple[int, ...],
    inverse_depth: np.ndarray | None = None,
    weight: np.ndarray | None = None,
    scale: float = 1.0,
    segment: int = 0,
    mask: np.ndarray | None = None,
) -> StereoKeyframe:
    """A view of about `area` pixels, aspect kept, of an image (H, W, 3) uint8 with intrinsics (4,) at its own size.

    Without `inverse_depth` the caller must give a depth range. mask: (H, W) bool, False where a pixel is to be ignored:
    such pixels are flat, which matches nothing. Raises ValueError for a pose or intrinsics with NaN.
    """
    if not (np.isfinite(world_from_cam).all() and np.isfinite(intrinsics).all()):
        raise ValueError(f"keyframe {index}: pose or intrinsics are not finite")
    coarsest = max(scales)
    size = camera.fit_size(image.shape[0], image.shape[1], area, multiple=max(8, coarsest))
    gray = cv2.cvtColor(camera.resize_image(image, size), cv2.COLOR_RGB2GRAY).astype(np.float32) - 128.0
    seen = camera.mask_at(mask, size)
    if seen is not None:
        gray[~seen] = 0.0
    pyramid = tuple(
        np.ascontiguousarray(gray if s == 1 else camera.resize_image(gray, (size[0] // s, size[1] // s)))
        for s in sorted(scales)
    )
    unknown = np.zeros((1, 1), dtype=np.float32)
    grid = unknown if inverse_depth is None else np.asarray(inverse_depth, dtype=np.float32)
    return StereoKeyframe(
        index=index,
        pyramid=pyramid,
        scales=tuple(sorted(scales)),
        intrinsics=camera.scale_intrinsics(intrinsics, image.shape[:2], size),
        world_from_cam=np.asarray(world_from_cam, dtype=np.float64),
        scale=float(scale),
        inverse_depth=grid,
        weight=np.ones_like(grid) if weight is None else np.asarray(weight, dtype=np.float32),
        segment=segment,
        mask=seen,
    )
