"""Keyframes as they come to the mapper, and as it trains on them: image, pose, exposure, convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from mvsgs_core import camera
from mvsgs_core.geometry import Similarity
from mvsgs_core.photometry import IDENTITY, compose, inverse
from mvsgs_core.setting_ranges import at_least, within

CELLS = 48  # of the grid on which a keyframe's surface is kept, in either direction
HALF_MAX = float(np.finfo(np.float16).max)


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
    exposure: np.ndarray | None = None  # (3, 4) color affine that the tracker estimated; None: not known
    vignetting: np.ndarray | None = None  # (3,) of the sensor, the same
    photograph: np.ndarray | None = None  # (H, W, 3) uint8 as a rolling shutter took it, of which `image` is free
    velocity: np.ndarray | None = None  # (6,) of the camera, as in `msgs`; with a photograph only
    readout_time: float = 0.0  # seconds from the first row of the photograph to the last
    reads_columns: bool = False  # from its first column to the last, that is
    mask: np.ndarray | None = None  # (H, W) bool, False where a pixel is no part of the scene; None: all are


@dataclass(frozen=True)
class ConvergenceConfig:
    """When a keyframe is trained enough: mostly passed over then."""

    skip: bool = True  # pass over keyframes whose loss no longer falls
    visits: int = 30  # iterations on a keyframe before it can count as converged
    improvement: float = 0.02  # fraction by which the loss must still fall
    keep: float = 0.5  # fraction of the visits that a converged keyframe still gets

    def __post_init__(self) -> None:
        at_least(self, visits=0, improvement=0)
        within(self, keep=(0, 1))


@dataclass
class TrainingView:
    """A keyframe to train on."""

    index: int
    image: Tensor  # (H, W, 3) uint8 at the training size; empty where it was let go
    intrinsics: np.ndarray  # (4,) at that size
    image_intrinsics: np.ndarray  # (4,) at image_size
    image_size: tuple[int, int]  # height, width of the image as it came
    timestamp: float  # seconds; NaN: not known
    world_from_cam: np.ndarray  # (4, 4) float64, world units
    scale: float
    local_from_cam: np.ndarray  # (4, 4) float64, in the mapper's frame and unit
    exposure: Tensor  # (3, 4) color affine [A | b] that it is rendered with: `measured`, or the identity
    measured: np.ndarray | None = None  # (3, 4) the tracker's; None: there is none
    pose_delta: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4) from the tracker's camera to the refined
    pose_moments: np.ndarray = field(default_factory=lambda: np.zeros((2, 6)))  # of (translation, rotation)
    pose_steps: int = 0
    fixed: bool = False  # its pose is not refined: it holds the frame of reference
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(6))  # of the camera, twist a second, mapper's unit
    readout_time: float = 0.0  # seconds from the image's first row to its last; 0: all rows at once, or not known
    reads_columns: bool = False  # from its first column to its last, that is
    image_on_disk: bool = False  # see resting_images.py
    as_taken: bool = True  # no shutter is taken out of the image: renders are as that saw it, as soon as it is known
    median_depth: float = 0.0  # of its depth map, in the mapper's unit; 0: it has none
    surface: np.ndarray | None = None  # (3, CELLS, CELLS) of that, in that unit, see free_space.py; None: not known
    mean_color: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) of its image, 0 to 1; 0: not known
    valid: Tensor | None = None  # (H, W) bool; None: every pixel is
    visits: int = 0  # training iterations so far
    visits_here: int = 0  # of these since its pose was last corrected
    loss_fast: float = field(default=float("nan"))  # running means of the loss of these
    loss_slow: float = field(default=float("nan"))
    loss_before: float = field(default=float("nan"))  # its pose was corrected, to come back to; NaN: nothing is owed

    @property
    def refined_from_cam(self) -> np.ndarray:
        """(4, 4) the pose to train and render from: the tracker's, and what the map made of it."""
        return self.local_from_cam @ self.pose_delta

    @property
    def readout(self) -> np.ndarray | None:
        """(6,) twist of the camera while the image was read, see `rasterize`; None: all rows at once."""
        return self.readout_time * self.velocity if self.readout_time else None

    @property
    def has_image(self) -> bool:
        return self.image.numel() > 0

    @property
    def size(self) -> tuple[int, int]:
        """Height, width of the training image."""
        height, width = self.image.shape[:2]
        return height, width

    @property
    def target(self) -> Tensor:
        """Image (H, W, 3) float32 in [0, 1]."""
        return self.image.to(self.exposure.device, torch.float32).div_(255.0)

    def intrinsics_at(self, size: tuple[int, int]) -> np.ndarray:
        """(4,) at another size (height, width)."""
        return camera.scale_intrinsics(self.image_intrinsics, self.image_size, size)

    def smaller(self, halvings: int) -> TrainingView:
        """The same keyframe with half as many rows and columns, so many times."""
        if not halvings:
            return self
        height, width = self.size
        size = max(1, height >> halvings), max(1, width >> halvings)
        image = torch.from_numpy(np.array(camera.resize_image(self.image.cpu().numpy(), size))).to(self.image.device)
        valid = self.valid
        if valid is not None:
            valid = torch.from_numpy(camera.mask_at(valid.cpu().numpy(), size)).to(self.exposure.device)
        return replace(self, image=image, valid=valid, intrinsics=self.intrinsics_at(size))

    def rectified(self, image: np.ndarray) -> TrainingView:
        """The same keyframe with its image (H, W, 3) uint8 as it is without the rolling shutter."""
        resized = torch.from_numpy(np.array(camera.resize_image(image, self.size))).to(self.image.device)
        return replace(self, image=resized, velocity=np.zeros(6), readout_time=0.0)

    def footprint(self) -> np.ndarray:
        """(4, 3) corners of what it sees, at its median depth, in the mapper's frame."""
        fx, fy, cx, cy = self.intrinsics
        height, width = self.size
        x, y = (np.array([0, width - 1, 0, width - 1]) - cx) / fx, (np.array([0, 0, height - 1, height - 1]) - cy) / fy
        corners = self.median_depth * np.stack([x, y, np.ones(4)], axis=-1)
        return np.asarray(corners @ self.local_from_cam[:3, :3].T + self.local_from_cam[:3, 3])

    def drop_image(self) -> None:
        """Frees what only the training needs; pose, scale and exposure stay."""
        self.image, self.valid, self.image_on_disk = self.image.new_zeros((0, 0, 3)), None, False
        self.surface = None

    def rescale(self, factor: float) -> None:
        """Lengths in a unit of 1 / `factor` of what it was; the moments follow, a gradient is divided by `factor`."""
        self.median_depth *= factor
        if self.surface is not None:
            depths = np.minimum(self.surface[:2].astype(np.float64) * factor, HALF_MAX)
            self.surface = np.concatenate([depths, self.surface[2:]]).astype(np.float16)
        self.velocity[:3] *= factor
        self.pose_delta[:3, 3] *= factor
        self.pose_moments[0, :3] /= factor
        self.pose_moments[1, :3] /= factor**2

    def take_photograph(
        self, photograph: np.ndarray, velocity: np.ndarray, readout_time: float, reads_columns: bool = False
    ) -> None:
        """From here on the image is the photograph (H, W, 3) uint8 as a rolling shutter took it, and renders are, too.

        velocity: (6,) of the camera, a twist a second in its own axes, in the mapper's unit.
        """
        resized = torch.from_numpy(np.array(camera.resize_image(photograph, self.size)))
        self.image, self.velocity = resized.to(self.exposure.device), velocity
        self.readout_time, self.reads_columns = readout_time, reads_columns
        self.as_taken, self.image_on_disk = True, False

    def place(self, world_from_cam: np.ndarray, local_from_cam: np.ndarray, scale: float) -> Similarity:
        """A corrected pose and scale; returns how what was seen from it moves, in the mapper's frame."""
        moved = Similarity.between(self.local_from_cam, local_from_cam, scale / self.scale)
        self.world_from_cam, self.local_from_cam = world_from_cam, local_from_cam
        self.rescale(scale / self.scale)
        self.scale = scale
        return moved

    def expose(self, measured: np.ndarray | None) -> np.ndarray:
        """A corrected exposure (3, 4), None: none any more; returns the affine (3, 4) its map colors take, so that
        its own splats look as before."""
        old = IDENTITY if self.measured is None else self.measured
        change = compose(inverse(IDENTITY if measured is None else measured), old)
        self.take_exposure(measured)
        return change

    def take_exposure(self, measured: np.ndarray | None) -> None:
        """Rendered with it, (3, 4), from here on; None: with the identity."""
        self.exposure, self.measured = exposure_of(measured, self.exposure.device), measured

    def record(self, loss: float) -> None:
        """Takes in the loss of an iteration."""
        self.visits_here += 1
        if loss <= self.loss_before:
            self.loss_before = float("nan")
        if self.visits_here == 1:
            self.loss_fast = self.loss_slow = loss
            return
        self.loss_fast += 0.2 * (loss - self.loss_fast)
        self.loss_slow += 0.05 * (loss - self.loss_slow)

    def converged(self, config: ConvergenceConfig) -> bool:
        """Visited often enough, and the loss no longer falls by `improvement` between slow and fast mean."""
        if self.visits_here < config.visits or not self.loss_slow > 0:
            return False
        return (self.loss_slow - self.loss_fast) / self.loss_slow < config.improvement

    def begin_anew(self, moved: bool = False) -> None:
        """Its pose has changed: what was known of its convergence says nothing any more.

        moved: by so much that what it sees was trained at the wrong place; it is trained until its loss is back.
        """
        if moved and math.isnan(self.loss_before):
            self.loss_before = self.loss_fast
        self.visits_here, self.loss_fast, self.loss_slow = 0, float("nan"), float("nan")

    def owed(self, limit: int) -> bool:
        """Whether its loss has not come back yet since its pose was corrected, in fewer than `limit` visits."""
        return not math.isnan(self.loss_before) and self.visits_here < limit


