"""Blending on a GPU: one program a tile, all 256 pixels of it side by side, splats front to back.

The same sums as in the C++ kernel: forward keeps the transmittance; backward walks front to back again with what lies
behind each splat known from the image, and leaves one row of sums per pair of splat and tile: no additions race.
TRITON_INTERPRET=1 runs this on the CPU, for tests.
"""

from __future__ import annotations

import triton
import triton.language as tl

# A splat's row: mean x, mean y, pitch u, shear, pitch v, log2 opacity, red, green, blue, depth, beta / 2.
COLUMNS = 11

TILE = tl.constexpr(16)
MIN_T = tl.constexpr(1e-4)
MAX_ALPHA = tl.constexpr(0.99)
LOG2_MIN_ALPHA = tl.constexpr(-7.994353436858858)
HALF_LOG2E = tl.constexpr(0.7213475204444817)
LN2 = tl.constexpr(0.6931471805599453)
CENTER_M = tl.constexpr(1e-6)


@triton.jit
def _shape(row, x, y, EXACT: tl.constexpr):  # type: ignore[no-untyped-def]
    """dx, dy, u, v, m, log2 m, power and log2 of the unclamped alpha of the splat at `row` on pixels x, y."""
    dx = x - tl.load(row)
    dy = y - tl.load(row + 1)
    u = tl.load(row + 2) * (dx - tl.load(row + 3) * dy)
    v = tl.load(row + 4) * dy
    m = u * u + v * v
    log2_m = m
    power = m
    if EXACT:
        log2_m = tl.log2(tl.maximum(m, CENTER_M))
        power = tl.exp2(tl.minimum(tl.load(row + 10) * log2_m, 126.0))
    return dx, dy, u, v, m, log2_m, power, tl.load(row + 5) - power * HALF_LOG2E


