"""Blending on a GPU: one program a tile, all 256 pixels of it side by side, splats front to back.

The same sums as in csrc/rasterizer/blend*.cpp: forward keeps the transmittance; backward walks front to back again with
what lies behind each splat known from the image, and leaves one row of sums per pair in the pair's own slot: no
additions race. One warp a program, so that a sum over pixels needs no barrier; the next pair's splat is known early.
TRITON_INTERPRET=1 runs this on the CPU, for tests.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from mvsgs_core.rasterizer import interface, kernels
from mvsgs_core.rasterizer.triton.lists import SIZES

# A pair's sums: red, green, blue, depth, log opacity, u, v, u u, u v, v v, beta; see projection_backward.
SUMS = 11

TILE = tl.constexpr(16)
MIN_T = tl.constexpr(interface.MIN_TRANSMITTANCE)
MAX_ALPHA = tl.constexpr(interface.MAX_ALPHA)
LOG2_MIN_ALPHA = tl.constexpr(math.log2(kernels.MIN_ALPHA))
HALF_LOG2E = tl.constexpr(0.7213475204444817)
CENTER_M = tl.constexpr(kernels.CENTER_M)
TINY = tl.constexpr(1e-30)


@triton.jit
def _pixels(tile, height, width, tiles_x):  # type: ignore[no-untyped-def]
    """x, y, place in an image by rows, and whether it is on the image, of each pixel of a tile."""
    lane = tl.arange(0, TILE * TILE)
    px = (tile % tiles_x) * TILE + lane % TILE
    py = (tile // tiles_x) * TILE + lane // TILE
    return px.to(tl.float32), py.to(tl.float32), py * width + px, (px < width) & (py < height)


@triton.jit
def _shape(row, x, y, EXACT: tl.constexpr):  # type: ignore[no-untyped-def]
    """u, v, m, log2 m, power and log2 of the unclamped alpha of the splat at `row` on pixels x, y."""
    dx = (x - tl.load(row)) - tl.load(row + 2)
    dy = (y - tl.load(row + 1)) - tl.load(row + 3)
    u = tl.load(row + 4) * (dx - tl.load(row + 5) * dy)
    v = tl.load(row + 6) * dy
    m = u * u + v * v
    log2_m = m
    power = m
    if EXACT:
        log2_m = tl.log2(tl.maximum(m, CENTER_M))
        power = tl.exp2(tl.minimum(tl.load(row + 12) * log2_m, 126.0))
    return u, v, m, log2_m, power, tl.load(row + 7) - power * HALF_LOG2E


@triton.jit(do_not_specialize=SIZES)
def blend(  # type: ignore[no-untyped-def]
    rows, pair_splats, pair_slots, tile_begin, color, depth, opacity, weight_maxima,
    red_behind, green_behind, blue_behind, height, width, tiles_x,
    EXACT: tl.constexpr, WEIGHTS: tl.constexpr, ROW: tl.constexpr,
):  # fmt: skip
    """color (H, W, 3), depth and opacity (H, W); with WEIGHTS the largest of each pair's, (P,), 0 before."""
    tile = tl.program_id(0)
    x, y, at, inside = _pixels(tile, height, width, tiles_x)
    left = tl.where(inside, 1.0, 0.0)
    red = tl.zeros([TILE * TILE], tl.float32)
    green = tl.zeros([TILE * TILE], tl.float32)
    blue = tl.zeros([TILE * TILE], tl.float32)
    sum_z = tl.zeros([TILE * TILE], tl.float32)
    index = tl.load(tile_begin + tile)
    end = tl.load(tile_begin + tile + 1)
    splat = tl.load(pair_splats + index, mask=index < end, other=0)
    while index < end:
        row = rows + splat * ROW
        splat = tl.load(pair_splats + index + 1, mask=index + 1 < end, other=0)
        _u, _v, _m, _log2_m, _power, exponent = _shape(row, x, y, EXACT)
        counted = (exponent >= LOG2_MIN_ALPHA) & (left >= MIN_T)
        weight = tl.where(counted, left * tl.minimum(tl.exp2(exponent), MAX_ALPHA), 0.0)
        red += weight * tl.load(row + 8)
        green += weight * tl.load(row + 9)
        blue += weight * tl.load(row + 10)
        sum_z += weight * tl.load(row + 11)
        if WEIGHTS:
            tl.store(weight_maxima + tl.load(pair_slots + index), tl.max(weight, axis=0))
        left -= weight
        index += 1
        if index % 4 == 0:  # noqa: SIM102  # `and` computes both for every pair
            if tl.max(left, axis=0) < MIN_T:
                index = end
    covered = tl.where(inside, 1.0 - left, 0.0)
    tl.store(color + 3 * at, red + left * red_behind, mask=inside)
    tl.store(color + 3 * at + 1, green + left * green_behind, mask=inside)
    tl.store(color + 3 * at + 2, blue + left * blue_behind, mask=inside)
    tl.store(depth + at, sum_z / tl.maximum(covered, TINY), mask=inside)
    tl.store(opacity + at, covered, mask=inside)


