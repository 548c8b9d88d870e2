"""L1 + SSIM and their gradient on a GPU, in two kernels; the same sums as in C++ (csrc/rasterizer/photometric).

An image (H, W, 3) is read as (H, 3 W): a horizontal tap is a shift by 3. A program owns a block of the result; source
rows stream through it, each is filtered along itself and added to the rows of the block that it lies within 5 of, so
that nothing between the two filters goes through memory. With a = G x, b = G y, p = G x^2, q = G y^2, r = G x y the
gradient of the mean is G(dS/da) + 2 x G(dS/dp) + y G(dS/dr), the window being symmetric. Sums of programs are added up
in a fixed order. TRITON_INTERPRET=1 runs this on the CPU, for tests.
"""

from __future__ import annotations

import functools
import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from mvsgs_core.rasterizer import ssim_window

ROWS, COLUMNS = 16, 128  # of a program's block: 26 source rows are read for 16
RADIUS = tl.constexpr(ssim_window.RADIUS)
C1, C2 = tl.constexpr(ssim_window.C1), tl.constexpr(ssim_window.C2)


@functools.cache
def window(device: torch.device) -> Tensor:
    """(11,) the Gaussian's taps, their sum 1."""
    taps = [math.exp(-((k - RADIUS.value) ** 2) / (2 * ssim_window.SIGMA**2)) for k in range(2 * RADIUS.value + 1)]
    return torch.tensor([tap / sum(taps) for tap in taps], dtype=torch.float32, device=device)


@triton.jit
def _row_taps(taps, rows, source):  # type: ignore[no-untyped-def]
    """(ROWS, 1): the weight of row `source` in the filtered `rows`."""
    tap = source - rows + RADIUS
    return tl.load(taps + tap, mask=(tap >= 0) & (tap <= 2 * RADIUS), other=0.0)[:, None]


@triton.jit(do_not_specialize=["height"])
def similarity(  # type: ignore[no-untyped-def]
    image, target, taps, on_a, on_p, on_r, sums, height, length, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):
    """SSIM's derivatives by a, p, r, (H, 3 W) each, and its sum over each program's block."""
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    a = tl.zeros([ROWS, COLUMNS], tl.float32)
    b = tl.zeros([ROWS, COLUMNS], tl.float32)
    p = tl.zeros([ROWS, COLUMNS], tl.float32)
    q = tl.zeros([ROWS, COLUMNS], tl.float32)
    r = tl.zeros([ROWS, COLUMNS], tl.float32)
    first = tl.program_id(0) * ROWS - RADIUS
    for source in range(first, first + ROWS + 2 * RADIUS):
        row_a = tl.zeros([COLUMNS], tl.float32)
        row_b = tl.zeros([COLUMNS], tl.float32)
        row_p = tl.zeros([COLUMNS], tl.float32)
        row_q = tl.zeros([COLUMNS], tl.float32)
        row_r = tl.zeros([COLUMNS], tl.float32)
        for k in tl.static_range(11):
            at = columns + 3 * (k - RADIUS)
            there = (source >= 0) & (source < height) & (at >= 0) & (at < length)
            x = tl.load(image + source * length + at, mask=there, other=0.0)
            y = tl.load(target + source * length + at, mask=there, other=0.0)
            tap = tl.load(taps + k)
            row_a += tap * x
            row_b += tap * y
            row_p += tap * x * x
            row_q += tap * y * y
            row_r += tap * x * y
        row_tap = _row_taps(taps, rows, source)
        a += row_tap * row_a[None, :]
        b += row_tap * row_b[None, :]
        p += row_tap * row_p[None, :]
        q += row_tap * row_q[None, :]
        r += row_tap * row_r[None, :]
    mean_top = 2 * a * b + C1
    mean_bottom = a * a + b * b + C1
    top = 2 * (r - a * b) + C2
    bottom = (p - a * a) + (q - b * b) + C2
    inverse = 1.0 / (mean_bottom * bottom)
    s = mean_top * top * inverse
    inside = (rows < height)[:, None] & (columns < length)[None, :]
    at = rows[:, None] * length + columns[None, :]
    tl.store(on_p + at, -s * mean_bottom * inverse, mask=inside)
    tl.store(on_r + at, 2 * mean_top * inverse, mask=inside)
    tl.store(on_a + at, 2 * (b * (top - mean_top) - a * s * (bottom - mean_bottom)) * inverse, mask=inside)
    program = tl.program_id(0) * tl.num_programs(1) + tl.program_id(1)
    tl.store(sums + program, tl.sum(tl.sum(tl.where(inside, s, 0.0), axis=1), axis=0))


