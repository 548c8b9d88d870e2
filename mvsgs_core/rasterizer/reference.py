"""The rasterizer in plain PyTorch: every splat against every pixel, gradients by autograd, in float32 or float64.

Slow and obvious: it says what the fast back ends must compute.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mvsgs_core.rasterizer import interface, kernels, spherical_harmonics
from mvsgs_core.rasterizer.interface import Backward, Render, RenderSettings
from mvsgs_core.rasterizer.splats import Splats

PAIRS_AT_ONCE = 1 << 22  # splat-pixel pairs held in memory at a time


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """(N, 3, 3) of quaternions (N, 4), w first, normalized here."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def usable(splats: Splats) -> Tensor:
    """(N,) bool: all parameters finite, quaternion not 0."""
    finite = [torch.isfinite(tensor.flatten(1) if tensor.dim() > 1 else tensor[:, None]).all(dim=1)
              for tensor in splats.tensors().values()]  # fmt: skip
    return torch.stack(finite).all(dim=0) & (splats.quaternions.norm(dim=-1) > interface.MIN_QUATERNION)


def slopes(points: Tensor, settings: RenderSettings) -> tuple[Tensor, Tensor]:
    """x/z and y/z (N,), clamped to the image and a margin around it."""
    fx, fy, cx, cy = settings.intrinsics
    height, width = settings.size
    x, y, z = points.unbind(-1)
    margin_x, margin_y = (interface.CLAMP_MARGIN * 0.5 * n / f for n, f in ((width, fx), (height, fy)))
    slope_x = (x / z).clamp(-(cx + 0.5) / fx - margin_x, (width - 0.5 - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-(cy + 0.5) / fy - margin_y, (height - 0.5 - cy) / fy + margin_y)
    return slope_x, slope_y


def axes_on_image(splats: Splats, points: Tensor, settings: RenderSettings) -> Tensor:
    """(N, 2, 3) in px: the splats' axes, each one standard deviation long, projected by the Jacobian at `points`."""
    fx, fy, _, _ = settings.intrinsics
    z = points[:, 2]
    slope_x, slope_y = slopes(points, settings)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * slope_x / z], -1), torch.stack([zero, fy / z, -fy * slope_y / z], -1)], -2
    )
    cam_from_world = settings.pose[:3, :3].T.to(points)
    axes = rotation_matrices(splats.quaternions) * torch.exp(splats.log_scales)[:, None, :]
    return jacobian @ cam_from_world @ axes


def motion(points: Tensor, settings: RenderSettings) -> Tensor:
    """(N, 2) px by which camera-frame points (N, 3) move on the image while it is read."""
    fx, fy, _, _ = settings.intrinsics
    height, width = settings.size
    v_x, v_y, v_z, w_x, w_y, w_z = settings.readout
    (a, b), q = slopes(points, settings), 1.0 / points[:, 2]
    nearer = v_z * q + w_x * b - w_y * a
    x = fx * (w_z * b - w_y - v_x * q + a * nearer)
    y = fy * (w_x - w_z * a - v_y * q + b * nearer)
    most = interface.MAX_MOTION
    return torch.stack([x.clamp(-most * width, most * width), y.clamp(-most * height, most * height)], dim=-1)


