// One splat at a time from the map to the image, for the plain loops: the arithmetic of rasterizer/projection.hpp
// and rasterizer/shading.hpp, which take sixteen.
#pragma once

#include <bit>
#include <cmath>

#include "rasterizer/frame.hpp"

namespace splats::plain {

struct Projection {
    double offset[3];       // mean - camera center, world
    float x, y, z;          // in the camera's frame
    double u, v;            // mean on the image, px
    float slope_x, slope_y; // x/z, y/z as the Jacobian takes them
    bool inside_x, inside_y;
    float rotation[3][3];   // of the splat
    float unit[4], inverse_norm;  // quaternion
    float scale[3];
    float to_image[2][3];   // Jacobian times cam_from_world
    float axes[2][3];       // the splat's axes on the image, px
    float xx, xy, yy;       // covariance with blur, px^2
    float sharp, determinant;
    float sigmoid, compensation;
    float beta;
    bool beta_inside;
};

enum class Fate { kSeen, kBehind, kFaint, kRefused };

// By the bits of the exponent: comparisons with NaN are nothing that optimized arithmetic can be trusted with.
SPLATS_INLINE bool finite(const float* values, int count) {
    bool good = true;
    for (int i = 0; i < count; ++i) good &= (std::bit_cast<uint32_t>(values[i]) & 0x7f800000u) != 0x7f800000u;
    return good;
}

SPLATS_INLINE bool usable(const Parameters& p, int64_t i) {
    const float* q = p.quaternions + 4 * i;
    const float tail[2] = {p.opacity_logits[i], p.betas[i]};
    return finite(p.means + 3 * i, 3) && finite(p.log_scales + 3 * i, 3) && finite(q, 4) && finite(tail, 2) &&
           finite(p.sh + 3 * p.bases * i, 3 * p.bases) &&
           q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > kMinQuaternion * kMinQuaternion;
}

SPLATS_INLINE Fate project(const Camera& camera, const Parameters& p, int64_t i, Projection& r) {
    const double z = (p.means[3 * i] - camera.center[0]) * camera.rotation[0][2] +
                     (p.means[3 * i + 1] - camera.center[1]) * camera.rotation[1][2] +
                     (p.means[3 * i + 2] - camera.center[2]) * camera.rotation[2][2];
    if (!usable(p, i)) return Fate::kRefused;
    if (!(z > camera.near)) return Fate::kBehind;
    double point[2] = {0, 0};
    for (int k = 0; k < 3; ++k) {
        r.offset[k] = p.means[3 * i + k] - camera.center[k];
        point[0] += r.offset[k] * camera.rotation[k][0];
        point[1] += r.offset[k] * camera.rotation[k][1];
    }
    r.x = float(point[0]);
    r.y = float(point[1]);
    r.z = float(z);
    r.u = camera.fx * point[0] / z + camera.cx;
    r.v = camera.fy * point[1] / z + camera.cy;
    const float raw_x = float(point[0] / z), raw_y = float(point[1] / z);
    r.slope_x = smaller(larger(raw_x, camera.slope_min[0]), camera.slope_max[0]);
    r.slope_y = smaller(larger(raw_y, camera.slope_min[1]), camera.slope_max[1]);
    r.inside_x = r.slope_x == raw_x;
    r.inside_y = r.slope_y == raw_y;

    const float* q = p.quaternions + 4 * i;
    r.inverse_norm = 1.0f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4; ++k) r.unit[k] = q[k] * r.inverse_norm;
    const float a = r.unit[0], b = r.unit[1], c = r.unit[2], d = r.unit[3];
    r.rotation[0][0] = 1 - 2 * (c * c + d * d);
    r.rotation[0][1] = 2 * (b * c - a * d);
    r.rotation[0][2] = 2 * (b * d + a * c);
    r.rotation[1][0] = 2 * (b * c + a * d);
    r.rotation[1][1] = 1 - 2 * (b * b + d * d);
    r.rotation[1][2] = 2 * (c * d - a * b);
    r.rotation[2][0] = 2 * (b * d - a * c);
    r.rotation[2][1] = 2 * (c * d + a * b);
    r.rotation[2][2] = 1 - 2 * (b * b + c * c);

