"""What new splats look like: the points of a keyframe's depth, those of one rectangle of its image taken together.

MVS-GS, section III.C, "Online Densification". The paper makes a splat of each pixel below 40 dB and thins them by a
voxel filter; here each rectangle of a partition of the image that saves enough error gets one, see `partition`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.mapping.partition import Partition
from mvsgs_core.rasterizer.kernels import neutral_beta
from mvsgs_core.rasterizer.spherical_harmonics import from_rgb
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.setting_ranges import UNBOUNDED, above, at_least, within

MIN_COSINE = 0.25  # between ray and normal: a surface seen more slantingly is not stretched further
DOUBTFUL = 1e-3  # weight of a pixel of doubtful depth beside one of known depth


@dataclass(frozen=True)
class InsertionConfig:
    """Where splats are added and what they look like at first."""

    unexplored: bool = True  # only where the map's render differs from the image; false: as if there were no map
    # dissimilarity, as SSIM's, that a splat must mend (.11: 40 dB of a pixel amid gray ones); the noise of the view's
    # image, in the same unit, comes to it, so that it at most doubles
    price: float = 0.25
    # times a view's median error that a pixel of the map may have: blur, noise, pose
    median_errors: Annotated[float, UNBOUNDED] = 3.0
    min_opacity: float = 0.7  # rendered opacity below: the map shows nothing there, whatever the color
    doubtful: bool = True  # where it shows nothing, splats of doubtful or continued depth, too; false: it stays empty
    doubtful_confidence: float = 0.6  # from which such depth counts as known, where the map shows something else
    initial_scale: float = 0.6  # standard deviation over the side of the rectangle
    flatten: float = 0.3  # thickness along the normal over the smaller width; 1: as thick as that
    initial_opacity: float = 0.5  # 0 to 1 (Stereo-GS: 0.1)

    def __post_init__(self) -> None:
        at_least(self, price=0, median_errors=0)
        above(self, initial_scale=0, flatten=0)
        within(self, min_opacity=(0, 1), doubtful_confidence=(0, 1), initial_opacity=(0, 1))


@dataclass(frozen=True)
class Points:
    """Points to become splats, camera or world frame, float64."""

    positions: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3), 0 where unknown
    colors: np.ndarray  # (N, 3) 0 to 1
    tangents: np.ndarray  # (N, 2, 3) along the image's rows and columns: sides of the surface that a point stands for

    def __len__(self) -> int:
        return len(self.positions)

    def first(self, count: int) -> Points:
        """The first `count` of them."""
        return self.where(np.arange(len(self)) < count)

    def where(self, mask: np.ndarray) -> Points:
        """Those of a mask (N,) bool."""
        return Points(self.positions[mask], self.normals[mask], self.colors[mask], self.tangents[mask])


def points_from_depth(
    depth: np.ndarray, intrinsics: np.ndarray, image: np.ndarray, normals: np.ndarray | None, mask: np.ndarray
) -> Points:
    """Camera-frame points, one for each pixel of the mask.

    depth: (h, w), intrinsics (4,) at that size, image (h, w, 3) in [0, 1], normals (h, w, 3) or None, mask (h, w) bool.
    """
    positions, chosen, colors = _of_pixels(depth, intrinsics, image, normals, mask)
    return Points(positions, chosen, colors, _tangents(positions, chosen, intrinsics, np.ones((len(positions), 2))))


def _of_pixels(
    depth: np.ndarray, intrinsics: np.ndarray, image: np.ndarray, normals: np.ndarray | None, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and colors (N, 3) float64 of the pixels of the mask."""
    positions = camera.unproject(depth, intrinsics)[mask].astype(np.float64)
    chosen = np.zeros_like(positions) if normals is None else normals[mask].astype(np.float64)
    return positions, chosen, image[mask].astype(np.float64)


def points_of_rectangles(
    parts: Partition, depth: np.ndarray, known: np.ndarray, confidence: np.ndarray, intrinsics: np.ndarray,
    image: np.ndarray, normals: np.ndarray | None,
) -> Points:  # fmt: skip
    """Camera-frame points, one for each rectangle of a partition: the means of its pixels of known depth.

    depth, confidence: (h, w), of doubtful pixels too; known: (h, w) bool; others as in `points_from_depth`. Where no
    depth is known the point is on the mean ray at the most confident depth: a mean would lie between two surfaces.
    """
    mask = parts.labels >= 0
    labels, sure = parts.labels[mask], known[mask]
    of_pixels, normals_there, colors = _of_pixels(depth, intrinsics, image, normals, mask)
    weights = np.where(sure, 1.0, DOUBTFUL)
    total = np.bincount(labels, weights, minlength=len(parts))

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(labels, weights * column, minlength=len(parts)) for column in values.T]
        return np.asarray(np.stack(sums, axis=-1) / total[:, None])

    positions, normal = mean(of_pixels), mean(normals_there)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.5, normal / np.maximum(length, 1e-12), 0.0)
    order = np.lexsort((confidence[mask], labels))
    surest = order[np.flatnonzero(np.diff(labels[order], append=len(parts)))]
    doubtful = np.bincount(labels, sure, minlength=len(parts)) == 0
    positions[doubtful] *= (of_pixels[surest, 2] / positions[:, 2])[doubtful, None]
    fraction = np.bincount(labels, minlength=len(parts)) / parts.sides.prod(axis=1)
    sides = parts.sides * np.sqrt(fraction)[:, None]
    return Points(positions, normal, mean(colors), _tangents(positions, normal, intrinsics, sides))


