"""From the map to the image on a GPU: one program a block of splats; the same steps as csrc/rasterizer/projection.hpp.

Positions in float64 relative to the camera, the rest in float32. `project` also counts the tiles that each splat's
ellipse touches, row by row of tiles (`lists`).
"""

from __future__ import annotations

import triton
import triton.language as tl

from mvsgs_core.rasterizer import interface, kernels
from mvsgs_core.rasterizer.triton.harmonics import basis
from mvsgs_core.rasterizer.triton.lists import SIZES, row_span, tile_rows

# A splat on the image. With d = pixel - mean: u = pitch_u (dx - shear dy), v = pitch_v dy, m = u^2 + v^2. The mean is
# whole + part, so that dx keeps its precision far from the corner.
ROW = 16  # whole x, whole y, part x, part y, pitch u, shear, pitch v, log2 opacity, red, green, blue, depth, beta / 2
FOOTPRINT = 5  # half height, turn, 1 / pitch u, pitch v^2, reach: where the ellipse alpha = 1/255 ends on a row

BLUR = tl.constexpr(interface.BLUR)
HALF_MARGIN = tl.constexpr(0.5 * interface.CLAMP_MARGIN)
MIN_COMPENSATION = tl.constexpr(interface.MIN_COMPENSATION)
MAX_MOTION = tl.constexpr(interface.MAX_MOTION)
MAX_VARIANCE = tl.constexpr(interface.MAX_VARIANCE)
MAX_REACH = tl.constexpr(interface.MAX_REACH)
LOG2_MAX_REACH = tl.constexpr(40.0)
MIN_QUATERNION = tl.constexpr(interface.MIN_QUATERNION)
MIN_BETA, MAX_BETA = tl.constexpr(kernels.BETA_RANGE[0]), tl.constexpr(kernels.BETA_RANGE[1])
MAX_FLOAT = tl.constexpr(3.4028234e38)
TINY = tl.constexpr(1e-30)


@triton.jit
def finite(value):  # type: ignore[no-untyped-def]
    """False for NaN as well."""
    return tl.abs(value) <= MAX_FLOAT


@triton.jit
def camera_of(camera):  # type: ignore[no-untyped-def]
    """Rotation world_from_cam by rows and the camera's center, float64."""
    return (
        tl.load(camera), tl.load(camera + 1), tl.load(camera + 2), tl.load(camera + 4), tl.load(camera + 5),
        tl.load(camera + 6), tl.load(camera + 8), tl.load(camera + 9), tl.load(camera + 10),
        tl.load(camera + 3), tl.load(camera + 7), tl.load(camera + 11),
    )  # fmt: skip


@triton.jit
def slope_of(x, z, focal, center, size):  # type: ignore[no-untyped-def]
    """x / z as the Jacobian takes it: clamped to the image widened by 0.3 tan(fov); and whether it was inside."""
    raw = (x / z).to(tl.float32)
    margin = HALF_MARGIN * size / focal
    slope = tl.minimum(tl.maximum(raw, -(center + 0.5) / focal - margin), (size - 0.5 - center) / focal + margin)
    return slope, slope == raw


@triton.jit
def unit_quaternion(quaternions, n, inside):  # type: ignore[no-untyped-def]
    """The unit quaternion, and 1 / length; length 0 gives the identity's."""
    a = tl.load(quaternions + 4 * n, mask=inside, other=1.0)
    b = tl.load(quaternions + 4 * n + 1, mask=inside, other=0.0)
    c = tl.load(quaternions + 4 * n + 2, mask=inside, other=0.0)
    d = tl.load(quaternions + 4 * n + 3, mask=inside, other=0.0)
    squared = a * a + b * b + c * c + d * d
    good = squared > MIN_QUATERNION * MIN_QUATERNION
    inverse = 1.0 / tl.sqrt(tl.where(good, squared, 1.0))
    return a * inverse, b * inverse, c * inverse, d * inverse, inverse, good & finite(squared)


@triton.jit
def rotation_of(a, b, c, d):  # type: ignore[no-untyped-def]
    """The matrix of a unit quaternion by rows."""
    return (
        1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c),
        2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b),
        2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c),
    )  # fmt: skip