def training_view(
    keyframe: RGBDKeyframe, local_from_cam: np.ndarray, max_pixels: int | None, device: torch.device
) -> TrainingView:
    """The image and state of a new keyframe. max_pixels: area of the training image; None: the image's own."""
    height, width = keyframe.image.shape[:2]
    size = (height, width) if max_pixels is None else camera.fit_size(height, width, max_pixels, multiple=1)
    image, valid = checked_image(keyframe.image)
    if keyframe.mask is not None:
        valid = keyframe.mask if valid is None else valid & keyframe.mask
    valid = camera.mask_at(valid, size)
    resized = np.array(camera.resize_image(image, size))
    return TrainingView(
        index=keyframe.index,
        image=torch.from_numpy(resized).to(device),
        intrinsics=camera.scale_intrinsics(keyframe.intrinsics, (height, width), size),
        image_intrinsics=np.asarray(keyframe.intrinsics, dtype=np.float64),
        image_size=(height, width),
        timestamp=keyframe.timestamp,
        world_from_cam=np.asarray(keyframe.world_from_cam, dtype=np.float64),
        scale=keyframe.scale,
        local_from_cam=local_from_cam,
        exposure=exposure_of(None, device),
        valid=None if valid is None else torch.from_numpy(valid.copy()).to(device),  # messages are read-only
        mean_color=mean_color(resized, valid),
    )


def exposure_of(measured: np.ndarray | None, device: torch.device) -> Tensor:
    """(3, 4) float32 that a view of this measured exposure is rendered with."""
    return torch.tensor(IDENTITY if measured is None else measured, dtype=torch.float32, device=device)


def mean_color(image: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """(3,) float64, 0 to 1, of an image (H, W, 3) uint8 at the pixels that are valid, (H, W) bool; 0 where none is."""
    mask = None if valid is None else valid.astype(np.uint8)
    return np.array(cv2.mean(image, mask)[:3]) / 255.0  # NumPy takes eighty times as long


def median_of_known(depth: np.ndarray) -> float:
    """Of the depths that are known, 0 where none is."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(known)) if len(known) else 0.0


def checked_image(image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """uint8 image and its valid pixels (H, W) bool, None if all are."""
    if image.dtype == np.uint8:
        return image, None
    valid = np.isfinite(image).all(axis=-1)
    clean = np.where(valid[..., None], image, 0.0)
    return np.round(np.clip(clean, 0.0, 1.0) * 255.0).astype(np.uint8), None if valid.all() else valid