@triton.jit(do_not_specialize=["height"])
def loss_gradient(  # type: ignore[no-untyped-def]
    image, target, pixel_weight, taps, on_a, on_p, on_r, gradient, sums, height, length,
    l1_weight, l1_scale, ssim_scale, WEIGHTED: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """`gradient` (H, 3 W) of the whole loss, and the sum of the weighted L1 over each program's block."""
    rows = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    columns = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    a = tl.zeros([ROWS, COLUMNS], tl.float32)
    p = tl.zeros([ROWS, COLUMNS], tl.float32)
    r = tl.zeros([ROWS, COLUMNS], tl.float32)
    first = tl.program_id(0) * ROWS - RADIUS
    for source in range(first, first + ROWS + 2 * RADIUS):
        row_a = tl.zeros([COLUMNS], tl.float32)
        row_p = tl.zeros([COLUMNS], tl.float32)
        row_r = tl.zeros([COLUMNS], tl.float32)
        for k in tl.static_range(11):
            at = columns + 3 * (k - RADIUS)
            there = (source >= 0) & (source < height) & (at >= 0) & (at < length)
            tap = tl.load(taps + k)
            row_a += tap * tl.load(on_a + source * length + at, mask=there, other=0.0)
            row_p += tap * tl.load(on_p + source * length + at, mask=there, other=0.0)
            row_r += tap * tl.load(on_r + source * length + at, mask=there, other=0.0)
        row_tap = _row_taps(taps, rows, source)
        a += row_tap * row_a[None, :]
        p += row_tap * row_p[None, :]
        r += row_tap * row_r[None, :]
    inside = (rows < height)[:, None] & (columns < length)[None, :]
    at = rows[:, None] * length + columns[None, :]
    x = tl.load(image + at, mask=inside, other=0.0)
    y = tl.load(target + at, mask=inside, other=0.0)
    weight = tl.zeros([ROWS, COLUMNS], tl.float32) + l1_weight
    if WEIGHTED:
        weight += tl.load(pixel_weight + rows[:, None] * (length // 3) + columns[None, :] // 3, mask=inside, other=0.0)
    difference = x - y
    sign = tl.where(difference > 0, 1.0, tl.where(difference < 0, -1.0, 0.0))
    result = ssim_scale * (a + 2 * x * p + y * r) + l1_scale * weight * sign
    tl.store(gradient + at, result, mask=inside)
    program = tl.program_id(0) * tl.num_programs(1) + tl.program_id(1)
    tl.store(sums + program, tl.sum(tl.sum(weight * tl.abs(difference), axis=1), axis=0))


def loss_with_gradient(
    image: Tensor, target: Tensor, pixel_weight: Tensor | None, l1_weight: float, ssim_weight: float
) -> tuple[Tensor, Tensor]:
    """Weighted L1 + ssim_weight (1 - SSIM) of images (H, W, 3), a scalar, and its gradient by `image` (H, W, 3)."""
    with torch.cuda.device_of(image):
        height, length = image.shape[0], 3 * image.shape[1]
        grid = (triton.cdiv(height, ROWS), triton.cdiv(length, COLUMNS))
        taps = window(image.device)
        gradient = torch.empty_like(image)
        on_a, on_p, on_r = (torch.empty_like(image) for _ in range(3))
        similar, different = (image.new_empty(grid[0] * grid[1]) for _ in range(2))
        block = {"ROWS": ROWS, "COLUMNS": COLUMNS, "enable_fp_fusion": True}
        similarity[grid](image, target, taps, on_a, on_p, on_r, similar, height, length, **block)
        per_value = 1.0 / image.numel()
        loss_gradient[grid](
            image, target, image if pixel_weight is None else pixel_weight, taps, on_a, on_p, on_r, gradient, different,
            height, length, l1_weight, per_value, -ssim_weight * per_value, WEIGHTED=pixel_weight is not None, **block,
        )  # fmt: skip
        return per_value * different.sum() + ssim_weight * (1.0 - per_value * similar.sum()), gradient
