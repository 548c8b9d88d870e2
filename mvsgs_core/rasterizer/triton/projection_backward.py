"""From the sums over a splat's pairs to its parameters and the pose on a GPU: csrc/rasterizer/project_backward.cpp."""

from __future__ import annotations

import triton
import triton.language as tl

from mvsgs_core.rasterizer.triton.harmonics import basis, basis_gradient
from mvsgs_core.rasterizer.triton.lists import SIZES
from mvsgs_core.rasterizer.triton.projection import (
    BLUR,
    MAX_BETA,
    MIN_BETA,
    MIN_COMPENSATION,
    TINY,
    axis_of,
    camera_of,
    covariance_of,
    finite,
    motion_of,
    opacity_of,
    rotation_of,
    slope_of,
    to_image_of,
    unit_quaternion,
)  # fmt: skip

LN2 = tl.constexpr(0.6931471805599453)


@triton.jit
def _quaternion_gradient(  # type: ignore[no-untyped-def]
    a, b, c, e, inverse, d00, d01, d02, d10, d11, d12, d20, d21, d22
):
    """Of the quaternion before its normalization, from that of the rotation matrix."""
    on_a = 2 * (-e * d01 + c * d02 + e * d10 - b * d12 - c * d20 + b * d21)
    on_b = 2 * (c * (d01 + d10) + e * (d02 + d20) - 2 * b * (d11 + d22) + a * (d21 - d12))
    on_c = 2 * (b * (d01 + d10) + e * (d12 + d21) - 2 * c * (d00 + d22) + a * (d02 - d20))
    on_e = 2 * (b * (d02 + d20) + c * (d12 + d21) - 2 * e * (d00 + d11) + a * (d10 - d01))
    along = on_a * a + on_b * b + on_c * c + on_e * e
    return (
        (on_a - a * along) * inverse, (on_b - b * along) * inverse, (on_c - c * along) * inverse,
        (on_e - e * along) * inverse,
    )  # fmt: skip


@triton.jit
def _axis_gradient(  # type: ignore[no-untyped-def]
    s, t, g_xx, g_xy, g_yy, xx, xy, yy, on_sharp, on_trace
):
    """Of one axis on the image: from the blurred covariance, and from the factor that opacity gets for the blur."""
    on_s = 2 * (g_xx * s + g_xy * t) + 2 * on_sharp * (s * yy - t * xy) + 2 * on_trace * s
    on_t = 2 * (g_xy * s + g_yy * t) + 2 * on_sharp * (t * xx - s * xy) + 2 * on_trace * t
    return on_s, on_t