@triton.jit
def to_image_of(r00, r01, r02, r10, r11, r12, r20, r21, r22, jx, jy, slope_x, slope_y):  # type: ignore[no-untyped-def]
    """Jacobian of the projection times cam_from_world, by rows."""
    wx, wy, wz = r02.to(tl.float32), r12.to(tl.float32), r22.to(tl.float32)
    return (
        jx * (r00.to(tl.float32) - slope_x * wx), jx * (r10.to(tl.float32) - slope_x * wy),
        jx * (r20.to(tl.float32) - slope_x * wz), jy * (r01.to(tl.float32) - slope_y * wx),
        jy * (r11.to(tl.float32) - slope_y * wy), jy * (r21.to(tl.float32) - slope_y * wz),
    )  # fmt: skip


@triton.jit
def motion_of(  # type: ignore[no-untyped-def]
    exact_y, exact_z, slope_x, slope_y, fx, fy, cy, width, height, by_x, by_y, by_z, about_x, about_y, about_z
):
    """How a rolling shutter moves a splat: u, v in px, whether they were limited, stretch, shear, late; see Motion."""
    inverse_z = 1.0 / exact_z.to(tl.float32)
    nearer = by_z * inverse_z + about_x * slope_y - about_y * slope_x
    raw_u = fx * (about_z * slope_y - about_y - by_x * inverse_z + slope_x * nearer)
    raw_v = fy * (about_x - about_z * slope_x - by_y * inverse_z + slope_y * nearer)
    most_u, most_v = width * MAX_MOTION, height * MAX_MOTION
    u = tl.minimum(tl.maximum(raw_u, -most_u), most_u)
    v = tl.minimum(tl.maximum(raw_v, -most_v), most_v)
    stretch = height / (height - v)
    late = ((fy * (exact_y / exact_z) + cy) / height - 0.5).to(tl.float32) * stretch
    return u, v, u == raw_u, v == raw_v, nearer, stretch, u * stretch / height, late


@triton.jit
def axis_of(log_scales, at, inside, m00, m01, m02, m10, m11, m12, q0, q1, q2):  # type: ignore[no-untyped-def]
    """One axis of the splat, (q0, q1, q2) in the world, on the image in px; its length in the world; all finite."""
    log_scale = tl.load(log_scales + at, mask=inside, other=0.0)
    scale = tl.exp(log_scale)
    return (
        scale * (m00 * q0 + m01 * q1 + m02 * q2), scale * (m10 * q0 + m11 * q1 + m12 * q2), scale, finite(log_scale)
    )  # fmt: skip


@triton.jit
def covariance_of(s0, s1, s2, t0, t1, t2):  # type: ignore[no-untyped-def]
    """xx, xy, yy of the sharp covariance and its determinant by Lagrange's identity: no cancellation for needles."""
    n0, n1, n2 = s1 * t2 - s2 * t1, s2 * t0 - s0 * t2, s0 * t1 - s1 * t0
    return (
        s0 * s0 + s1 * s1 + s2 * s2, s0 * t0 + s1 * t1 + s2 * t2, t0 * t0 + t1 * t1 + t2 * t2,
        n0 * n0 + n1 * n1 + n2 * n2,
    )  # fmt: skip