def as_read(centers: Tensor, axes: Tensor, moves: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Centers (N, 2) and axes (N, 2, 3) on the image as a rolling shutter sees what moves by `moves` (N, 2)."""
    stretch = 1.0 / (1.0 - moves[:, 1] / height)
    late = (centers[:, 1] / height - 0.5) * stretch
    x, y = axes.unbind(1)
    sheared = x + (moves[:, 0] * stretch / height)[:, None] * y
    return centers + late[:, None] * moves, torch.stack([sheared, stretch[:, None] * y], dim=1)


@dataclass
class Projected:
    """Splats on the image."""

    centers: Tensor  # (N, 2) px
    depths: Tensor  # (N,)
    xx: Tensor  # (N,) covariance with blur, px^2
    xy: Tensor
    yy: Tensor
    determinant: Tensor  # (N,)
    opacity: Tensor  # (N,)
    colors: Tensor  # (N, 3)
    betas: Tensor  # (N,)


def project(splats: Splats, means2d: Tensor, settings: RenderSettings) -> Projected:
    """EWA projection of usable splats in front of the camera; `means2d` (N, 2) moves them, unit half the image."""
    fx, fy, cx, cy = settings.intrinsics
    height, width = settings.size
    dtype, device = splats.means.dtype, splats.means.device
    pose = settings.pose.to(device)
    from_camera = splats.means.double() - pose[:3, 3]
    points = (from_camera @ pose[:3, :3]).to(dtype)
    depths = points[:, 2]
    centers = torch.stack([fx * points[:, 0] / depths + cx, fy * points[:, 1] / depths + cy], dim=-1)
    axes = axes_on_image(splats, points, settings)
    if any(settings.readout):
        centers, axes = as_read(centers, axes, motion(points, settings), height)
    centers = centers + means2d * torch.tensor([0.5 * width, 0.5 * height], dtype=dtype, device=device)

    row_x, row_y = axes.unbind(1)
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    # the determinant as a sum of squares (Lagrange's identity): no cancellation for needles
    sharp = torch.linalg.cross(row_x, row_y).square().sum(-1)
    determinant = sharp + interface.BLUR * (xx + yy) + interface.BLUR**2

    opacity = torch.sigmoid(splats.opacity_logits)
    if settings.antialiased:
        opacity = opacity * (sharp / determinant).clamp(min=interface.MIN_COMPENSATION**2).sqrt()
    directions = from_camera / from_camera.norm(dim=-1, keepdim=True)
    colors = spherical_harmonics.colors(splats.sh, directions.to(dtype), settings.degree)
    return Projected(
        centers, depths, xx + interface.BLUR, xy, yy + interface.BLUR, determinant, opacity, colors, splats.betas
    )


@dataclass
class Culled:
    """Which splats are left after culling."""

    order: Tensor  # (V,) indices, front to back
    half_sizes: Tensor  # (V, 2) of the box that holds all with alpha >= 1/255, px
    refused: int


@torch.no_grad()
def cull(splats: Splats, settings: RenderSettings) -> Culled:
    """Leaves out what is not usable, behind the near plane, degenerate on the image, too faint or off the image."""
    height, width = settings.size
    keep = usable(splats)
    pose = settings.pose.to(splats.means.device)
    z = ((splats.means.double() - pose[:3, 3]) @ pose[:3, 2]).nan_to_num(0.0)
    kept = torch.nonzero(keep & (z > settings.near))[:, 0]
    ahead = Splats(*(tensor[kept] for tensor in splats.tensors().values()))
    p = project(ahead, torch.zeros_like(ahead.means[:, :2]), settings)
    sane = torch.isfinite(p.determinant) & (p.xx < interface.MAX_VARIANCE) & (p.yy < interface.MAX_VARIANCE)
    reach = kernels.extent(p.opacity, p.betas, settings.exact).clamp(max=interface.MAX_REACH)
    half_x, half_y = (reach * p.xx).sqrt(), (reach * p.yy).sqrt()
    on_image = (p.centers[:, 0] + half_x >= 0) & (p.centers[:, 0] - half_x <= width - 1)
    on_image &= (p.centers[:, 1] + half_y >= 0) & (p.centers[:, 1] - half_y <= height - 1)
    seen = torch.nonzero(sane & on_image & (p.opacity >= kernels.MIN_ALPHA))[:, 0]
    seen = seen[torch.argsort(z[kept][seen].float(), stable=True)]
    refused = int((~keep).sum()) + int((~sane).sum())
    return Culled(kept[seen], torch.stack([half_x, half_y], dim=1)[seen], refused)


def alphas(p: Projected, pixel_x: Tensor, pixel_y: Tensor, settings: RenderSettings) -> Tensor:
    """(P, V) of pixels (P,) by splats (V,); 0 below 1/255."""
    dx, dy = pixel_x[:, None] - p.centers[:, 0], pixel_y[:, None] - p.centers[:, 1]
    m = p.yy / p.determinant * (dx - p.xy / p.yy * dy) ** 2 + dy * dy / p.yy
    alpha = (p.opacity * kernels.falloff(m, p.betas, settings.exact)).clamp(max=interface.MAX_ALPHA)
    return torch.where(alpha >= kernels.MIN_ALPHA, alpha, 0.0)


def render(splats: Splats, settings: RenderSettings) -> Render:
    """See `rasterizer.rasterize`."""
    dtype, device, count = splats.means.dtype, splats.means.device, len(splats)
    height, width = settings.size
    means2d = interface.means2d_leaf(splats, settings)
    culled = cull(splats, settings)
    shown = Splats(*(tensor.index_select(0, culled.order) for tensor in splats.tensors().values()))
    p = project(shown, means2d.index_select(0, culled.order), settings)
    background = torch.tensor(settings.background, dtype=dtype, device=device)
    weight_max, radii = splats.means.new_zeros(2, count).unbind(0)

    rows_at_once = max(1, PAIRS_AT_ONCE // max(1, width * len(culled.order)))
    columns = torch.arange(width, device=device)
    color, depth, opacity = [], [], []
    for first in range(0, height, rows_at_once):
        rows = torch.arange(first, min(first + rows_at_once, height), device=device)
        pixel_y, pixel_x = (grid.reshape(-1) for grid in torch.meshgrid(rows, columns, indexing="ij"))
        alpha = alphas(p, pixel_x, pixel_y, settings)
        before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1.0 - alpha], dim=1), dim=1)[:, :-1]
        before = before[:, : alpha.shape[1]]
        alpha = alpha * (before >= interface.MIN_TRANSMITTANCE)
        weights = alpha * before
        transmittance = torch.prod(1.0 - alpha, dim=1)
        covered = weights.sum(dim=1)
        color.append(weights @ p.colors + transmittance[:, None] * background)
        depth.append(torch.where(covered > 0, weights @ p.depths, 0.0) / torch.where(covered > 0, covered, 1.0))
        opacity.append(1.0 - transmittance)
        if len(culled.order):
            with torch.no_grad():
                weight_max[culled.order] = torch.maximum(weight_max[culled.order], weights.amax(dim=0))

    radii[culled.order] = culled.half_sizes.amax(dim=1)
    return Render(
        color=torch.cat(color).reshape(height, width, 3),
        depth=torch.cat(depth).reshape(height, width),
        opacity=torch.cat(opacity).reshape(height, width),
        visible=radii > 0,
        radii=radii,
        means2d=means2d,
        weight_max=weight_max if settings.weights else None,
        refused=culled.refused,
        backward=Backward(),
    )
