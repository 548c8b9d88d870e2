// Sixteen splats, one in each lane, from the map to the image: positions in float64 relative to the camera, the rest in
// float32.
#pragma once

#include <bit>
#include <limits>

#include "rasterizer/frame.hpp"

namespace splats {

// How a rolling shutter moves a splat on the image.
struct Motion {
    Lanes u, v;              // px while the image is read
    Mask inside_u, inside_v;  // where that is not limited
    Lanes stretch, shear;    // the axes on the image: (x, y) -> (x + shear y, stretch y)
    Lanes late;              // readouts from the image's middle to when the mean is read
};

struct Projection {
    Lanes offset[3];            // mean - camera center, world
    Lanes x, y, z;              // in the camera's frame
    Lanes whole_u, part_u, whole_v, part_v;  // mean on the image = whole + part, px
    Lanes slope_x, slope_y;     // x/z, y/z as the Jacobian takes them
    Mask inside_x, inside_y;    // where that is x/z, y/z itself
    Lanes rotation[3][3];       // of the splat
    Lanes unit[4], inverse_norm;  // quaternion
    Lanes scale[3];
    Lanes to_image[2][3];       // Jacobian times cam_from_world, with a rolling shutter as that sees it
    Motion motion;              // where the camera has one
    Lanes axes[2][3];           // the splat's axes on the image, px
    Lanes xx, xy, yy;           // covariance with blur, px^2
    Lanes sharp, determinant;
    Lanes sigmoid, compensation;
    Lanes beta;
    Mask beta_inside;
    Mask seen;
    int refused;                // how many
};

// By the bits of the exponent: comparisons with NaN are nothing that optimized arithmetic can be trusted with. The sign
// bit of what is returned is set unless the number is finite.
template <class Bits>
SPLATS_INLINE Bits not_finite(const Bits& bits) {
    return 0x7f7fffff - (bits & 0x7f800000);
}
SPLATS_INLINE bool finite(const float* values, int64_t count) {
    uint32_t bad = 0;
    for (int64_t i = 0; i < count; ++i) bad |= not_finite(std::bit_cast<uint32_t>(values[i]));
    return !(bad >> 31);
}
SPLATS_INLINE Mask without_sign(const Ints& bits) { return at_least(to_floats(bits >> 31), -0.5f); }
SPLATS_INLINE Mask first_lanes(int count) {
    constexpr Lanes kNumbers = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return at_most(kNumbers, float(count) - 0.5f);
}

// Those of the `count` splats from `first` of which every parameter is finite.
SPLATS_INLINE Mask finite_splats(const Parameters& p, int64_t first, int count) {
    const int width = 3 * p.bases;
    if (finite(p.means + 3 * first, 3 * count) && finite(p.log_scales + 3 * first, 3 * count) &&
        finite(p.quaternions + 4 * first, 4 * count) && finite(p.opacity_logits + first, count) &&
        finite(p.betas + first, count) && finite(p.sh + width * first, width * count))
        return first_lanes(count);
    float good[kLanes] = {};
    for (int k = 0; k < count; ++k) {
        const int64_t i = first + k;
        good[k] = finite(p.means + 3 * i, 3) && finite(p.log_scales + 3 * i, 3) && finite(p.quaternions + 4 * i, 4) &&
                  finite(p.opacity_logits + i, 1) && finite(p.betas + i, 1) && finite(p.sh + width * i, width);
    }
    return at_least(lanes(good), 0.5f);
}

// Offset, place in the camera's frame and on the image; returns which lie beyond the near plane.
SPLATS_INLINE Mask locate(const Camera& camera, const Lanes (&mean)[3], Projection& r, Lanes& ratio_x, Lanes& ratio_y) {
    alignas(64) float means[3][kLanes], offsets[3][kLanes], points[3][kLanes], ratios[2][kLanes], ahead[kLanes];
    alignas(64) float wholes[2][kLanes], parts[2][kLanes];
    for (int k = 0; k < 3; ++k) store(mean[k], means[k]);
    const double(&turn)[3][3] = camera.rotation;
    constexpr double kMost = 1e9;  // an integer beside it still
#pragma omp simd
    for (int i = 0; i < kLanes; ++i) {
        const double a = means[0][i] - camera.center[0], b = means[1][i] - camera.center[1];
        const double c = means[2][i] - camera.center[2];
        const double x = a * turn[0][0] + b * turn[1][0] + c * turn[2][0];
        const double y = a * turn[0][1] + b * turn[1][1] + c * turn[2][1];
        const double z = a * turn[0][2] + b * turn[1][2] + c * turn[2][2];
        const double inverse = 1.0 / z, along_x = x * inverse, along_y = y * inverse;
        const double u = camera.fx * along_x + camera.cx, v = camera.fy * along_y + camera.cy;
        const double limited_u = u < kMost ? (u > -kMost ? u : -kMost) : kMost;
        const double limited_v = v < kMost ? (v > -kMost ? v : -kMost) : kMost;
        const float whole_u = float(int32_t(limited_u)), whole_v = float(int32_t(limited_v));
        offsets[0][i] = float(a);
        offsets[1][i] = float(b);
        offsets[2][i] = float(c);
        points[0][i] = float(x);
        points[1][i] = float(y);
        points[2][i] = float(z);
        ratios[0][i] = float(along_x);
        ratios[1][i] = float(along_y);
        wholes[0][i] = whole_u;
        wholes[1][i] = whole_v;
        parts[0][i] = float(u - whole_u);
        parts[1][i] = float(v - whole_v);
        ahead[i] = z > double(camera.near) ? 1.0f : 0.0f;
    }
    for (int k = 0; k < 3; ++k) r.offset[k] = lanes(offsets[k]);
    r.x = lanes(points[0]);
    r.y = lanes(points[1]);
    r.z = lanes(points[2]);
    ratio_x = lanes(ratios[0]);
    ratio_y = lanes(ratios[1]);
    r.whole_u = lanes(wholes[0]);
    r.whole_v = lanes(wholes[1]);
    r.part_u = lanes(parts[0]);
    r.part_v = lanes(parts[1]);
    return at_least(lanes(ahead), 0.5f);
}

SPLATS_INLINE Lanes limited(const Lanes& value, float low, float high) {
    return minimum(maximum(value, all(low)), all(high));
}

SPLATS_INLINE void rotation_of(const Lanes (&unit)[4], Lanes (&out)[3][3]) {
    const Lanes a = unit[0], b = unit[1], c = unit[2], d = unit[3];
    out[0][0] = 1.0f - 2.0f * (c * c + d * d);
    out[0][1] = 2.0f * (b * c - a * d);
    out[0][2] = 2.0f * (b * d + a * c);
    out[1][0] = 2.0f * (b * c + a * d);
    out[1][1] = 1.0f - 2.0f * (b * b + d * d);
    out[1][2] = 2.0f * (c * d - a * b);
    out[2][0] = 2.0f * (b * d - a * c);
    out[2][1] = 2.0f * (c * d + a * b);
    out[2][2] = 1.0f - 2.0f * (b * b + c * c);
}

// Moves what was found of the splats to where a rolling shutter sees them.
SPLATS_INLINE void roll(const Camera& camera, const Lanes& inverse_z, Projection& r) {
    const std::array<float, 6>& t = camera.readout;
    const float height = float(camera.height), most_u = kMaxMotion * camera.width, most_v = kMaxMotion * height;
    const Lanes a = r.slope_x, b = r.slope_y, nearer = t[2] * inverse_z + t[3] * b - t[4] * a;
    const Lanes u = camera.fx * (t[5] * b - t[4] - t[0] * inverse_z + a * nearer);
    const Lanes v = camera.fy * (t[3] - t[5] * a - t[1] * inverse_z + b * nearer);
    Motion& m = r.motion;
    m.u = limited(u, -most_u, most_u);
    m.v = limited(v, -most_v, most_v);
    m.inside_u = at_least(u, -most_u) & at_most(u, most_u);
    m.inside_v = at_least(v, -most_v) & at_most(v, most_v);
    m.stretch = height / (height - m.v);
    m.shear = m.u * m.stretch * (1.0f / height);
    m.late = ((r.whole_v + r.part_v) * (1.0f / height) - 0.5f) * m.stretch;
    r.part_u += m.late * m.u;
    r.part_v += m.late * m.v;
    for (int k = 0; k < 3; ++k) {
        r.to_image[0][k] += m.shear * r.to_image[1][k];
        r.to_image[1][k] = m.stretch * r.to_image[1][k];
    }
}

// The splats from `first`, `count` of them, at most sixteen; lanes that are not `seen` hold anything.
SPLATS_INLINE void project(const Camera& camera, const Parameters& p, int64_t first, int count, Projection& r) {
    Lanes mean[3], q[4], log_scale[3], raw_x, raw_y;
    load_rows(p.means + 3 * first, count, mean);
    load_rows(p.quaternions + 4 * first, count, q);
    load_rows(p.log_scales + 3 * first, count, log_scale);
    const Lanes squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const Mask usable = finite_splats(p, first, count) & at_least(squared, kMinQuaternion * kMinQuaternion);
    const Mask ahead = usable & locate(camera, mean, r, raw_x, raw_y);
    r.slope_x = limited(raw_x, camera.slope_min[0], camera.slope_max[0]);
    r.slope_y = limited(raw_y, camera.slope_min[1], camera.slope_max[1]);
    r.inside_x = at_least(raw_x, camera.slope_min[0]) & at_most(raw_x, camera.slope_max[0]);
    r.inside_y = at_least(raw_y, camera.slope_min[1]) & at_most(raw_y, camera.slope_max[1]);

    r.inverse_norm = 1.0f / root(squared);
    for (int k = 0; k < 4; ++k) r.unit[k] = q[k] * r.inverse_norm;
    rotation_of(r.unit, r.rotation);
    const Lanes inverse_z = 1.0f / r.z, jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
    for (int k = 0; k < 3; ++k) {
        const float wx = float(camera.rotation[k][0]), wy = float(camera.rotation[k][1]);
        const float wz = float(camera.rotation[k][2]);
        r.to_image[0][k] = jx * (wx - r.slope_x * wz);
        r.to_image[1][k] = jy * (wy - r.slope_y * wz);
    }
    if (camera.rolling) roll(camera, inverse_z, r);
    for (int k = 0; k < 3; ++k) {
        r.scale[k] = exponential(log_scale[k]);
        for (int row = 0; row < 2; ++row)
            r.axes[row][k] =
                r.scale[k] * (r.to_image[row][0] * r.rotation[0][k] + r.to_image[row][1] * r.rotation[1][k] +
                              r.to_image[row][2] * r.rotation[2][k]);
    }
    const Lanes(&s)[3] = r.axes[0], (&t)[3] = r.axes[1];
    const Lanes xx = s[0] * s[0] + s[1] * s[1] + s[2] * s[2], yy = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
    r.xy = s[0] * t[0] + s[1] * t[1] + s[2] * t[2];
    const Lanes n0 = s[1] * t[2] - s[2] * t[1], n1 = s[2] * t[0] - s[0] * t[2], n2 = s[0] * t[1] - s[1] * t[0];
    r.sharp = n0 * n0 + n1 * n1 + n2 * n2;  // Lagrange's identity: no cancellation for needles
    r.determinant = r.sharp + kBlur * (xx + yy) + kBlur * kBlur;
    r.xx = xx + kBlur;
    r.yy = yy + kBlur;
    const Mask bounded = ahead & at_most(r.xx, kMaxVariance) & at_most(r.yy, kMaxVariance) &
                         at_most(r.determinant, std::numeric_limits<float>::max());
    r.refused = count - splats::count(usable) + splats::count(ahead) - splats::count(bounded);

    r.sigmoid = 1.0f / (1.0f + exponential(-strided(p.opacity_logits + first, 1, count)));
    r.compensation = all(1.0f);
    if (p.antialiased)
        r.compensation = root(maximum(r.sharp / r.determinant, all(kMinCompensation * kMinCompensation)));
    const Lanes beta = strided(p.betas + first, 1, count);
    r.beta = limited(beta, kMinBeta, kMaxBeta);
    r.beta_inside = at_least(beta, kMinBeta) & at_most(beta, kMaxBeta);
    r.seen = bounded & at_least(r.sigmoid * r.compensation, 1.0f / 255.0f);
}

}  // namespace splats
