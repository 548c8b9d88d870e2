// Real spherical harmonics up to degree 3, order and signs as in 3DGS files, of one direction or of sixteen, one in each
// lane; and their derivatives.
#pragma once

#include "rasterizer/lanes.hpp"

namespace splats {

// basis[(degree + 1)^2] at the unit direction (x, y, z).
template <class Number>
SPLATS_INLINE void harmonics(int degree, const Number& x, const Number& y, const Number& z, Number* basis) {
    basis[0] = Number{} + 0.28209479177387814f;
    if (degree < 1) return;
    basis[1] = -0.4886025119029199f * y;
    basis[2] = 0.4886025119029199f * z;
    basis[3] = -0.4886025119029199f * x;
    if (degree < 2) return;
    basis[4] = 1.0925484305920792f * x * y;
    basis[5] = -1.0925484305920792f * y * z;
    basis[6] = 0.31539156525252005f * (2.0f * z * z - x * x - y * y);
    basis[7] = -1.0925484305920792f * x * z;
    basis[8] = 0.5462742152960396f * (x * x - y * y);
    if (degree < 3) return;
    basis[9] = -0.5900435899266435f * y * (3.0f * x * x - y * y);
    basis[10] = 2.890611442640554f * x * y * z;
    basis[11] = -0.4570457994644658f * y * (4.0f * z * z - x * x - y * y);
    basis[12] = 0.3731763325901154f * z * (2.0f * z * z - 3.0f * x * x - 3.0f * y * y);
    basis[13] = -0.4570457994644658f * x * (4.0f * z * z - x * x - y * y);
    basis[14] = 1.445305721320277f * z * (x * x - y * y);
    basis[15] = -0.5900435899266435f * x * (x * x - 3.0f * y * y);
}

// gradient[3] of sum_i weight[i] basis[i] with respect to (x, y, z), taken as independent.
SPLATS_INLINE void harmonics_gradient(int degree, const Lanes& x, const Lanes& y, const Lanes& z, const Lanes* weight,
                                      Lanes* gradient) {
    Lanes gx{}, gy{}, gz{};
    if (degree >= 1) {
        gy = gy - 0.4886025119029199f * weight[1];
        gz += 0.4886025119029199f * weight[2];
        gx = gx - 0.4886025119029199f * weight[3];
    }
    if (degree >= 2) {
        const float a = 1.0925484305920792f, b = 0.31539156525252005f, c = 0.5462742152960396f;
        gx += a * y * weight[4] - 2.0f * b * x * weight[6] - a * z * weight[7] + 2.0f * c * x * weight[8];
        gy += a * x * weight[4] - a * z * weight[5] - 2.0f * b * y * weight[6] - 2.0f * c * y * weight[8];
        gz += -a * y * weight[5] + 4.0f * b * z * weight[6] - a * x * weight[7];
    }
    if (degree >= 3) {
        const float a = -0.5900435899266435f, b = 2.890611442640554f, c = -0.4570457994644658f;
        const float d = 0.3731763325901154f, e = 1.445305721320277f;
        const Lanes xx = x * x, yy = y * y, zz = z * z;
        gx += 6.0f * a * x * y * weight[9] + b * y * z * weight[10] - 2.0f * c * x * y * weight[11] -
              6.0f * d * x * z * weight[12] + c * (4.0f * zz - 3.0f * xx - yy) * weight[13] +
              2.0f * e * x * z * weight[14] + 3.0f * a * (xx - yy) * weight[15];
        gy += 3.0f * a * (xx - yy) * weight[9] + b * x * z * weight[10] +
              c * (4.0f * zz - xx - 3.0f * yy) * weight[11] -
              6.0f * d * y * z * weight[12] - 2.0f * c * x * y * weight[13] - 2.0f * e * y * z * weight[14] -
              6.0f * a * x * y * weight[15];
        gz += b * x * y * weight[10] + 8.0f * c * y * z * weight[11] + 3.0f * d * (2.0f * zz - xx - yy) * weight[12] +
              8.0f * c * x * z * weight[13] + e * (xx - yy) * weight[14];
    }
    gradient[0] = gx;
    gradient[1] = gy;
    gradient[2] = gz;
}

}  // namespace splats