def _tangents(positions: np.ndarray, normals: np.ndarray, intrinsics: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """(N, 2, 3) what a pixel's steps along its row and its column, `sides` (N, 2) times (rows, columns), are on the
    surface: facing the camera where the normal is unknown."""
    z = positions[:, 2]
    steps = np.zeros((len(positions), 2, 3))
    steps[:, 0, 0] = z / intrinsics[0] * sides[:, 1]
    steps[:, 1, 1] = z / intrinsics[1] * sides[:, 0]
    ray = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    known = np.linalg.norm(normals, axis=1) > 0.5
    cosine = np.where(known, np.minimum(np.sum(normals * ray, axis=1), -MIN_COSINE), -1.0)
    along = np.einsum("nj,nij->ni", normals, steps) / cosine[:, None]
    return np.asarray(steps - along[..., None] * ray[:, None])


def splats_from_points(
    points: Points, world_from_cam: np.ndarray, sh_bases: int, kernel: str, config: InsertionConfig
) -> Splats:
    """Splats in the world frame of `world_from_cam` (4, 4), float32 tensors on the CPU.

    The covariance is `initial_scale`^2 times the sum of the tangents' outer products, and along the normal `flatten`
    of the smaller tangent; all of it where the normal is unknown. The shape starts as a Gaussian: beta = 2, or b = 0
    for kernel "ges_scale".
    """
    count = len(points)
    rotation, translation = world_from_cam[:3, :3], world_from_cam[:3, 3]
    known = np.linalg.norm(points.normals, axis=1) > 0.5
    deviations, quaternions = ellipses(points.tangents @ rotation.T)
    thickness = np.linalg.norm(points.tangents, axis=2).min(axis=1, initial=np.inf)
    thickness = np.where(known, config.flatten, 1.0) * thickness
    scales = config.initial_scale * np.column_stack([deviations, thickness])
    opacity = min(max(config.initial_opacity, 1e-4), 1.0 - 1e-4)
    sh = np.zeros((count, sh_bases, 3))
    sh[:, 0] = from_rgb(points.colors)
    return Splats(
        means=_tensor(points.positions @ rotation.T + translation),
        log_scales=_tensor(np.log(np.maximum(scales, 1e-30))),
        quaternions=_tensor(quaternions),
        opacity_logits=_tensor(np.full(count, np.log(opacity / (1.0 - opacity)))),
        sh=_tensor(sh),
        betas=_tensor(np.full(count, neutral_beta(kernel))),
    )


def ellipses(tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half axes (N, 2) of X X^T + Y Y^T, X and Y the tangents (N, 2, 3), and the turn of them: quaternions (N, 4).

    Those, w first, turn x and y to the axes, z to the normal X x Y. Two tangents that are parallel have a turn, too.
    """
    first, second = tangents[:, 0], tangents[:, 1]
    normals = np.cross(first, second)
    area = np.linalg.norm(normals, axis=1, keepdims=True)
    turn = rotation_to(np.where(area > 0, normals / np.maximum(area, 1e-300), [0.0, 0.0, 1.0]))
    w, x, y, _ = turn.T
    axes = np.stack([
        np.stack([1 - 2 * y * y, 2 * x * y, -2 * w * y], axis=-1),
        np.stack([2 * x * y, 1 - 2 * x * x, 2 * w * x], axis=-1),
    ], axis=1)  # fmt: skip
    flat = np.einsum("nij,nkj->nik", tangents, axes)  # the tangents in the plane
    xx, yy, xy = (flat[..., 0] ** 2).sum(1), (flat[..., 1] ** 2).sum(1), (flat[..., 0] * flat[..., 1]).sum(1)
    half, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    angle = np.arctan2(2 * xy, xx - yy) / 4  # half the turn: a quaternion's
    cosine, sine = np.cos(angle), np.sin(angle)
    quaternions = np.stack([w * cosine, x * cosine + y * sine, y * cosine - x * sine, w * sine], axis=-1)
    return np.sqrt(np.maximum(np.stack([half + spread, half - spread], axis=-1), 0.0)), quaternions


def rotation_to(normals: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4), w first, that turn the z axis onto unit normals (N, 3); any turn for a normal of -z.

    The axis of the turn is in the plane of x and y: the last element is 0.
    """
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