@triton.jit(do_not_specialize=SIZES)
def project_backward(  # type: ignore[no-untyped-def]
    means, log_scales, quaternions, opacity_logits, sh, betas, camera, rows, totals, pairs,
    on_means, on_log_scales, on_quaternions, on_logits, on_sh, on_betas, on_means2d, on_pose,
    count, width, height, fx, fy, cx, cy, by_x, by_y, by_z, about_x, about_y, about_z,
    BASES: tl.constexpr, USED: tl.constexpr, EXACT: tl.constexpr, ANTIALIASED: tl.constexpr, ROLLING: tl.constexpr,
    POSE: tl.constexpr, BLOCK: tl.constexpr, ROW: tl.constexpr, SUMS: tl.constexpr,
):  # fmt: skip
    """Gradients of all parameters, 0 for splats without pairs and where one is not finite; on_pose (programs, 12)

    float64: each program's part, rotation by rows with the center's as the fourth column; only with POSE.
    """
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = n < count
    seen = inside & (tl.load(pairs + n, mask=inside, other=0) > 0)
    r00, r01, r02, r10, r11, r12, r20, r21, r22, c0, c1, c2 = camera_of(camera)
    d0 = tl.load(means + 3 * n, mask=seen, other=0.0).to(tl.float64) - c0
    d1 = tl.load(means + 3 * n + 1, mask=seen, other=0.0).to(tl.float64) - c1
    d2 = tl.load(means + 3 * n + 2, mask=seen, other=0.0).to(tl.float64) - c2
    exact_x, exact_y = d0 * r00 + d1 * r10 + d2 * r20, d0 * r01 + d1 * r11 + d2 * r21
    exact_z = tl.where(seen, d0 * r02 + d1 * r12 + d2 * r22, 1.0)
    x, y, z = exact_x.to(tl.float32), exact_y.to(tl.float32), exact_z.to(tl.float32)
    slope_x, inside_x = slope_of(exact_x, exact_z, fx, cx, width)
    slope_y, inside_y = slope_of(exact_y, exact_z, fy, cy, height)
    inverse_z = 1.0 / z
    jx, jy = fx * inverse_z, fy * inverse_z
    p00, p01, p02, p10, p11, p12 = to_image_of(r00, r01, r02, r10, r11, r12, r20, r21, r22, jx, jy, slope_x, slope_y)
    m00, m01, m02, m10, m11, m12 = p00, p01, p02, p10, p11, p12
    if ROLLING:
        move_u, move_v, inside_u, inside_v, nearer, stretch, lean, late = motion_of(
            exact_y, exact_z, slope_x, slope_y, fx, fy, cy, width, height, by_x, by_y, by_z, about_x, about_y, about_z
        )
        m00, m01, m02 = p00 + lean * p10, p01 + lean * p11, p02 + lean * p12
        m10, m11, m12 = stretch * p10, stretch * p11, stretch * p12
    a, b, c, e, inverse, _usable = unit_quaternion(quaternions, n, seen)
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation_of(a, b, c, e)
    s0, t0, l0, _good_0 = axis_of(log_scales, 3 * n, seen, m00, m01, m02, m10, m11, m12, q00, q10, q20)
    s1, t1, l1, _good_1 = axis_of(log_scales, 3 * n + 1, seen, m00, m01, m02, m10, m11, m12, q01, q11, q21)
    s2, t2, l2, _good_2 = axis_of(log_scales, 3 * n + 2, seen, m00, m01, m02, m10, m11, m12, q02, q12, q22)
    xx, xy, yy, sharp = covariance_of(s0, s1, s2, t0, t1, t2)
    determinant = sharp + BLUR * (xx + yy) + BLUR * BLUR
    logit = tl.load(opacity_logits + n, mask=seen, other=0.0)
    sigmoid, compensation = opacity_of(logit, sharp, determinant, ANTIALIASED)

    row = rows + ROW * n
    pitch_u = tl.load(row + 4, mask=seen, other=1.0)
    shear = tl.load(row + 5, mask=seen, other=0.0)
    pitch_v = tl.load(row + 6, mask=seen, other=1.0)
    total = totals + SUMS * n
    sum_u = -0.5 * tl.load(total + 5, mask=seen, other=0.0)
    sum_v = -0.5 * tl.load(total + 6, mask=seen, other=0.0)
    sum_uu = -0.5 * tl.load(total + 7, mask=seen, other=0.0)
    sum_uv = -0.5 * tl.load(total + 8, mask=seen, other=0.0)
    sum_vv = -0.5 * tl.load(total + 9, mask=seen, other=0.0)
    on_u = -2 * pitch_u * sum_u
    on_v = 2 * pitch_u * shear * sum_u - 2 * pitch_v * sum_v
    g_xx = -pitch_u * pitch_u * sum_uu
    g_xy = pitch_u * pitch_u * shear * sum_uu - pitch_u * pitch_v * sum_uv
    g_yy = 2 * pitch_u * pitch_v * shear * sum_uv - pitch_v * pitch_v * sum_vv
    g_yy -= pitch_u * pitch_u * shear * shear * sum_uu
    on_opacity = tl.load(total + 4, mask=seen, other=0.0)
    on_logit = on_opacity * (1.0 - sigmoid)
    on_beta = tl.zeros([BLOCK], tl.float32)
    if EXACT:
        beta = tl.load(betas + n, mask=seen, other=2.0)
        on_beta = -0.25 * LN2 * tl.load(total + 10, mask=seen, other=0.0)
        on_beta = tl.where((beta >= MIN_BETA) & (beta <= MAX_BETA), on_beta, 0.0)

    on_sharp = tl.zeros([BLOCK], tl.float32)
    on_trace = tl.zeros([BLOCK], tl.float32)
    if ANTIALIASED:
        moves = compensation > MIN_COMPENSATION
        on_sharp = 0.5 * on_opacity * (1.0 / tl.maximum(sharp, TINY) - 1.0 / determinant)
        on_sharp = tl.where(moves, on_sharp, 0.0)
        on_trace = tl.where(moves, -0.5 * on_opacity * BLUR / determinant, 0.0)
    on_s0, on_t0 = _axis_gradient(s0, t0, g_xx, g_xy, g_yy, xx, xy, yy, on_sharp, on_trace)
    on_s1, on_t1 = _axis_gradient(s1, t1, g_xx, g_xy, g_yy, xx, xy, yy, on_sharp, on_trace)
    on_s2, on_t2 = _axis_gradient(s2, t2, g_xx, g_xy, g_yy, xx, xy, yy, on_sharp, on_trace)
    on_scale_0, on_scale_1, on_scale_2 = on_s0 * s0 + on_t0 * t0, on_s1 * s1 + on_t1 * t1, on_s2 * s2 + on_t2 * t2
    on_a, on_b, on_c, on_e = _quaternion_gradient(
        a, b, c, e, inverse,
        l0 * (m00 * on_s0 + m10 * on_t0), l1 * (m00 * on_s1 + m10 * on_t1), l2 * (m00 * on_s2 + m10 * on_t2),
        l0 * (m01 * on_s0 + m11 * on_t0), l1 * (m01 * on_s1 + m11 * on_t1), l2 * (m01 * on_s2 + m11 * on_t2),
        l0 * (m02 * on_s0 + m12 * on_t0), l1 * (m02 * on_s1 + m12 * on_t1), l2 * (m02 * on_s2 + m12 * on_t2),
    )  # fmt: skip
    # by the rows of Jacobian times cam_from_world
    on_m00 = on_s0 * l0 * q00 + on_s1 * l1 * q01 + on_s2 * l2 * q02
    on_m01 = on_s0 * l0 * q10 + on_s1 * l1 * q11 + on_s2 * l2 * q12
    on_m02 = on_s0 * l0 * q20 + on_s1 * l1 * q21 + on_s2 * l2 * q22
    on_m10 = on_t0 * l0 * q00 + on_t1 * l1 * q01 + on_t2 * l2 * q02
    on_m11 = on_t0 * l0 * q10 + on_t1 * l1 * q11 + on_t2 * l2 * q12
    on_m12 = on_t0 * l0 * q20 + on_t1 * l1 * q21 + on_t2 * l2 * q22
    still_u, still_v = on_u, on_v  # of the mean on the image as a camera that stands still sees it
    motion_x = tl.zeros([BLOCK], tl.float32)  # of x/z, y/z and 1/z through the motion
    motion_y = tl.zeros([BLOCK], tl.float32)
    motion_z = tl.zeros([BLOCK], tl.float32)
    if ROLLING:
        on_lean = on_m00 * p10 + on_m01 * p11 + on_m02 * p12
        on_late = on_u * move_u + on_v * move_v
        on_stretch = on_m10 * p10 + on_m11 * p11 + on_m12 * p12 + on_lean * move_u / height + on_late * late / stretch
        on_m10, on_m11, on_m12 = (
            lean * on_m00 + stretch * on_m10, lean * on_m01 + stretch * on_m11, lean * on_m02 + stretch * on_m12
        )  # fmt: skip
        along_u = fx * tl.where(inside_u, on_u * late + on_lean * stretch / height, 0.0)
        along_v = fy * tl.where(inside_v, on_v * late + on_stretch * stretch * stretch / height, 0.0)
        motion_x = along_u * (nearer - about_y * slope_x) - along_v * (about_z + about_y * slope_y)
        motion_y = along_u * (about_z + about_x * slope_x) + along_v * (nearer + about_x * slope_y)
        motion_z = along_u * (by_z * slope_x - by_x) + along_v * (by_z * slope_y - by_y)
        still_v = on_v + on_late * stretch / height
    on_jx = on_m00 * p00 + on_m01 * p01 + on_m02 * p02
    on_jy = on_m10 * p10 + on_m11 * p11 + on_m12 * p12
    w0, w1, w2 = r02.to(tl.float32), r12.to(tl.float32), r22.to(tl.float32)
    on_slope_x = tl.where(inside_x, motion_x - jx * (on_m00 * w0 + on_m01 * w1 + on_m02 * w2), 0.0)
    on_slope_y = tl.where(inside_y, motion_y - jy * (on_m10 * w0 + on_m11 * w1 + on_m12 * w2), 0.0)
    point_x = still_u * jx + on_slope_x * inverse_z
    point_y = still_v * jy + on_slope_y * inverse_z
    point_z = tl.load(total + 3, mask=seen, other=0.0) - (on_jx + on_jy) * inverse_z
    point_z -= (still_u * jx * x + still_v * jy * y + motion_z * inverse_z) * inverse_z
    point_z -= (on_slope_x * slope_x + on_slope_y * slope_y) * inverse_z

    inverse_distance = 1.0 / tl.sqrt(tl.maximum(d0 * d0 + d1 * d1 + d2 * d2, TINY))
    v0, v1, v2 = (
        (d0 * inverse_distance).to(tl.float32), (d1 * inverse_distance).to(tl.float32),
        (d2 * inverse_distance).to(tl.float32),
    )  # fmt: skip
    coefficient = sh + 3 * BASES * n
    raw_red = tl.zeros([BLOCK], tl.float32) + 0.5
    raw_green = tl.zeros([BLOCK], tl.float32) + 0.5
    raw_blue = tl.zeros([BLOCK], tl.float32) + 0.5
    for k in tl.static_range(USED):
        value = basis(k, v0, v1, v2)
        raw_red += value * tl.load(coefficient + 3 * k, mask=seen, other=0.0)
        raw_green += value * tl.load(coefficient + 3 * k + 1, mask=seen, other=0.0)
        raw_blue += value * tl.load(coefficient + 3 * k + 2, mask=seen, other=0.0)
    red = tl.where(raw_red >= 0.0, tl.load(total, mask=seen, other=0.0), 0.0)
    green = tl.where(raw_green >= 0.0, tl.load(total + 1, mask=seen, other=0.0), 0.0)
    blue = tl.where(raw_blue >= 0.0, tl.load(total + 2, mask=seen, other=0.0), 0.0)
    turn_0 = tl.zeros([BLOCK], tl.float32)
    turn_1 = tl.zeros([BLOCK], tl.float32)
    turn_2 = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(1, USED):
        by_0, by_1, by_2 = basis_gradient(k, v0, v1, v2)
        weight = red * tl.load(coefficient + 3 * k, mask=seen, other=0.0)
        weight += green * tl.load(coefficient + 3 * k + 1, mask=seen, other=0.0)
        weight += blue * tl.load(coefficient + 3 * k + 2, mask=seen, other=0.0)
        turn_0 += weight * by_0
        turn_1 += weight * by_1
        turn_2 += weight * by_2
    along = turn_0 * v0 + turn_1 * v1 + turn_2 * v2
    near = inverse_distance.to(tl.float32)
    offset_0 = point_x * r00 + point_y * r01 + point_z * r02 + ((turn_0 - v0 * along) * near).to(tl.float64)
    offset_1 = point_x * r10 + point_y * r11 + point_z * r12 + ((turn_1 - v1 * along) * near).to(tl.float64)
    offset_2 = point_x * r20 + point_y * r21 + point_z * r22 + ((turn_2 - v2 * along) * near).to(tl.float64)
    mean_0, mean_1, mean_2 = offset_0.to(tl.float32), offset_1.to(tl.float32), offset_2.to(tl.float32)

    good = seen & finite(mean_0) & finite(mean_1) & finite(mean_2) & finite(on_scale_0) & finite(on_scale_1)
    good = good & finite(on_scale_2) & finite(on_a) & finite(on_b) & finite(on_c) & finite(on_e) & finite(on_logit)
    good = good & finite(on_beta) & finite(on_u) & finite(on_v) & finite(red) & finite(green) & finite(blue)
    tl.store(on_means + 3 * n, tl.where(good, mean_0, 0.0), mask=inside)
    tl.store(on_means + 3 * n + 1, tl.where(good, mean_1, 0.0), mask=inside)
    tl.store(on_means + 3 * n + 2, tl.where(good, mean_2, 0.0), mask=inside)
    tl.store(on_log_scales + 3 * n, tl.where(good, on_scale_0, 0.0), mask=inside)
    tl.store(on_log_scales + 3 * n + 1, tl.where(good, on_scale_1, 0.0), mask=inside)
    tl.store(on_log_scales + 3 * n + 2, tl.where(good, on_scale_2, 0.0), mask=inside)
    tl.store(on_quaternions + 4 * n, tl.where(good, on_a, 0.0), mask=inside)
    tl.store(on_quaternions + 4 * n + 1, tl.where(good, on_b, 0.0), mask=inside)
    tl.store(on_quaternions + 4 * n + 2, tl.where(good, on_c, 0.0), mask=inside)
    tl.store(on_quaternions + 4 * n + 3, tl.where(good, on_e, 0.0), mask=inside)
    tl.store(on_logits + n, tl.where(good, on_logit, 0.0), mask=inside)
    tl.store(on_betas + n, tl.where(good, on_beta, 0.0), mask=inside)
    tl.store(on_means2d + 2 * n, tl.where(good, on_u * (0.5 * width), 0.0), mask=inside)
    tl.store(on_means2d + 2 * n + 1, tl.where(good, on_v * (0.5 * height), 0.0), mask=inside)
    for k in tl.static_range(BASES):
        value = tl.zeros([BLOCK], tl.float32)
        if k < USED:
            value += basis(k, v0, v1, v2)
        tl.store(on_sh + 3 * (BASES * n + k), tl.where(good, value * red, 0.0), mask=inside)
        tl.store(on_sh + 3 * (BASES * n + k) + 1, tl.where(good, value * green, 0.0), mask=inside)
        tl.store(on_sh + 3 * (BASES * n + k) + 2, tl.where(good, value * blue, 0.0), mask=inside)
    if POSE:
        out = on_pose + 12 * tl.program_id(0)
        along_x = -jx * slope_x
        along_y = -jy * slope_y
        tl.store(out, tl.sum(tl.where(good, d0 * point_x + jx * on_m00, 0.0), axis=0))
        tl.store(out + 1, tl.sum(tl.where(good, d0 * point_y + jy * on_m10, 0.0), axis=0))
        tl.store(out + 2, tl.sum(tl.where(good, d0 * point_z + along_x * on_m00 + along_y * on_m10, 0.0), axis=0))
        tl.store(out + 3, -tl.sum(tl.where(good, offset_0, 0.0), axis=0))
        tl.store(out + 4, tl.sum(tl.where(good, d1 * point_x + jx * on_m01, 0.0), axis=0))
        tl.store(out + 5, tl.sum(tl.where(good, d1 * point_y + jy * on_m11, 0.0), axis=0))
        tl.store(out + 6, tl.sum(tl.where(good, d1 * point_z + along_x * on_m01 + along_y * on_m11, 0.0), axis=0))
        tl.store(out + 7, -tl.sum(tl.where(good, offset_1, 0.0), axis=0))
        tl.store(out + 8, tl.sum(tl.where(good, d2 * point_x + jx * on_m02, 0.0), axis=0))
        tl.store(out + 9, tl.sum(tl.where(good, d2 * point_y + jy * on_m12, 0.0), axis=0))
        tl.store(out + 10, tl.sum(tl.where(good, d2 * point_z + along_x * on_m02 + along_y * on_m12, 0.0), axis=0))
        tl.store(out + 11, -tl.sum(tl.where(good, offset_2, 0.0), axis=0))
