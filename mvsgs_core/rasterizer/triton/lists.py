"""Lists of splats by tile on a GPU: the exact columns that each ellipse covers on each row of 4x4 blocks.

As in csrc/rasterizer/binning.cpp, so that both kernels blend the same pairs. Depth order first, then a stable sort by
tile; the only number that the host waits for is that of the pairs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

MARGIN = tl.constexpr(0.01)  # px, so that rounding never cuts a pixel off the ellipse
FAR = tl.constexpr(1 << 23)  # beyond every column of pixels
# Arguments that a kernel is compiled for once. By itself Triton compiles it anew for 1 and for multiples of 16: each
# keyframe's new splats may make their number one.
SIZES = ("count", "height", "width", "tiles_x", "tiles")


@triton.jit
def tile_rows(center_y, half_height, height, seen):  # type: ignore[no-untyped-def]
    """First and last row of pixels that the ellipse reaches, 0 and -1 where it reaches none."""
    top = tl.minimum(tl.maximum(tl.ceil(center_y - half_height - MARGIN), 0.0), height * 1.0)
    bottom = tl.maximum(tl.minimum(tl.floor(center_y + half_height + MARGIN), height - 1.0), -1.0)
    some = seen & (top <= bottom)
    return tl.where(some, top, 0.0).to(tl.int32), tl.where(some, bottom, -1.0).to(tl.int32)


@triton.jit
def block_span(  # type: ignore[no-untyped-def]
    row, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u, pitch_v_squared, reach, width
):
    """First and last column of 4x4 blocks on the row of blocks that begins at pixel row `row`; FAR and -1: none."""
    low = row.to(tl.float32) - center_y
    high = low + 3.0
    right_y = tl.minimum(tl.maximum(tl.minimum(tl.maximum(turn, low), high), -half_height), half_height)
    left_y = tl.minimum(tl.maximum(tl.minimum(tl.maximum(-turn, low), high), -half_height), half_height)
    right_span = tl.sqrt(tl.maximum(reach - pitch_v_squared * right_y * right_y, 0.0)) * inverse_pitch_u
    left_span = tl.sqrt(tl.maximum(reach - pitch_v_squared * left_y * left_y, 0.0)) * inverse_pitch_u
    right = tl.minimum(center_x + MARGIN + shear * right_y + right_span, width - 1.0)
    left = tl.minimum(tl.maximum(center_x - MARGIN + shear * left_y - left_span, 0.0), width * 1.0)
    none = (low > half_height + MARGIN) | (high < -half_height - MARGIN) | (right < left)
    none = none | (row + 3 < top) | (row > bottom)
    first = tl.ceil(left).to(tl.int32)
    last = tl.floor(tl.maximum(right, 0.0)).to(tl.int32)
    none = none | (last < first)
    return tl.where(none, FAR, first // 4), tl.where(none, -1, last // 4)


@triton.jit
def row_span(  # type: ignore[no-untyped-def]
    tile_row, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u, pitch_v_squared, reach, width
):
    """First and last column of tiles on a row of tiles."""
    first = tile_row * 0 + FAR
    last = tile_row * 0 - 1
    for k in tl.static_range(4):
        begin, end = block_span(
            16 * tile_row + 4 * k, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u,
            pitch_v_squared, reach, width,
        )  # fmt: skip
        first = tl.minimum(first, begin)
        last = tl.maximum(last, end)
    return first // 4, tl.where(last < 0, -1, last // 4)


@triton.jit(do_not_specialize=SIZES)
def emit(  # type: ignore[no-untyped-def]
    order, rows, footprints, radii, slots, pairs, pair_tiles, pair_splats, count, width, height,
    tiles_x, tiles, BLOCK: tl.constexpr, ROW: tl.constexpr, FOOTPRINT: tl.constexpr,
):  # fmt: skip
    """Tile and splat of every pair from slots[n] on; tile `tiles` where no block of the tile is touched.

    Never beyond the pairs that `project` counted, should its compiled code round a border otherwise than this one.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    n = tl.load(order + at, mask=at < count, other=0)
    seen = (at < count) & (tl.load(radii + n) > 0.0)
    row = rows + ROW * n
    center_x = tl.load(row, mask=seen, other=0.0) + tl.load(row + 2, mask=seen, other=0.0)
    center_y = tl.load(row + 1, mask=seen, other=0.0) + tl.load(row + 3, mask=seen, other=0.0)
    shear = tl.load(row + 5, mask=seen, other=0.0)
    footprint = footprints + FOOTPRINT * n
    half_height = tl.load(footprint, mask=seen, other=0.0)
    turn = tl.load(footprint + 1, mask=seen, other=0.0)
    inverse_pitch_u = tl.load(footprint + 2, mask=seen, other=0.0)
    pitch_v_squared = tl.load(footprint + 3, mask=seen, other=0.0)
    reach = tl.load(footprint + 4, mask=seen, other=0.0)
    slot = tl.load(slots + n, mask=seen, other=0)
    limit = slot + tl.load(pairs + n, mask=seen, other=0)
    top, bottom = tile_rows(center_y, half_height, height, seen)
    step = 0
    steps = tl.max(bottom // 16 - top // 16 + 1, axis=0)
    while step < steps:
        tile_row = top // 16 + step
        first, last = row_span(
            tile_row, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u, pitch_v_squared,
            reach, width,
        )  # fmt: skip
        column = first
        longest = tl.max(last - first + 1, axis=0)
        done = 0
        while done < longest:
            listed = (column <= last) & (slot < limit)
            touched = column < 0
            for k in tl.static_range(4):
                begin, end = block_span(
                    16 * tile_row + 4 * k, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u,
                    pitch_v_squared, reach, width,
                )  # fmt: skip
                touched = touched | ((begin <= 4 * column + 3) & (end >= 4 * column))
            tile = tile_row * tiles_x + column
            tl.store(pair_tiles + slot, tl.where(touched, tile, tiles), mask=listed)
            tl.store(pair_splats + slot, n.to(tl.int32), mask=listed)
            slot += listed.to(tl.int32)
            column += 1
            done += 1
        step += 1


@triton.jit(do_not_specialize=SIZES)
def per_splat(  # type: ignore[no-untyped-def]
    values, slots, pairs, result, count, COLUMNS: tl.constexpr, WIDTH: tl.constexpr, MAXIMUM: tl.constexpr,
    SPLATS: tl.constexpr, AT_ONCE: tl.constexpr,
):  # fmt: skip
    """result (N, COLUMNS): the sum, or with MAXIMUM the maximum, of the values (P, COLUMNS) of each splat's pairs."""
    n = tl.program_id(0) * SPLATS + tl.arange(0, SPLATS)
    first = tl.load(slots + n, mask=n < count, other=0)
    length = tl.load(pairs + n, mask=n < count, other=0)
    column = tl.arange(0, WIDTH)[None, None, :]
    total = tl.zeros([SPLATS, WIDTH], tl.float32)
    done = 0
    longest = tl.max(length, axis=0)
    while done < longest:
        pair = done + tl.arange(0, AT_ONCE)[None, :]
        address = (first[:, None] + pair).to(tl.int64)[:, :, None] * COLUMNS + column
        there = (pair < length[:, None])[:, :, None] & (column < COLUMNS)
        block = tl.load(values + address, mask=there, other=0.0)
        if MAXIMUM:
            total = tl.maximum(total, tl.max(block, axis=1))
        else:
            total += tl.sum(block, axis=1)
        done += AT_ONCE
    column = tl.arange(0, WIDTH)[None, :]
    tl.store(result + n[:, None] * COLUMNS + column, total, mask=(n < count)[:, None] & (column < COLUMNS))


@dataclass
class Lists:
    """The pairs of splats and tiles; P includes those that touch no block, which lie behind the last tile."""

    pair_splats: Tensor  # (P,) int32, by tile, front to back
    pair_slots: Tensor  # (P,) int32, where each lies in the order by splat
    tile_begin: Tensor  # (tiles + 1,) int32
    slots: Tensor  # (N,) int32, first slot of each splat
    pairs: Tensor  # (N,) int32, slots of each splat

    def sums(self, values: Tensor, maximum: bool = False) -> Tensor:
        """(N, C): sum or maximum of the values (P, C) >= 0 by slot, over the slots of each splat, in a fixed order."""
        count, columns = len(self.slots), values.shape[1]
        result = values.new_empty(count, columns)
        if count:
            per_splat[(triton.cdiv(count, 8),)](
                values, self.slots, self.pairs, result, count, COLUMNS=columns, WIDTH=triton.next_power_of_2(columns),
                MAXIMUM=maximum, SPLATS=8, AT_ONCE=4, num_warps=1, enable_fp_fusion=True,
            )  # fmt: skip
        return result


def sort_by_tile(pair_tiles: Tensor, pair_splats: Tensor, tiles: int) -> tuple[Tensor, Tensor, Tensor]:
    """(splats, slots, tile_begin) in the order of tiles; a tile's pairs stay in the order they came in."""
    by_tile, slots = torch.sort(pair_tiles, stable=True)
    bounds = torch.arange(tiles + 1, dtype=torch.int32, device=pair_tiles.device)
    return pair_splats[slots], slots.int(), torch.searchsorted(by_tile, bounds, out_int32=True)