    const float jx = camera.fx / r.z, jy = camera.fy / r.z;
    for (int k = 0; k < 3; ++k) {
        const float wx = float(camera.rotation[k][0]), wy = float(camera.rotation[k][1]);
        const float wz = float(camera.rotation[k][2]);
        r.to_image[0][k] = jx * (wx - r.slope_x * wz);
        r.to_image[1][k] = jy * (wy - r.slope_y * wz);
    }
    for (int k = 0; k < 3; ++k) {
        r.scale[k] = std::exp(p.log_scales[3 * i + k]);
        for (int row = 0; row < 2; ++row)
            r.axes[row][k] = r.scale[k] * (r.to_image[row][0] * r.rotation[0][k] + r.to_image[row][1] * r.rotation[1][k] +
                                           r.to_image[row][2] * r.rotation[2][k]);
    }
    const float *s = r.axes[0], *t = r.axes[1];
    const float xx = s[0] * s[0] + s[1] * s[1] + s[2] * s[2], yy = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
    r.xy = s[0] * t[0] + s[1] * t[1] + s[2] * t[2];
    const float n0 = s[1] * t[2] - s[2] * t[1], n1 = s[2] * t[0] - s[0] * t[2], n2 = s[0] * t[1] - s[1] * t[0];
    r.sharp = n0 * n0 + n1 * n1 + n2 * n2;  // Lagrange's identity: no cancellation for needles
    r.determinant = r.sharp + kBlur * (xx + yy) + kBlur * kBlur;
    r.xx = xx + kBlur;
    r.yy = yy + kBlur;
    if (!(r.xx < kMaxVariance && r.yy < kMaxVariance && std::isfinite(r.determinant))) return Fate::kRefused;

    r.sigmoid = 1.0f / (1.0f + std::exp(-p.opacity_logits[i]));
    r.compensation = 1.0f;
    if (p.antialiased)
        r.compensation = std::sqrt(larger(r.sharp / r.determinant, kMinCompensation * kMinCompensation));
    r.beta = smaller(larger(p.betas[i], kMinBeta), kMaxBeta);
    r.beta_inside = r.beta == p.betas[i];
    return r.sigmoid * r.compensation >= 1.0f / 255.0f ? Fate::kSeen : Fate::kFaint;
}

// basis[(degree + 1)^2] at the unit direction (x, y, z).
SPLATS_INLINE void harmonics(int degree, float x, float y, float z, float* basis) {
    basis[0] = 0.28209479177387814f;
    if (degree < 1) return;
    basis[1] = -0.4886025119029199f * y;
    basis[2] = 0.4886025119029199f * z;
    basis[3] = -0.4886025119029199f * x;
    if (degree < 2) return;
    basis[4] = 1.0925484305920792f * x * y;
    basis[5] = -1.0925484305920792f * y * z;
    basis[6] = 0.31539156525252005f * (2 * z * z - x * x - y * y);
    basis[7] = -1.0925484305920792f * x * z;
    basis[8] = 0.5462742152960396f * (x * x - y * y);
    if (degree < 3) return;
    basis[9] = -0.5900435899266435f * y * (3 * x * x - y * y);
    basis[10] = 2.890611442640554f * x * y * z;
    basis[11] = -0.4570457994644658f * y * (4 * z * z - x * x - y * y);
    basis[12] = 0.3731763325901154f * z * (2 * z * z - 3 * x * x - 3 * y * y);
    basis[13] = -0.4570457994644658f * x * (4 * z * z - x * x - y * y);
    basis[14] = 1.445305721320277f * z * (x * x - y * y);
    basis[15] = -0.5900435899266435f * x * (x * x - 3 * y * y);
}

struct Shading {
    float direction[3];       // unit, from the camera to the splat, world
    float inverse_distance;
    float basis[16];
    float raw[3];             // 1/2 + sum, before it is clamped at 0
};

SPLATS_INLINE void shade(const Parameters& p, int64_t i, const Projection& r, Shading& s) {
    const double squared = r.offset[0] * r.offset[0] + r.offset[1] * r.offset[1] + r.offset[2] * r.offset[2];
    const double inverse = 1.0 / std::sqrt(squared);
    s.inverse_distance = float(inverse);
    for (int k = 0; k < 3; ++k) s.direction[k] = float(r.offset[k] * inverse);
    harmonics(p.degree, s.direction[0], s.direction[1], s.direction[2], s.basis);
    const int used = (p.degree + 1) * (p.degree + 1);
    const float* sh = p.sh + 3 * p.bases * i;
    float red = 0.5f, green = 0.5f, blue = 0.5f;
    for (int b = 0; b < used; ++b) {
        red += s.basis[b] * sh[3 * b];
        green += s.basis[b] * sh[3 * b + 1];
        blue += s.basis[b] * sh[3 * b + 2];
    }
    s.raw[0] = red;
    s.raw[1] = green;
    s.raw[2] = blue;
}

}  // namespace splats::plain