@triton.jit(do_not_specialize=SIZES)
def blend_backward(  # type: ignore[no-untyped-def]
    rows, pair_splats, pair_slots, tile_begin, color, depth, opacity, on_color, on_depth, on_opacity, sums,
    height, width, tiles_x, EXACT: tl.constexpr, DEPTH: tl.constexpr, SUMS: tl.constexpr, ROW: tl.constexpr,
):  # fmt: skip
    """sums (P, SUMS) by slot, 0 before. Without DEPTH the gradients of depth and opacity are taken as 0."""
    tile = tl.program_id(0)
    x, y, at, inside = _pixels(tile, height, width, tiles_x)
    on_red = tl.load(on_color + 3 * at, mask=inside, other=0.0)
    on_green = tl.load(on_color + 3 * at + 1, mask=inside, other=0.0)
    on_blue = tl.load(on_color + 3 * at + 2, mask=inside, other=0.0)
    # what the weights from here on back are worth, as one sum that shrinks from front to back
    behind = on_red * tl.load(color + 3 * at, mask=inside, other=0.0)
    behind += on_green * tl.load(color + 3 * at + 1, mask=inside, other=0.0)
    behind += on_blue * tl.load(color + 3 * at + 2, mask=inside, other=0.0)
    on_z = tl.zeros([TILE * TILE], tl.float32)
    on_covered = tl.zeros([TILE * TILE], tl.float32)
    if DEPTH:
        covered = tl.load(opacity + at, mask=inside, other=0.0)
        wanted = tl.load(on_opacity + at, mask=inside, other=0.0)
        behind += covered * wanted
        on_z = tl.load(on_depth + at, mask=inside, other=0.0) / tl.maximum(covered, TINY)
        on_z = tl.where(covered >= TINY, on_z, 0.0)
        on_covered = wanted - on_z * tl.load(depth + at, mask=inside, other=0.0)
    left = tl.where(inside, 1.0, 0.0)
    index = tl.load(tile_begin + tile)
    end = tl.load(tile_begin + tile + 1)
    splat = tl.load(pair_splats + index, mask=index < end, other=0)
    while index < end:
        row = rows + splat * ROW
        splat = tl.load(pair_splats + index + 1, mask=index + 1 < end, other=0)
        u, v, m, log2_m, power, exponent = _shape(row, x, y, EXACT)
        counted = (exponent >= LOG2_MIN_ALPHA) & (left >= MIN_T)
        unclamped = tl.exp2(exponent)
        alpha = tl.where(counted, tl.minimum(unclamped, MAX_ALPHA), 0.0)
        weight = left * alpha
        q = on_red * tl.load(row + 8) + on_green * tl.load(row + 9) + on_blue * tl.load(row + 10)
        if DEPTH:
            q += on_z * tl.load(row + 11) + on_covered
        behind -= weight * q
        # by log(alpha); none where alpha is clamped
        on_log = alpha * (left * q - behind / (1.0 - alpha))
        on_log = tl.where(counted & (unclamped <= MAX_ALPHA), on_log, 0.0)
        on_m = on_log
        if EXACT:
            slope = tl.load(row + 12) * power / tl.maximum(m, CENTER_M)
            on_m = tl.where(m >= CENTER_M, on_log * slope, 0.0)
        out = sums + tl.load(pair_slots + index).to(tl.int64) * SUMS
        tl.store(out, tl.sum(weight * on_red, axis=0))
        tl.store(out + 1, tl.sum(weight * on_green, axis=0))
        tl.store(out + 2, tl.sum(weight * on_blue, axis=0))
        if DEPTH:
            tl.store(out + 3, tl.sum(weight * on_z, axis=0))
        tl.store(out + 4, tl.sum(on_log, axis=0))
        tl.store(out + 5, tl.sum(on_m * u, axis=0))
        tl.store(out + 6, tl.sum(on_m * v, axis=0))
        tl.store(out + 7, tl.sum(on_m * u * u, axis=0))
        tl.store(out + 8, tl.sum(on_m * u * v, axis=0))
        tl.store(out + 9, tl.sum(on_m * v * v, axis=0))
        if EXACT:
            tl.store(out + 10, tl.sum(on_log * power * log2_m, axis=0))
        left -= weight
        index += 1
        if index % 4 == 0:  # noqa: SIM102  # `and` computes both for every pair
            if tl.max(left, axis=0) < MIN_T:
                index = end
