"""Real spherical harmonics for the Triton kernels: order and signs of `spherical_harmonics`, and their derivatives."""

from __future__ import annotations

import triton
import triton.language as tl

from mvsgs_core.rasterizer import spherical_harmonics

C0 = tl.constexpr(spherical_harmonics.C0)
C1 = tl.constexpr(spherical_harmonics.C1)
C4 = tl.constexpr(spherical_harmonics.C2[0])
C6 = tl.constexpr(spherical_harmonics.C2[2])
C8 = tl.constexpr(spherical_harmonics.C2[4])
C9 = tl.constexpr(spherical_harmonics.C3[0])
C10 = tl.constexpr(spherical_harmonics.C3[1])
C11 = tl.constexpr(spherical_harmonics.C3[2])
C12 = tl.constexpr(spherical_harmonics.C3[3])
C14 = tl.constexpr(spherical_harmonics.C3[5])


@triton.jit
def basis(k: tl.constexpr, x, y, z):  # type: ignore[no-untyped-def]
    """Value `k` of the basis at the unit direction (x, y, z)."""
    value = 0.0 * x + C0
    if k == 1:
        value = -C1 * y
    elif k == 2:
        value = C1 * z
    elif k == 3:
        value = -C1 * x
    elif k == 4:
        value = C4 * x * y
    elif k == 5:
        value = -C4 * y * z
    elif k == 6:
        value = C6 * (2 * z * z - x * x - y * y)
    elif k == 7:
        value = -C4 * x * z
    elif k == 8:
        value = C8 * (x * x - y * y)
    elif k == 9:
        value = C9 * y * (3 * x * x - y * y)
    elif k == 10:
        value = C10 * x * y * z
    elif k == 11:
        value = C11 * y * (4 * z * z - x * x - y * y)
    elif k == 12:
        value = C12 * z * (2 * z * z - 3 * x * x - 3 * y * y)
    elif k == 13:
        value = C11 * x * (4 * z * z - x * x - y * y)
    elif k == 14:
        value = C14 * z * (x * x - y * y)
    elif k == 15:
        value = C9 * x * (x * x - 3 * y * y)
    return value


@triton.jit
def basis_gradient(k: tl.constexpr, x, y, z):  # type: ignore[no-untyped-def]
    """Derivatives of value `k` by x, y and z, taken as independent."""
    none = 0.0 * x
    on_x, on_y, on_z = none, none, none
    if k == 1:
        on_y = none - C1
    elif k == 2:
        on_z = none + C1
    elif k == 3:
        on_x = none - C1
    elif k == 4:
        on_x, on_y = C4 * y, C4 * x
    elif k == 5:
        on_y, on_z = -C4 * z, -C4 * y
    elif k == 6:
        on_x, on_y, on_z = -2 * C6 * x, -2 * C6 * y, 4 * C6 * z
    elif k == 7:
        on_x, on_z = -C4 * z, -C4 * x
    elif k == 8:
        on_x, on_y = 2 * C8 * x, -2 * C8 * y
    elif k == 9:
        on_x, on_y = 6 * C9 * x * y, 3 * C9 * (x * x - y * y)
    elif k == 10:
        on_x, on_y, on_z = C10 * y * z, C10 * x * z, C10 * x * y
    elif k == 11:
        on_x, on_y, on_z = -2 * C11 * x * y, C11 * (4 * z * z - x * x - 3 * y * y), 8 * C11 * y * z
    elif k == 12:
        on_x, on_y, on_z = -6 * C12 * x * z, -6 * C12 * y * z, 3 * C12 * (2 * z * z - x * x - y * y)
    elif k == 13:
        on_x, on_y, on_z = C11 * (4 * z * z - 3 * x * x - y * y), -2 * C11 * x * y, 8 * C11 * x * z
    elif k == 14:
        on_x, on_y, on_z = 2 * C14 * x * z, -2 * C14 * y * z, C14 * (x * x - y * y)
    elif k == 15:
        on_x, on_y = 3 * C9 * (x * x - y * y), -6 * C9 * x * y
    return on_x, on_y, on_z
