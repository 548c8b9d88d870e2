"""New splats from the depth of a keyframe: where the map does not show the image yet, thinned by a voxel filter.

MVS-GS, section III.C, "Online Densification". The paper's threshold (40 dB, an RMS error of 0.01) calls nearly every
textured pixel unexplored, and its voxel of 0.005 m has no meaning at a monocular scale: here both are relative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.rasterizer.kernels import neutral_beta
from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats

VOXELS = 1 << 21  # along an axis: what three of them in 63 bits can number
CHUNK = 65536  # of the map's splats that are sorted into voxels at once, in float64


@dataclass(frozen=True)
class InsertionConfig:
    """Where splats are added and what they look like at first."""

    unexplored: bool = True  # only where the map's render differs from the image; false: at every pixel with depth
    unexplored_psnr: float = 25.0  # dB of one pixel over RGB; below: unexplored (the paper: 40)
    unexplored_opacity: float = 0.5  # rendered opacity below: unexplored, whatever the color
    voxel: float = 0.01  # edge of the voxel filter in median depths; 0: no filter
    map_voxel: float = 0.01  # edge, in median depths, of the voxels in which one splat of the map is enough; 0: off
    map_voxel_error: float = 3.0  # there a pixel needs so many times the view's median error for another; .inf: none
    initial_scale: float = 0.5  # standard deviation in spacings of the points
    flatten: float = 0.1  # thickness along the normal over the width; 1: isotropic
    initial_opacity: float = 0.7  # 0 to 1 (Stereo-GS: 0.1)
    fill: int = 4  # pixels: cells that get a splat of doubtful or continued depth where the map stays empty; 0: off
    fill_below: float = 0.7  # rendered opacity below: empty; the optimization has no reason to close half a gap
    fill_opacity: float = 0.55  # of these: doubtful ones must be outshone by what comes later, 0 to 1
    fill_scale: float = 0.7  # of these, as initial_scale: so transparent, they leave no gap only where they overlap


@dataclass(frozen=True)
class Points:
    """Points to become splats, camera or world frame, float64 unless said otherwise."""

    positions: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3), 0 where unknown
    colors: np.ndarray  # (N, 3) 0 to 1
    spacing: np.ndarray  # (N,) side of the square of surface that a point stands for, in the positions' unit

    def __len__(self) -> int:
        return len(self.positions)

    def first(self, count: int) -> Points:
        """The first `count` of them."""
        return self.where(np.arange(len(self)) < count)

    def where(self, mask: np.ndarray) -> Points:
        """Those of a mask (N,) bool."""
        return Points(self.positions[mask], self.normals[mask], self.colors[mask], self.spacing[mask])


def unexplored_mask(
    rendered: np.ndarray, opacity: np.ndarray, observed: np.ndarray, config: InsertionConfig
) -> np.ndarray:
    """Pixels (H, W) bool that the map does not cover: PSNR of the pixel below the threshold, or low opacity.

    rendered, observed: (H, W, 3) in [0, 1]; opacity: (H, W). A pixel has PSNR 10 log10(1 / mean over RGB of (r - o)^2).
    """
    squared = np.mean((rendered - observed) ** 2, axis=-1)
    return (squared > 10.0 ** (-config.unexplored_psnr / 10.0)) | (opacity < config.unexplored_opacity)


def outliers(rendered: np.ndarray, opacity: np.ndarray, observed: np.ndarray, config: InsertionConfig) -> np.ndarray:
    """Pixels (H, W) bool whose RMS error over RGB is `map_voxel_error` times the median of the pixels that are mapped.

    The median is what blur, noise, exposure and a pose's error do to this view: no splat mends that. Where a view is
    covered to the decibel it is small, and detail that the map lacks stands out.
    """
    squared = np.mean((rendered - observed) ** 2, axis=-1)
    mapped = opacity >= config.unexplored_opacity
    if not mapped.any():
        return np.ones(squared.shape, dtype=bool)
    return squared > config.map_voxel_error**2 * np.median(squared[mapped])


def points_from_depth(
    depth: np.ndarray, intrinsics: np.ndarray, image: np.ndarray, normals: np.ndarray | None, mask: np.ndarray
) -> Points:
    """Camera-frame points of the masked pixels.

    depth: (h, w), intrinsics (4,) at that size, image (h, w, 3) in [0, 1], normals (h, w, 3) or None, mask (h, w) bool.
    A pixel stands for a surface of side z / f, more where the surface is known to be slanted.
    """
    positions = camera.unproject(depth, intrinsics)[mask]
    spacing = positions[:, 2] / float(np.sqrt(intrinsics[0] * intrinsics[1]))
    chosen = np.zeros_like(positions) if normals is None else normals[mask].astype(np.float64)
    cosine = np.abs(np.sum(chosen * positions, axis=1)) / np.linalg.norm(positions, axis=1)
    known = np.linalg.norm(chosen, axis=1) > 0.5
    spacing = np.where(known, spacing / np.sqrt(np.maximum(cosine, 0.25)), spacing)
    return Points(positions, chosen, image[mask].astype(np.float64), spacing)


def near_points(points: Points, config: InsertionConfig, median_depth: float) -> np.ndarray:
    """Camera-frame points (N,) bool that are near enough to be numbered by voxels, and for float32 to hold them.

    One far pixel, a mismatch, would else be all that a view adds: its voxels are as many as the rest's are small.
    """
    edges = [edge for edge in (config.voxel, config.map_voxel) if edge > 0]
    reach = min([1e6, *((VOXELS / 2 - 2) * edge for edge in edges)]) * median_depth
    return np.asarray(np.linalg.norm(points.positions, axis=1) < reach)


def voxel_filter(points: Points, edge: float) -> Points:
    """One point a voxel: the mean position, normal and color, and the side of the surface of all together.

    edge: > 0, in the points' unit. Raises ValueError where the points span more than 2^21 voxels along an axis.
    """
    if len(points) == 0:
        return points
    cells = _cells(points.positions, points.positions.min(axis=0), edge)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.stack([np.bincount(inverse, column, minlength=len(counts)) for column in values.T], axis=-1)
        return sums / counts[:, None]

    normals = mean(points.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    area = np.bincount(inverse, points.spacing**2, minlength=len(counts))
    return Points(
        mean(points.positions),
        np.where(length > 0.5, normals / np.maximum(length, 1e-12), 0.0),
        mean(points.colors),
        np.sqrt(area),
    )


def unoccupied(positions: np.ndarray, means: np.ndarray, edge: float) -> np.ndarray:
    """Positions (N, 3) whose voxel of side `edge` holds none of the map's means (M, 3): (N,) bool.

    The surface there is in the map already, and what its color lacks is the optimization's to find. Without this a
    noisy or blurred keyframe, which no map shows to the decibel, lays a second skin over what is mapped. Raises
    ValueError where the positions span more than 2^21 voxels along an axis.
    """
    if len(positions) == 0 or len(means) == 0:
        return np.ones(len(positions), dtype=bool)
    low = positions.min(axis=0)
    cells = _cells(positions, low, edge)
    count = cells.max(axis=0) + 1

    def key(cell: np.ndarray) -> np.ndarray:
        return (cell[:, 0] * count[1] + cell[:, 1]) * count[2] + cell[:, 2]

    taken = []
    for some in np.array_split(means, -(-len(means) // CHUNK)):
        others = np.floor((some - low) / edge)
        taken.append(key(others[((others >= 0) & (others < count)).all(axis=1)].astype(np.int64)))
    return ~np.isin(key(cells), np.concatenate(taken))


def _cells(positions: np.ndarray, low: np.ndarray, edge: float) -> np.ndarray:
    """Voxels (N, 3) int64 of positions (N, 3) from `low` (3,) on. Raises ValueError beyond `VOXELS`."""
    cells = np.floor((positions - low) / edge)
    if not cells.max() < VOXELS:
        raise ValueError(f"voxels of {edge:g} are too small for points that span {cells.max() * edge:g}: enlarge voxel")
    return cells.astype(np.int64)


def splats_from_points(
    points: Points,
    world_from_cam: np.ndarray,
    sh_bases: int,
    kernel: str,
    config: InsertionConfig,
    opacity: float | None = None,
    scale: float | None = None,
) -> Splats:
    """Splats in the world frame of `world_from_cam` (4, 4), float32 tensors on the CPU.

    opacity: of all; None: `initial_opacity`. Standard deviations are `scale` (None: `initial_scale`) spacings,
    `flatten` of that along a known normal. The shape starts as a Gaussian: beta = 2, or b = 0 for kernel "ges_scale".
    """
    count = len(points)
    rotation, translation = world_from_cam[:3, :3], world_from_cam[:3, 3]
    means = points.positions @ rotation.T + translation
    normals = points.normals @ rotation.T
    known = np.linalg.norm(normals, axis=1) > 0.5
    scale = config.initial_scale if scale is None else scale
    log_scales = np.repeat(np.log(np.maximum(points.spacing * scale, 1e-30))[:, None], 3, axis=1)
    log_scales[known, 2] += np.log(config.flatten)
    opacity = min(max(config.initial_opacity if opacity is None else opacity, 1e-4), 1.0 - 1e-4)
    sh = np.zeros((count, sh_bases, 3))
    sh[:, 0] = (points.colors - 0.5) / C0
    return Splats(
        means=_tensor(means),
        log_scales=_tensor(log_scales),
        quaternions=_tensor(np.where(known[:, None], rotation_to(normals), [1.0, 0.0, 0.0, 0.0])),
        opacity_logits=_tensor(np.full(count, np.log(opacity / (1.0 - opacity)))),
        sh=_tensor(sh),
        betas=_tensor(np.full(count, neutral_beta(kernel))),
    )


def rotation_to(normals: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4), w first, that turn the z axis onto unit normals (N, 3); any turn for a normal of -z."""
    x, y, z = normals.T
    w = 1.0 + z
    q = np.stack([w, -y, x, np.zeros_like(w)], axis=-1)
    q = np.where((w > 1e-6)[:, None], q, [0.0, 1.0, 0.0, 0.0])
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def depth_colors(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Colors (h, w, 3) float64 in [0, 1] of an image (H, W, 3) uint8 at the depth map's size."""
    return camera.resize_image(image, size).astype(np.float64) / 255.0


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
