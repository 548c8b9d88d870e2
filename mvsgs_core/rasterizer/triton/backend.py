"""The GPU back end: no float atomics, the same result every time.

Project (with the pairs counted), sort by depth, list the pairs, sort by tile, blend; backward: blend, sum up by splat,
project. The host waits once a view, for the number of pairs. Triton launches on the current GPU: it is made that of
the splats.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor

from mvsgs_core.rasterizer.differentiable import Images, OnImages, Rendered
from mvsgs_core.rasterizer.interface import RenderSettings
from mvsgs_core.rasterizer.triton.blend import SUMS, TILE, blend, blend_backward
from mvsgs_core.rasterizer.triton.lists import Lists, emit, sort_by_tile
from mvsgs_core.rasterizer.triton.projection import FOOTPRINT, ROW, project
from mvsgs_core.rasterizer.triton.projection_backward import project_backward

BLOCK = 64  # splats of a program
MAX_PAIRS = 1 << 31  # places are 32-bit integers
LAUNCH_TILE = {"num_warps": 1, "enable_fp_fusion": True}


@dataclass
class Pass:
    """What the backward pass reads again."""

    camera: Tensor  # (16,) float64 world_from_cam by rows, on the device
    rows: Tensor  # (N, ROW)
    radii: Tensor  # (N,) px, 0 if not seen
    lists: Lists
    refused: int


def of_projection(settings: RenderSettings, bases: int) -> dict[str, Any]:
    """What the kernels of the projection are compiled for and launched with; bases: coefficients of the harmonics."""
    return {
        "BASES": bases, "USED": (settings.degree + 1) ** 2, "EXACT": settings.exact,
        "ANTIALIASED": settings.antialiased, "ROLLING": any(settings.readout), "BLOCK": BLOCK, "ROW": ROW,
        "num_warps": 2, "enable_fp_fusion": True,
    }  # fmt: skip


def tile_grid(size: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) of tiles that cover an image of (height, width)."""
    return triton.cdiv(size[0], TILE.value), triton.cdiv(size[1], TILE.value)


def projected(parameters: list[Tensor], settings: RenderSettings) -> Pass:
    """Projects and lists the splats of `parameters`, the fields of `Splats`. Raises ValueError for too many pairs."""
    means, sh = parameters[0], parameters[4]
    count, device = len(means), means.device
    height, width = settings.size
    tiles_y, tiles_x = tile_grid(settings.size)
    tiles = tiles_y * tiles_x
    camera = settings.pose.detach().reshape(-1).to(device)
    rows, footprints = means.new_empty(count, ROW), means.new_empty(count, FOOTPRINT)
    depths, radii = means.new_empty(count), means.new_empty(count)  # rows of one would not lie at multiples of 16 bytes
    pairs = torch.empty(count, dtype=torch.int32, device=device)
    programs = triton.cdiv(count, BLOCK)
    refused = torch.zeros(max(1, programs), dtype=torch.int32, device=device)
    if count:
        project[(programs,)](
            *parameters, camera, rows, footprints, depths, radii, pairs, refused, count, width, height,
            *settings.intrinsics, *settings.readout, settings.near, FOOTPRINT=FOOTPRINT,
            **of_projection(settings, sh.shape[1]),
        )  # fmt: skip
    order = torch.argsort(depths, stable=True)
    ends = torch.cumsum(pairs[order], dim=0, dtype=torch.int64)
    slots = torch.empty_like(pairs)
    slots[order] = (ends - pairs[order]).int()
    total, left_out = torch.stack([pairs.sum(dtype=torch.int64), refused.sum()]).tolist()  # the host waits here
    if total >= MAX_PAIRS:
        raise ValueError(
            f"a view has {MAX_PAIRS} pairs of splats and tiles or more: take fewer or smaller splats, or a "
            "smaller image"
        )
    pair_tiles = torch.full((total,), tiles, dtype=torch.int32, device=device)
    pair_splats = torch.zeros(total, dtype=torch.int32, device=device)
    if total:
        emit[(triton.cdiv(count, 32),)](
            order, rows, footprints, radii, slots, pairs, pair_tiles, pair_splats, count, width, height, tiles_x,
            tiles, BLOCK=32, ROW=ROW, FOOTPRINT=FOOTPRINT, **LAUNCH_TILE,
        )  # fmt: skip
    lists = Lists(*sort_by_tile(pair_tiles, pair_splats, tiles), slots, pairs)
    return Pass(camera, rows, radii, lists, int(left_out))


def forward(settings: RenderSettings, parameters: list[Tensor]) -> tuple[Images, Rendered]:
    """See `BackEnd`. Raises ValueError for other than float32, and for too many pairs."""
    means = parameters[0]
    if means.dtype != torch.float32:
        raise ValueError(f"the triton back end takes float32 splats, got {means.dtype}")
    with torch.cuda.device_of(means):
        passed = projected(parameters, settings)
        lists = passed.lists
        height, width = settings.size
        tiles_y, tiles_x = tile_grid(settings.size)
        color = means.new_empty(height, width, 3)
        depth, opacity = means.new_empty(height, width), means.new_empty(height, width)
        weights = means.new_zeros(len(lists.pair_splats) if settings.weights else 1)
        blend[(tiles_y * tiles_x,)](
            passed.rows, lists.pair_splats, lists.pair_slots, lists.tile_begin, color, depth, opacity, weights,
            *settings.background, height, width, tiles_x, EXACT=settings.exact, WEIGHTS=settings.weights, ROW=ROW,
            **LAUNCH_TILE,
        )  # fmt: skip
        weight_max = lists.sums(weights[:, None], maximum=True)[:, 0] if settings.weights else None
        return (color, depth, opacity), Rendered(passed.radii, passed.refused, weight_max, passed)


def backward(
    settings: RenderSettings, kept: Pass, parameters: list[Tensor], images: Images, on_images: OnImages,
    on_splats: list[Tensor], on_means2d: Tensor, wants_pose: bool,
) -> tuple[Tensor | None, None]:  # fmt: skip
    """See `BackEnd`."""
    with torch.cuda.device_of(on_means2d):
        lists, count = kept.lists, len(parameters[0])
        height, width = settings.size
        tiles_y, tiles_x = tile_grid(settings.size)
        sums = on_means2d.new_zeros(len(lists.pair_splats), SUMS)
        blend_backward[(tiles_y * tiles_x,)](
            kept.rows, lists.pair_splats, lists.pair_slots, lists.tile_begin, *images,
            *(torch.zeros_like(image) if g is None else g for image, g in zip(images, on_images)), sums, height, width,
            tiles_x, EXACT=settings.exact, DEPTH=any(g is not None for g in on_images[1:]), SUMS=SUMS, ROW=ROW,
            **LAUNCH_TILE,
        )  # fmt: skip
        programs = triton.cdiv(count, BLOCK)
        on_pose = torch.zeros(max(1, programs), 12, dtype=torch.float64, device=sums.device)
        if count:
            project_backward[(programs,)](
                *parameters, kept.camera, kept.rows, lists.sums(sums), lists.pairs, *on_splats, on_means2d, on_pose,
                count, width, height, *settings.intrinsics, *settings.readout, POSE=wants_pose, SUMS=SUMS,
                **of_projection(settings, parameters[4].shape[1]),
            )  # fmt: skip
        if not wants_pose:
            return None, None
        return torch.nn.functional.pad(on_pose.sum(dim=0).reshape(3, 4), (0, 0, 0, 1)).to(settings.pose.device), None