@triton.jit
def blend(  # type: ignore[no-untyped-def]
    splats, pair_splats, tile_begin, image, background, pair_weights, height, width, tiles_x,
    COLUMNS: tl.constexpr, EXACT: tl.constexpr, WEIGHTS: tl.constexpr,
):  # fmt: skip
    """image: (H, W, 5) = red, green, blue, sum of w z, transmittance; pair_weights: (pairs, 2) = sum, max, 0 before."""
    tile = tl.program_id(0)
    lane = tl.arange(0, TILE * TILE)
    px = (tile % tiles_x) * TILE + lane % TILE
    py = (tile // tiles_x) * TILE + lane // TILE
    inside = (px < width) & (py < height)
    x = px.to(tl.float32)
    y = py.to(tl.float32)
    left = tl.where(inside, 1.0, 0.0)
    red = tl.zeros([TILE * TILE], tl.float32)
    green = tl.zeros([TILE * TILE], tl.float32)
    blue = tl.zeros([TILE * TILE], tl.float32)
    depth = tl.zeros([TILE * TILE], tl.float32)
    index = tl.load(tile_begin + tile)
    end = tl.load(tile_begin + tile + 1)
    while index < end:
        row = splats + tl.load(pair_splats + index) * COLUMNS
        _dx, _dy, _u, _v, _m, _log2_m, _power, exponent = _shape(row, x, y, EXACT)
        counted = (exponent >= LOG2_MIN_ALPHA) & (left >= MIN_T)
        weight = tl.where(counted, left * tl.minimum(tl.exp2(exponent), MAX_ALPHA), 0.0)
        red += weight * tl.load(row + 6)
        green += weight * tl.load(row + 7)
        blue += weight * tl.load(row + 8)
        depth += weight * tl.load(row + 9)
        if WEIGHTS:
            tl.store(pair_weights + 2 * index, tl.sum(weight, axis=0))
            tl.store(pair_weights + 2 * index + 1, tl.max(weight, axis=0))
        left -= weight
        index += 1
        if tl.max(left, axis=0) < MIN_T:
            index = end
    out = image + (py * width + px) * 5
    tl.store(out, red + left * tl.load(background), mask=inside)
    tl.store(out + 1, green + left * tl.load(background + 1), mask=inside)
    tl.store(out + 2, blue + left * tl.load(background + 2), mask=inside)
    tl.store(out + 3, depth, mask=inside)
    tl.store(out + 4, left, mask=inside)


@triton.jit
def blend_backward(  # type: ignore[no-untyped-def]
    splats, pair_splats, tile_begin, image, gradient, sums, height, width, tiles_x,
    COLUMNS: tl.constexpr, EXACT: tl.constexpr,
):  # fmt: skip
    """gradient: (H, W, 5) by the image's columns; sums: (pairs, COLUMNS), zero before, by the splat's columns."""
    tile = tl.program_id(0)
    lane = tl.arange(0, TILE * TILE)
    px = (tile % tiles_x) * TILE + lane % TILE
    py = (tile // tiles_x) * TILE + lane // TILE
    inside = (px < width) & (py < height)
    x = px.to(tl.float32)
    y = py.to(tl.float32)
    g = gradient + (py * width + px) * 5
    i = image + (py * width + px) * 5
    on_red = tl.load(g, mask=inside, other=0.0)
    on_green = tl.load(g + 1, mask=inside, other=0.0)
    on_blue = tl.load(g + 2, mask=inside, other=0.0)
    on_depth = tl.load(g + 3, mask=inside, other=0.0)
    on_left = tl.load(g + 4, mask=inside, other=0.0)
    # of the weights and of what is left at the end, as one sum that shrinks from front to back
    behind = on_red * tl.load(i, mask=inside, other=0.0) + on_green * tl.load(i + 1, mask=inside, other=0.0)
    behind += on_blue * tl.load(i + 2, mask=inside, other=0.0) + on_depth * tl.load(i + 3, mask=inside, other=0.0)
    behind += on_left * tl.load(i + 4, mask=inside, other=0.0)
    left = tl.where(inside, 1.0, 0.0)
    index = tl.load(tile_begin + tile)
    end = tl.load(tile_begin + tile + 1)
    while index < end:
        row = splats + tl.load(pair_splats + index) * COLUMNS
        dx, dy, u, v, m, log2_m, power, exponent = _shape(row, x, y, EXACT)
        counted = (exponent >= LOG2_MIN_ALPHA) & (left >= MIN_T)
        unclamped = tl.exp2(exponent)
        alpha = tl.where(counted, tl.minimum(unclamped, MAX_ALPHA), 0.0)
        weight = left * alpha
        q = on_red * tl.load(row + 6) + on_green * tl.load(row + 7) + on_blue * tl.load(row + 8)
        q += on_depth * tl.load(row + 9)
        behind -= weight * q
        on_log = alpha * (left * q - behind / (1.0 - alpha))
        on_log = tl.where(counted & (unclamped <= MAX_ALPHA), on_log, 0.0)
        on_m = -0.5 * on_log
        if EXACT:
            slope = tl.load(row + 10) * power / tl.maximum(m, CENTER_M)
            on_m = tl.where(m > CENTER_M, on_m * slope, 0.0)
        on_u = 2.0 * on_m * u
        on_v = 2.0 * on_m * v
        pitch_u = tl.load(row + 2)
        shear = tl.load(row + 3)
        out = sums + index * COLUMNS
        tl.store(out, tl.sum(-on_u * pitch_u, axis=0))
        tl.store(out + 1, tl.sum(on_u * pitch_u * shear - on_v * tl.load(row + 4), axis=0))
        tl.store(out + 2, tl.sum(on_u * (dx - shear * dy), axis=0))
        tl.store(out + 3, tl.sum(-on_u * pitch_u * dy, axis=0))
        tl.store(out + 4, tl.sum(on_v * dy, axis=0))
        tl.store(out + 5, tl.sum(on_log * LN2, axis=0))
        tl.store(out + 6, tl.sum(weight * on_red, axis=0))
        tl.store(out + 7, tl.sum(weight * on_green, axis=0))
        tl.store(out + 8, tl.sum(weight * on_blue, axis=0))
        tl.store(out + 9, tl.sum(weight * on_depth, axis=0))
        if EXACT:
            tl.store(out + 10, tl.sum(on_log * power * log2_m * (-0.5), axis=0) * LN2)
        left -= weight
        index += 1
        if tl.max(left, axis=0) < MIN_T:
            index = end
