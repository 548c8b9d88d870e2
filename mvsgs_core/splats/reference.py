"""The rasterizer in plain PyTorch: every splat against every pixel, gradients by autograd, in float32 or float64.

Slow and obvious: it says what the fast back ends must compute.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mvsgs_core.splats import densities, rasterizer, spherical_harmonics
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.rasterizer import Render, View

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
    return torch.stack(finite).all(dim=0) & (splats.quaternions.norm(dim=-1) > rasterizer.MIN_QUATERNION)


def axes_on_image(splats: Splats, points: Tensor, view: View) -> Tensor:
    """(N, 2, 3) in px: the splats' axes, each one standard deviation long, projected by the Jacobian at `points`."""
    fx, fy, cx, cy = view.intrinsics
    height, width = view.size
    x, y, z = points.unbind(-1)
    margin_x, margin_y = (rasterizer.CLAMP_MARGIN * 0.5 * n / f for n, f in ((width, fx), (height, fy)))
    slope_x = (x / z).clamp(-(cx + 0.5) / fx - margin_x, (width - 0.5 - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-(cy + 0.5) / fy - margin_y, (height - 0.5 - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * slope_x / z], -1), torch.stack([zero, fy / z, -fy * slope_y / z], -1)], -2
    )
    cam_from_world = view.pose[:3, :3].T.to(points.dtype)
    axes = rotation_matrices(splats.quaternions) * torch.exp(splats.log_scales)[:, None, :]
    return jacobian @ cam_from_world @ axes


def render(splats: Splats, view: View) -> Render:
    """See `rasterizer.rasterize`."""
    dtype, count = splats.means.dtype, len(splats)
    height, width = view.size
    fx, fy, cx, cy = view.intrinsics
    screen = torch.zeros(count, 2, dtype=dtype, requires_grad=torch.is_grad_enabled())

    with torch.no_grad():
        keep = usable(splats)
        refused = count - int(keep.sum())
        z = ((splats.means.double() - view.pose[:3, 3]) @ view.pose[:3, 2]).nan_to_num(0.0)
        kept = torch.nonzero(keep & (z > view.near))[:, 0]

    def pick(tensor: Tensor) -> Tensor:
        return tensor.index_select(0, kept)

    chosen = Splats(*(pick(tensor) for tensor in splats.tensors().values()))
    from_camera = chosen.means.double() - view.pose[:3, 3]
    points = (from_camera @ view.pose[:3, :3]).to(dtype)
    depths = points[:, 2]
    centers = torch.stack([fx * points[:, 0] / depths + cx, fy * points[:, 1] / depths + cy], dim=-1)
    centers = centers + pick(screen) * torch.tensor([0.5 * width, 0.5 * height], dtype=dtype)

    row_x, row_y = axes_on_image(chosen, points, view).unbind(1)
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    # the determinant as a sum of squares (Lagrange's identity): no cancellation for needles
    sharp = torch.linalg.cross(row_x, row_y).square().sum(-1)
    determinant = sharp + rasterizer.BLUR * (xx + yy) + rasterizer.BLUR**2
    xx, yy = xx + rasterizer.BLUR, yy + rasterizer.BLUR

    opacity = torch.sigmoid(chosen.opacity_logits)
    if view.antialiased:
        opacity = opacity * (sharp / determinant).clamp(min=rasterizer.MIN_COMPENSATION**2).sqrt()
    directions = from_camera / from_camera.norm(dim=-1, keepdim=True)
    colors = spherical_harmonics.colors(chosen.sh, directions.to(dtype), view.degree)

    with torch.no_grad():
        reach = densities.extent(opacity, chosen.betas, view.density).clamp(max=1e12)
        sane = torch.isfinite(determinant) & (xx < rasterizer.MAX_VARIANCE) & (yy < rasterizer.MAX_VARIANCE)
        half_x, half_y = (reach * xx).sqrt(), (reach * yy).sqrt()
        on_image = (centers[:, 0] + half_x >= 0) & (centers[:, 0] - half_x <= width - 1)
        on_image &= (centers[:, 1] + half_y >= 0) & (centers[:, 1] - half_y <= height - 1)
        seen = sane & on_image & (opacity >= densities.MIN_ALPHA)
        refused += int((~sane).sum())
        order = torch.nonzero(seen)[:, 0]
        order = order[torch.argsort(pick(z)[order].float(), stable=True)]
        radii = torch.zeros(count, dtype=dtype)
        radii[kept[order]] = torch.maximum(half_x, half_y)[order]
        weight_sum, weight_max = torch.zeros(count, dtype=dtype), torch.zeros(count, dtype=dtype)

    centers, xx, xy, yy, determinant, opacity, betas, depths, colors = (
        tensor[order] for tensor in (centers, xx, xy, yy, determinant, opacity, chosen.betas, depths, colors)
    )
    rows_at_once = max(1, PAIRS_AT_ONCE // max(1, width * len(order)))
    color_rows, depth_rows, opacity_rows = [], [], []
    for first in range(0, height, rows_at_once):
        pixel_rows = torch.arange(first, min(first + rows_at_once, height))
        grid_y, grid_x = torch.meshgrid(pixel_rows, torch.arange(width), indexing="ij")
        dx = grid_x.reshape(-1, 1) - centers[:, 0]
        dy = grid_y.reshape(-1, 1) - centers[:, 1]
        m = yy / determinant * (dx - xy / yy * dy) ** 2 + dy * dy / yy
        alpha = (opacity * densities.falloff(m, betas, view.density)).clamp(max=rasterizer.MAX_ALPHA)
        counted = alpha >= densities.MIN_ALPHA
        if view.tile_mask is not None:
            tile = rasterizer.TILE
            counted = counted & view.tile_mask[grid_y // tile, grid_x // tile].reshape(-1, 1)
        alpha = torch.where(counted, alpha, 0.0)
        before = torch.cat([torch.ones_like(alpha[:, :1]), torch.cumprod(1.0 - alpha, dim=1)[:, :-1]], dim=1)
        alpha = alpha * (before >= rasterizer.MIN_TRANSMITTANCE)[:, : alpha.shape[1]]
        weights = alpha * before[:, : alpha.shape[1]]
        covered = weights.sum(dim=1)
        transmittance = torch.prod(1.0 - alpha, dim=1)
        background = torch.tensor(view.background, dtype=dtype)
        color_rows.append(weights @ colors + transmittance[:, None] * background)
        seen_depth = torch.where(covered > 0, weights @ depths, 0.0)
        depth_rows.append(seen_depth / torch.where(covered > 0, covered, 1.0))
        opacity_rows.append(1.0 - transmittance)
        with torch.no_grad():
            weight_sum[kept[order]] += weights.sum(dim=0)
            if len(order):
                weight_max[kept[order]] = torch.maximum(weight_max[kept[order]], weights.amax(dim=0))
    return Render(
        color=torch.cat(color_rows).reshape(height, width, 3),
        depth=torch.cat(depth_rows).reshape(height, width),
        opacity=torch.cat(opacity_rows).reshape(height, width),
        visible=radii > 0,
        radii=radii,
        screen=screen,
        weight_sum=weight_sum if view.weights else None,
        weight_max=weight_max if view.weights else None,
        refused=refused,
    )
