// One splat at a time from the map to the image, for the plain loops: the arithmetic of rasterizer/projection.hpp
// and rasterizer/shading.hpp, which take sixteen.
#pragma once

#include <cmath>

#include "rasterizer/harmonics.hpp"
#include "rasterizer/projection.hpp"

namespace splats {

struct PlainProjection {
    double offset[3];  // mean - camera center, world
    float u, v;        // mean on the image, px
    float z;           // in the camera's frame
    float xx, xy, yy;  // covariance with blur, px^2
    float determinant;
    float opacity;     // as the image shows it
    float beta;
};

SPLATS_INLINE bool usable(const Parameters& p, int64_t i) {
    const float* q = p.quaternions + 4 * i;
    return finite(p.means + 3 * i, 3) && finite(p.log_scales + 3 * i, 3) && finite(q, 4) &&
           finite(p.opacity_logits + i, 1) && finite(p.betas + i, 1) && finite(p.sh + 3 * p.bases * i, 3 * p.bases) &&
           q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] > kMinQuaternion * kMinQuaternion;
}

// Whether the splat may be seen: usable, in front of the camera, not degenerate on the image and not too faint.
SPLATS_INLINE bool project_plainly(const Camera& camera, const Parameters& p, int64_t i, PlainProjection& r) {
    if (!usable(p, i)) return false;
    double point[3] = {0, 0, 0};
    for (int k = 0; k < 3; ++k) {
        r.offset[k] = p.means[3 * i + k] - camera.center[k];
        for (int axis = 0; axis < 3; ++axis) point[axis] += r.offset[k] * camera.rotation[k][axis];
    }
    if (!(point[2] > camera.near)) return false;
    r.z = float(point[2]);
    r.u = float(camera.fx * point[0] / point[2] + camera.cx);
    r.v = float(camera.fy * point[1] / point[2] + camera.cy);
    const float slope_x = std::clamp(float(point[0] / point[2]), camera.slope_min[0], camera.slope_max[0]);
    const float slope_y = std::clamp(float(point[1] / point[2]), camera.slope_min[1], camera.slope_max[1]);

    const float* q = p.quaternions + 4 * i;
    const float inverse_norm = 1.0f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const float a = q[0] * inverse_norm, b = q[1] * inverse_norm, c = q[2] * inverse_norm, d = q[3] * inverse_norm;
    const float rotation[3][3] = {{1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)},
                                  {2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)},
                                  {2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)}};
    float to_image[2][3], axes[2][3];  // Jacobian times cam_from_world; the splat's axes on the image, px
    for (int k = 0; k < 3; ++k) {
        const float wz = float(camera.rotation[k][2]);
        to_image[0][k] = camera.fx / r.z * (float(camera.rotation[k][0]) - slope_x * wz);
        to_image[1][k] = camera.fy / r.z * (float(camera.rotation[k][1]) - slope_y * wz);
    }
    for (int k = 0; k < 3; ++k) {
        const float scale = std::exp(p.log_scales[3 * i + k]);
        for (int row = 0; row < 2; ++row)
            axes[row][k] = scale * (to_image[row][0] * rotation[0][k] + to_image[row][1] * rotation[1][k] +
                                    to_image[row][2] * rotation[2][k]);
    }
    const float *s = axes[0], *t = axes[1];
    const float xx = s[0] * s[0] + s[1] * s[1] + s[2] * s[2], yy = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
    r.xy = s[0] * t[0] + s[1] * t[1] + s[2] * t[2];
    const float n0 = s[1] * t[2] - s[2] * t[1], n1 = s[2] * t[0] - s[0] * t[2], n2 = s[0] * t[1] - s[1] * t[0];
    const float sharp = n0 * n0 + n1 * n1 + n2 * n2;  // Lagrange's identity: no cancellation for needles
    r.determinant = sharp + kBlur * (xx + yy) + kBlur * kBlur;
    r.xx = xx + kBlur;
    r.yy = yy + kBlur;
    if (!(r.xx < kMaxVariance && r.yy < kMaxVariance && std::isfinite(r.determinant))) return false;

    r.opacity = 1.0f / (1.0f + std::exp(-p.opacity_logits[i]));
    if (p.antialiased) r.opacity *= std::sqrt(std::max(sharp / r.determinant, kMinCompensation * kMinCompensation));
    r.beta = std::clamp(p.betas[i], kMinBeta, kMaxBeta);
    return r.opacity >= 1.0f / 255.0f;
}

// The splat's color as seen from the camera.
SPLATS_INLINE void shade_plainly(const Parameters& p, int64_t i, const PlainProjection& r, float (&color)[3]) {
    const double squared = r.offset[0] * r.offset[0] + r.offset[1] * r.offset[1] + r.offset[2] * r.offset[2];
    const double inverse = 1.0 / std::sqrt(squared);
    float basis[16];
    harmonics(p.degree, float(r.offset[0] * inverse), float(r.offset[1] * inverse), float(r.offset[2] * inverse), basis);
    const int used = (p.degree + 1) * (p.degree + 1);
    const float* sh = p.sh + 3 * p.bases * i;
    for (int c = 0; c < 3; ++c) {
        color[c] = 0.5f;
        for (int b = 0; b < used; ++b) color[c] += basis[b] * sh[3 * b + c];
        color[c] = std::max(color[c], 0.0f);
    }
}

}  // namespace splats
