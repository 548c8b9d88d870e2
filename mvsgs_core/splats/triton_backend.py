"""The rasterizer for GPUs: projection and lists in PyTorch, blending in Triton, no CUDA compiler needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mvsgs_core.splats import densities, rasterizer, reference
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.rasterizer import Render, View

try:
    from mvsgs_core.splats import triton_kernels
except ModuleNotFoundError as error:
    raise ImportError(
        "the triton back end needs the package triton, which comes with torch's CUDA builds: take backend='cpu'"
    ) from error


@dataclass
class Lists:
    """The splats of every tile, front to back."""

    pair_splats: Tensor  # (P,) int32, index into the shown splats
    tile_begin: Tensor  # (tiles + 1,) int32
    by_splat: Tensor  # (P,) int64, the pairs in the order of their splats
    counts: Tensor  # (V,) int64, pairs of each splat


def tile_lists(centers: Tensor, half_sizes: Tensor, view: View) -> Lists:
    """Lists from the boxes that hold every splat's ellipse; centers, half_sizes: (V, 2) px, ordered by depth."""
    rows, columns = rasterizer.tile_grid(view.size)
    most = torch.tensor([columns - 1, rows - 1], device=centers.device)
    first = ((centers - half_sizes) / rasterizer.TILE).floor().clamp(min=0).minimum(most).long()
    last = ((centers + half_sizes) / rasterizer.TILE).floor().clamp(min=0).minimum(most).long()
    span = last - first + 1
    counts = span.prod(dim=1)
    splat = torch.repeat_interleave(torch.arange(len(centers), device=centers.device), counts)
    within = torch.arange(len(splat), device=centers.device) - (counts.cumsum(0) - counts)[splat]
    x = first[splat, 0] + within % span[splat, 0]
    y = first[splat, 1] + within // span[splat, 0]
    tile = y * columns + x
    if view.tile_mask is not None:
        wanted = view.tile_mask.to(centers.device).flatten()[tile]
        tile, splat = tile[wanted], splat[wanted]
    tile, order = torch.sort(tile, stable=True)
    splat = splat[order]
    per_tile = torch.bincount(tile, minlength=rows * columns)
    return Lists(
        pair_splats=splat.int(),
        tile_begin=torch.nn.functional.pad(per_tile.cumsum(0), (1, 0)).int(),
        by_splat=torch.argsort(splat, stable=True),
        counts=torch.bincount(splat, minlength=len(centers)),
    )


def per_splat(pair_values: Tensor, lists: Lists, reduce: str) -> Tensor:
    """(V, ...) "sum" or "max" over the pairs of each splat, in a fixed order."""
    if not len(lists.counts):
        return pair_values.new_zeros(0, *pair_values.shape[1:])
    return torch.segment_reduce(pair_values[lists.by_splat], reduce, lengths=lists.counts, initial=0.0)


class _Blend(torch.autograd.Function):
    """Rows of splats (V, 11) -> image (H, W, 5): color over the background, sum of w z, transmittance."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, lists: Lists, view: View, pair_weights: Tensor) -> Tensor:
        rows = rows.detach().contiguous()
        height, width = view.size
        tiles_y, tiles_x = rasterizer.tile_grid(view.size)
        image = rows.new_empty(height, width, 5)
        background = torch.tensor(view.background, dtype=torch.float32, device=rows.device)
        triton_kernels.blend[(tiles_y * tiles_x,)](
            rows, lists.pair_splats, lists.tile_begin, image, background, pair_weights, height, width, tiles_x,
            COLUMNS=triton_kernels.COLUMNS, EXACT=view.density == "exact", WEIGHTS=view.weights,
        )  # fmt: skip
        ctx.lists, ctx.view = lists, view
        ctx.save_for_backward(rows, image)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, image = ctx.saved_tensors
        lists, view = ctx.lists, ctx.view
        height, width = view.size
        tiles_y, tiles_x = rasterizer.tile_grid(view.size)
        sums = rows.new_zeros(len(lists.pair_splats), triton_kernels.COLUMNS)
        triton_kernels.blend_backward[(tiles_y * tiles_x,)](
            rows, lists.pair_splats, lists.tile_begin, image, gradient.contiguous(), sums, height, width, tiles_x,
            COLUMNS=triton_kernels.COLUMNS, EXACT=view.density == "exact",
        )  # fmt: skip
        return per_splat(sums, lists, "sum"), None, None, None


def render(splats: Splats, view: View) -> Render:
    """See `rasterizer.rasterize`. Raises ValueError for other than float32."""
    if splats.means.dtype != torch.float32:
        raise ValueError(f"the triton back end takes float32 splats, got {splats.means.dtype}")
    screen = rasterizer.screen_points(splats, view)
    choice = reference.choose(splats, view)
    shown = Splats(*(tensor.index_select(0, choice.order) for tensor in splats.tensors().values()))
    p = reference.project(shown, screen.index_select(0, choice.order), view)
    lists = tile_lists(p.centers.detach(), choice.half_sizes, view)
    betas = (p.betas if view.density == "exact" else p.betas.detach()).clamp(*densities.BETA_RANGE)
    rows = torch.stack(
        [
            p.centers[:, 0], p.centers[:, 1], (p.yy / p.determinant).sqrt(), p.xy / p.yy, p.yy.rsqrt(),
            torch.log2(p.opacity), *p.colors.unbind(-1), p.depths, 0.5 * betas,
        ],
        dim=1,
    )  # fmt: skip
    pair_weights = splats.means.new_zeros(len(lists.pair_splats) if view.weights else 1, 2)
    image: Tensor = _Blend.apply(rows, lists, view, pair_weights)
    opacity = 1.0 - image[..., 4]
    covered = opacity > 0
    depth = torch.where(covered, image[..., 3], 0.0) / torch.where(covered, opacity, 1.0)
    radii, weight_sum, weight_max = splats.means.new_zeros(3, len(splats)).unbind(0)
    if view.weights:
        weight_sum[choice.order] = per_splat(pair_weights[:, 0], lists, "sum")
        weight_max[choice.order] = per_splat(pair_weights[:, 1], lists, "max")
    radii[choice.order] = choice.half_sizes.amax(dim=1)
    return Render(
        color=image[..., :3],
        depth=depth,
        opacity=opacity,
        visible=radii > 0,
        radii=radii,
        screen=screen,
        weight_sum=weight_sum if view.weights else None,
        weight_max=weight_max if view.weights else None,
        refused=choice.refused,
    )
