"""Keyframes as the mapper trains on them: image pyramid, pose, exposure, and what is known of their convergence."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import camera


@dataclass(frozen=True)
class RGBDKeyframe:
    """A keyframe with its depth, as it comes to the mapper."""

    index: int
    image: np.ndarray  # (H, W, 3) RGB, uint8, or float in [0, 1], where NaN and Inf mark pixels to leave out
    intrinsics: np.ndarray  # (4,) at the image's size
    world_from_cam: np.ndarray  # (4, 4) float64
    depth: np.ndarray  # (h, w) float32, 0 where unknown
    scale: float = 1.0  # cumulative scale of the map that pose and depth are in
    confidence: np.ndarray | None = None  # (h, w) 0 to 1
    normals: np.ndarray | None = None  # (h, w, 3), camera frame, 0 where unknown
    unfiltered: np.ndarray | None = None  # (h, w) float32 depth before the filters, 0 where unknown
    timestamp: float = float("nan")  # seconds; NaN: not known


@dataclass
class TrainingView:
    """A keyframe to train on. `levels[l]` is the image at 1/2^l of the training size, (H, W, 3) uint8."""

    index: int
    levels: list[Tensor]
    intrinsics: list[np.ndarray]  # (4,) for each level
    image_intrinsics: np.ndarray  # (4,) at image_size
    image_size: tuple[int, int]  # height, width of the image as it came
    timestamp: float  # seconds; NaN: not known
    world_from_cam: np.ndarray  # (4, 4) float64, world units
    scale: float
    local_from_cam: np.ndarray  # (4, 4) float64, in the mapper's frame and unit
    exposure: Tensor  # (3, 4) color affine [A | b]
    exposure_moments: tuple[Tensor, Tensor]
    pose_delta: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4) from the tracker's camera to the refined
    pose_moments: np.ndarray = field(default_factory=lambda: np.zeros((2, 6)))  # of (translation, rotation)
    pose_steps: int = 0
    fixed: bool = False  # its pose is not refined: it holds the frame of reference
    median_depth: float = 0.0  # of its depth map, in the mapper's unit; 0: it has none
    valid: list[Tensor] | None = None  # (H, W) bool for each level; None: every pixel is
    visits: int = 0  # training iterations so far
    visits_full: int = 0  # of these at full resolution
    loss_fast: float = field(default=float("nan"))  # running means of the full-resolution loss
    loss_slow: float = field(default=float("nan"))

    @property
    def refined_from_cam(self) -> np.ndarray:
        """(4, 4) the pose to train and render from: the tracker's, and what the map made of it."""
        return self.local_from_cam @ self.pose_delta

    def size(self, level: int) -> tuple[int, int]:
        height, width = self.levels[level].shape[:2]
        return height, width

    def target(self, level: int) -> Tensor:
        """Image (H, W, 3) float32 in [0, 1]."""
        return self.levels[level].to(torch.float32) / 255.0

    def drop_images(self) -> None:
        """Frees what only the training needs; pose, scale and exposure stay."""
        self.levels, self.valid = [], None

    def rescale(self, factor: float) -> None:
        """Lengths in a unit of 1 / `factor` of what it was; the moments follow, a gradient is divided by `factor`."""
        self.median_depth *= factor
        self.pose_delta[:3, 3] *= factor
        self.pose_moments[0, :3] /= factor
        self.pose_moments[1, :3] /= factor**2

    def record(self, loss: float) -> None:
        """Takes in the loss of a full-resolution iteration."""
        self.visits_full += 1
        if self.visits_full == 1:
            self.loss_fast = self.loss_slow = loss
            return
        self.loss_fast += 0.2 * (loss - self.loss_fast)
        self.loss_slow += 0.05 * (loss - self.loss_slow)

    def converged(self, min_visits: int, improvement: float) -> bool:
        """After `min_visits` the loss no longer falls by the share `improvement` between slow and fast mean."""
        if self.visits_full < min_visits or not self.loss_slow > 0:
            return False
        return (self.loss_slow - self.loss_fast) / self.loss_slow < improvement


def training_view(
    view: RGBDKeyframe, local_from_cam: np.ndarray, max_pixels: int | None, level_count: int, device: torch.device
) -> TrainingView:
    """The pyramid and state of a new keyframe. max_pixels: area of the training image; None: the image's own."""
    height, width = view.image.shape[:2]
    size = (height, width) if max_pixels is None else camera.fit_size(height, width, max_pixels, multiple=1)
    image, valid = _checked_image(view.image)
    levels, intrinsics, valid_levels = [], [], []
    for level in range(level_count):
        level_size = (max(1, size[0] >> level), max(1, size[1] >> level))
        levels.append(torch.from_numpy(np.array(camera.resize_image(image, level_size))).to(device))
        if valid is not None:
            share = camera.resize_image(valid.astype(np.float32), level_size)
            valid_levels.append(torch.from_numpy(np.array(share > 0.999)).to(device))
        intrinsics.append(camera.scale_intrinsics(view.intrinsics, (height, width), level_size))
    identity = torch.eye(3, 4, device=device)
    return TrainingView(
        index=view.index,
        levels=levels,
        intrinsics=intrinsics,
        image_intrinsics=np.asarray(view.intrinsics, dtype=np.float64),
        image_size=(height, width),
        timestamp=view.timestamp,
        world_from_cam=np.asarray(view.world_from_cam, dtype=np.float64),
        scale=view.scale,
        local_from_cam=local_from_cam,
        exposure=identity.clone(),
        exposure_moments=(torch.zeros_like(identity), torch.zeros_like(identity)),
        valid=valid_levels or None,
    )


def _checked_image(image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """uint8 image and its valid pixels (H, W) bool, None if all are."""
    if image.dtype == np.uint8:
        return image, None
    valid = np.isfinite(image).all(axis=-1)
    clean = np.where(valid[..., None], image, 0.0)
    return np.round(np.clip(clean, 0.0, 1.0) * 255.0).astype(np.uint8), None if valid.all() else valid