@triton.jit
def opacity_of(logit, sharp, determinant, ANTIALIASED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Sigmoid, and the factor for the blur."""
    sigmoid = 1.0 / (1.0 + tl.exp(-logit))
    compensation = sigmoid * 0.0 + 1.0
    if ANTIALIASED:
        compensation = tl.sqrt(tl.maximum(sharp / determinant, MIN_COMPENSATION * MIN_COMPENSATION))
    return sigmoid, compensation


@triton.jit(do_not_specialize=SIZES)
def project(  # type: ignore[no-untyped-def]
    means, log_scales, quaternions, opacity_logits, sh, betas, camera, rows, footprints, depths, radii, pairs, refused,
    count, width, height, fx, fy, cx, cy, by_x, by_y, by_z, about_x, about_y, about_z, near,
    BASES: tl.constexpr, USED: tl.constexpr, EXACT: tl.constexpr, ANTIALIASED: tl.constexpr, ROLLING: tl.constexpr,
    BLOCK: tl.constexpr, ROW: tl.constexpr, FOOTPRINT: tl.constexpr,
):  # fmt: skip
    """Fills rows (N, ROW), footprints (N, FOOTPRINT), depths (N,) (inf if not seen), radii (N,) px (0 if not seen),

    pairs (N,), the tiles inside each splat's row spans, and refused (programs,), the splats left out as not usable.
    """
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = n < count
    r00, r01, r02, r10, r11, r12, r20, r21, r22, c0, c1, c2 = camera_of(camera)
    mean_0 = tl.load(means + 3 * n, mask=inside, other=0.0)
    mean_1 = tl.load(means + 3 * n + 1, mask=inside, other=0.0)
    mean_2 = tl.load(means + 3 * n + 2, mask=inside, other=0.0)
    d0, d1, d2 = mean_0.to(tl.float64) - c0, mean_1.to(tl.float64) - c1, mean_2.to(tl.float64) - c2
    logit = tl.load(opacity_logits + n, mask=inside, other=0.0)
    raw_beta = tl.load(betas + n, mask=inside, other=2.0)
    a, b, c, d, _inverse, usable = unit_quaternion(quaternions, n, inside)
    usable = usable & finite(mean_0) & finite(mean_1) & finite(mean_2) & finite(logit) & finite(raw_beta)
    for k in tl.static_range(3 * BASES):
        usable = usable & finite(tl.load(sh + 3 * BASES * n + k, mask=inside, other=0.0))

    exact_z = d0 * r02 + d1 * r12 + d2 * r22
    before = exact_z > near
    exact_z = tl.where(before, exact_z, 1.0)
    exact_x, exact_y = d0 * r00 + d1 * r10 + d2 * r20, d0 * r01 + d1 * r11 + d2 * r21
    z = exact_z.to(tl.float32)
    u = fx * (exact_x / exact_z) + cx
    v = fy * (exact_y / exact_z) + cy
    slope_x, _inside_x = slope_of(exact_x, exact_z, fx, cx, width)
    slope_y, _inside_y = slope_of(exact_y, exact_z, fy, cy, height)
    m00, m01, m02, m10, m11, m12 = to_image_of(
        r00, r01, r02, r10, r11, r12, r20, r21, r22, fx / z, fy / z, slope_x, slope_y
    )
    if ROLLING:
        move_u, move_v, _inside_u, _inside_v, _nearer, stretch, lean, late = motion_of(
            exact_y, exact_z, slope_x, slope_y, fx, fy, cy, width, height, by_x, by_y, by_z, about_x, about_y, about_z
        )
        u += late * move_u
        v += late * move_v
        m00, m01, m02 = m00 + lean * m10, m01 + lean * m11, m02 + lean * m12
        m10, m11, m12 = stretch * m10, stretch * m11, stretch * m12
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation_of(a, b, c, d)
    s0, t0, _scale_0, good_0 = axis_of(log_scales, 3 * n, inside, m00, m01, m02, m10, m11, m12, q00, q10, q20)
    s1, t1, _scale_1, good_1 = axis_of(log_scales, 3 * n + 1, inside, m00, m01, m02, m10, m11, m12, q01, q11, q21)
    s2, t2, _scale_2, good_2 = axis_of(log_scales, 3 * n + 2, inside, m00, m01, m02, m10, m11, m12, q02, q12, q22)
    usable = usable & good_0 & good_1 & good_2
    xx, xy, yy, sharp = covariance_of(s0, s1, s2, t0, t1, t2)
    determinant = sharp + BLUR * (xx + yy) + BLUR * BLUR
    xx += BLUR
    yy += BLUR
    sane = (xx < MAX_VARIANCE) & (yy < MAX_VARIANCE) & finite(determinant)
    seen = inside & usable & before & sane
    tl.store(refused + tl.program_id(0), tl.sum((inside & ~(usable & (sane | ~before))).to(tl.int32), axis=0))
    xx, yy = tl.where(seen, xx, 1.0), tl.where(seen, yy, 1.0)
    xy, determinant = tl.where(seen, xy, 0.0), tl.where(seen, determinant, 1.0)
    sigmoid, compensation = opacity_of(logit, tl.where(seen, sharp, 1.0), determinant, ANTIALIASED)
    opacity = tl.where(seen, sigmoid * compensation, 0.0)
    beta = tl.minimum(tl.maximum(raw_beta, MIN_BETA), MAX_BETA)

    reach = 2.0 * tl.log(tl.maximum(opacity * 255.0, 1.0))
    if EXACT:
        reach = tl.exp2(tl.minimum(2.0 / beta * tl.log2(tl.maximum(reach, TINY)), LOG2_MAX_REACH))
        reach = tl.minimum(reach, MAX_REACH)
    half_width, half_height = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    seen = seen & (opacity >= 1.0 / 255.0)
    seen = seen & (u + half_width >= 0) & (u - half_width <= width - 1)
    seen = seen & (v + half_height >= 0) & (v - half_height <= height - 1)
    u, v = tl.where(seen, u, 0.0), tl.where(seen, v, 0.0)
    whole_x, whole_y = tl.floor(u + 0.5), tl.floor(v + 0.5)
    part_x, part_y = (u - whole_x).to(tl.float32), (v - whole_y).to(tl.float32)
    center_x, center_y = whole_x.to(tl.float32) + part_x, whole_y.to(tl.float32) + part_y
    shear = xy / yy
    turn = xy * tl.sqrt(reach / xx)
    inverse_pitch_u = tl.sqrt(determinant / yy)

    inverse_distance = 1.0 / tl.sqrt(tl.maximum(d0 * d0 + d1 * d1 + d2 * d2, TINY))
    x = (d0 * inverse_distance).to(tl.float32)
    y = (d1 * inverse_distance).to(tl.float32)
    w = (d2 * inverse_distance).to(tl.float32)
    row = rows + ROW * n
    for channel in tl.static_range(3):
        color = tl.zeros([BLOCK], tl.float32) + 0.5
        for k in tl.static_range(USED):
            color += basis(k, x, y, w) * tl.load(sh + 3 * BASES * n + 3 * k + channel, mask=seen, other=0.0)
        tl.store(row + 8 + channel, tl.maximum(color, 0.0), mask=seen)
    tl.store(row, whole_x.to(tl.float32), mask=seen)
    tl.store(row + 1, whole_y.to(tl.float32), mask=seen)
    tl.store(row + 2, part_x, mask=seen)
    tl.store(row + 3, part_y, mask=seen)
    tl.store(row + 4, tl.sqrt(yy / determinant), mask=seen)
    tl.store(row + 5, shear, mask=seen)
    tl.store(row + 6, 1.0 / tl.sqrt(yy), mask=seen)
    tl.store(row + 7, tl.log2(tl.maximum(opacity, TINY)), mask=seen)
    tl.store(row + 11, z, mask=seen)
    tl.store(row + 12, 0.5 * beta, mask=seen)
    footprint = footprints + FOOTPRINT * n
    tl.store(footprint, half_height, mask=seen)
    tl.store(footprint + 1, turn, mask=seen)
    tl.store(footprint + 2, inverse_pitch_u, mask=seen)
    tl.store(footprint + 3, 1.0 / yy, mask=seen)
    tl.store(footprint + 4, reach, mask=seen)
    tl.store(depths + n, tl.where(seen, z, float("inf")), mask=inside)
    tl.store(radii + n, tl.where(seen, tl.maximum(half_width, half_height), 0.0), mask=inside)

    top, bottom = tile_rows(center_y, half_height, height, seen)
    total = tl.zeros([BLOCK], tl.int32)
    step = 0
    steps = tl.max(bottom // 16 - top // 16 + 1, axis=0)
    while step < steps:
        first, last = row_span(
            top // 16 + step, top, bottom, center_x, center_y, shear, half_height, turn, inverse_pitch_u, 1.0 / yy,
            reach, width,
        )  # fmt: skip
        total += tl.maximum(last - first + 1, 0)
        step += 1
    tl.store(pairs + n, total, mask=inside)
