// From a splat's sums over its pairs to its parameters and the pose, by the chain rule through projection.hpp.
// Sums run in a fixed order, so the result does not depend on the number of threads.
#include <omp.h>

#include <cmath>
#include <cstring>

#include "splats/shading.hpp"

namespace splats {
namespace {

constexpr float kLn2 = 0.6931471805599453f;
constexpr size_t kAhead = 4;      // splats whose slots are fetched early
constexpr size_t kChunk = 1024;  // splats whose share of the pose gradient is summed together

struct SplatGradient {
    float mean[3], log_scale[3], quaternion[4], opacity_logit, beta, screen[2];
    double rotation[3][3], center[3];
};

struct ImageGradient {
    float u, v;        // of the mean, px
    float xx, xy, yy;  // of the covariance as a full symmetric matrix
    float depth, log_opacity, beta, color[3];
};

ImageGradient on_image(const Frame& frame, const ScreenSplat& s) {
    Lanes total{};
    for (uint32_t i = 0; i < s.slot_count; ++i) total += frame.slots[s.slot + i];
    const float unit = frame.exact ? 1.0f : kSqrtHalfLog2e;
    const float first = -0.5f / unit, second = -0.5f / (unit * unit);
    const float u = first * total[kSumLane[kU]], v = first * total[kSumLane[kV]];
    const float uu = second * total[kSumLane[kUU]], uv = second * total[kSumLane[kUV]];
    const float vv = second * total[kSumLane[kVV]];
    const float a = s.pitch_u / unit, b = s.pitch_v / unit, k = s.shear;
    ImageGradient g;
    g.u = -2 * a * u;
    g.v = 2 * a * k * u - 2 * b * v;
    g.xx = -a * a * uu;
    g.xy = a * a * k * uu - a * b * uv;
    g.yy = -(a * a * k * k * uu - 2 * a * b * k * uv + b * b * vv);
    g.beta = frame.exact ? -0.25f * kLn2 * total[kSumLane[kBeta]] : 0.0f;
    g.depth = total[kSumLane[kDepth]];
    g.log_opacity = total[kSumLane[kAlpha]];
    g.color[0] = total[kSumLane[kRed]];
    g.color[1] = total[kSumLane[kGreen]];
    g.color[2] = total[kSumLane[kBlue]];
    return g;
}

void to_quaternion(const Projection& r, const float (&d)[3][3], float* out) {
    const float a = r.unit[0], b = r.unit[1], c = r.unit[2], e = r.unit[3];
    const float g[4] = {
        2 * (-e * d[0][1] + c * d[0][2] + e * d[1][0] - b * d[1][2] - c * d[2][0] + b * d[2][1]),
        2 * (c * (d[0][1] + d[1][0]) + e * (d[0][2] + d[2][0]) - 2 * b * (d[1][1] + d[2][2]) + a * (d[2][1] - d[1][2])),
        2 * (b * (d[0][1] + d[1][0]) + e * (d[1][2] + d[2][1]) - 2 * c * (d[0][0] + d[2][2]) + a * (d[0][2] - d[2][0])),
        2 * (b * (d[0][2] + d[2][0]) + c * (d[1][2] + d[2][1]) - 2 * e * (d[0][0] + d[1][1]) + a * (d[1][0] - d[0][1])),
    };
    const float along = g[0] * a + g[1] * b + g[2] * c + g[3] * e;
    for (int k = 0; k < 4; ++k) out[k] = (g[k] - r.unit[k] * along) * r.inverse_norm;
}

// Adds the gradient of sqrt(sharp / determinant), the antialiased opacity factor, to that of the axes.
void add_compensation(const Projection& r, float on_log, float (&axes)[2][3]) {
    if (!(r.compensation > kMinCompensation)) return;
    const float xx = r.xx - kBlur, yy = r.yy - kBlur;
    const float on_sharp = 0.5f * on_log * (1.0f / r.sharp - 1.0f / r.determinant);
    const float on_trace = -0.5f * on_log * kBlur / r.determinant;
    for (int k = 0; k < 3; ++k) {
        const float s = r.axes[0][k], t = r.axes[1][k];
        axes[0][k] += 2 * on_sharp * (s * yy - t * r.xy) + 2 * on_trace * s;
        axes[1][k] += 2 * on_sharp * (t * xx - s * r.xy) + 2 * on_trace * t;
    }
}

void splat_backward(const Frame& frame, const Parameters& p, int64_t i, const ImageGradient& g, SplatGradient& out,
                    float* sh_gradient) {
    const Camera& camera = frame.camera;
    Projection r;
    if (project(camera, p, i, r) != Fate::kSeen) return;
    out.opacity_logit = g.log_opacity * (1.0f - r.sigmoid);
    out.beta = r.beta_inside ? g.beta : 0.0f;
    out.screen[0] = g.u * 0.5f * camera.width;
    out.screen[1] = g.v * 0.5f * camera.height;

    float axes[2][3];
    for (int k = 0; k < 3; ++k) {
        axes[0][k] = 2 * (g.xx * r.axes[0][k] + g.xy * r.axes[1][k]);
        axes[1][k] = 2 * (g.xy * r.axes[0][k] + g.yy * r.axes[1][k]);
    }
    if (p.antialiased) add_compensation(r, g.log_opacity, axes);
    float rotation[3][3], to_image[2][3] = {};
    for (int k = 0; k < 3; ++k) {
        out.log_scale[k] = axes[0][k] * r.axes[0][k] + axes[1][k] * r.axes[1][k];
        for (int row = 0; row < 3; ++row) {
            rotation[row][k] = r.scale[k] * (r.to_image[0][row] * axes[0][k] + r.to_image[1][row] * axes[1][k]);
            to_image[0][row] += axes[0][k] * r.scale[k] * r.rotation[row][k];
            to_image[1][row] += axes[1][k] * r.scale[k] * r.rotation[row][k];
        }
    }
    to_quaternion(r, rotation, out.quaternion);

    const float inverse_z = 1.0f / r.z, jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
    float on_jx = 0, on_jy = 0, on_slope_x = 0, on_slope_y = 0;
    for (int k = 0; k < 3; ++k) {
        const float wz = float(camera.rotation[k][2]);
        on_jx += to_image[0][k] * r.to_image[0][k];
        on_jy += to_image[1][k] * r.to_image[1][k];
        on_slope_x -= jx * to_image[0][k] * wz;
        on_slope_y -= jy * to_image[1][k] * wz;
    }
    float point[3] = {g.u * jx, g.v * jy, g.depth - (on_jx + on_jy) * inverse_z};
    point[2] -= (g.u * jx * r.x + g.v * jy * r.y) * inverse_z;
    if (r.inside_x) {
        point[0] += on_slope_x * inverse_z;
        point[2] -= on_slope_x * r.slope_x * inverse_z;
    }
    if (r.inside_y) {
        point[1] += on_slope_y * inverse_z;
        point[2] -= on_slope_y * r.slope_y * inverse_z;
    }

    Shading shading;
    shade(p, i, r, shading);
    const int used = (p.degree + 1) * (p.degree + 1);
    const float* sh = p.sh + 3 * p.bases * i;
    float weight[16], on_direction[3], on_color[3];
    for (int c = 0; c < 3; ++c) on_color[c] = shading.raw[c] >= 0.0f ? g.color[c] : 0.0f;
    for (int b = 0; b < used; ++b) {
        weight[b] = 0;
        for (int c = 0; c < 3; ++c) {
            sh_gradient[3 * b + c] = shading.basis[b] * on_color[c];
            weight[b] += sh[3 * b + c] * on_color[c];
        }
    }
    harmonics_gradient(p.degree, shading.direction[0], shading.direction[1], shading.direction[2], weight,
                       on_direction);
    const float along = on_direction[0] * shading.direction[0] + on_direction[1] * shading.direction[1] +
                        on_direction[2] * shading.direction[2];
    for (int k = 0; k < 3; ++k) {
        const double turned = (on_direction[k] - shading.direction[k] * along) * shading.inverse_distance;
        const double offset = point[0] * camera.rotation[k][0] + point[1] * camera.rotation[k][1] +
                              point[2] * camera.rotation[k][2] + turned;
        out.mean[k] = float(offset);
        out.center[k] = -offset;
        out.rotation[k][0] = r.offset[k] * point[0] + jx * to_image[0][k];
        out.rotation[k][1] = r.offset[k] * point[1] + jy * to_image[1][k];
        out.rotation[k][2] = r.offset[k] * point[2] - jx * r.slope_x * to_image[0][k] - jy * r.slope_y * to_image[1][k];
    }
}

bool all_finite(const SplatGradient& g, const float* sh, int count) {
    return finite(g.mean, 3) && finite(g.log_scale, 3) && finite(g.quaternion, 4) && finite(&g.opacity_logit, 1) &&
           finite(&g.beta, 1) && finite(g.screen, 2) && finite(sh, count);
}

}  // namespace

void project_backward(Frame& frame, const Parameters& p, Gradients& out, int threads) {
    const size_t count = size_t(p.count), chunks = (count + kChunk - 1) / kChunk;
    const size_t width = 3 * size_t(p.bases), used = 3 * size_t((p.degree + 1) * (p.degree + 1));
    std::vector<double> pose(12 * chunks, 0.0);
    int64_t refused = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) reduction(+ : refused)
    for (size_t chunk = 0; chunk < chunks; ++chunk) {
        for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i) {
            const ScreenSplat &s = frame.splats[i], &soon = frame.splats[std::min(i + kAhead, count - 1)];
            for (uint32_t k = 0; k < std::min(soon.slot_count, 8u); ++k)
                __builtin_prefetch(&frame.slots[soon.slot + k]);
            SplatGradient g{};
            float* sh = out.sh + width * i;
            if (s.slot_count) {
                splat_backward(frame, p, int64_t(i), on_image(frame, s), g, sh);
                std::memset(sh + used, 0, (width - used) * sizeof(float));
                if (all_finite(g, sh, int(used))) {
                    for (int k = 0; k < 3; ++k) {
                        for (int j = 0; j < 3; ++j) pose[12 * chunk + 4 * k + j] += g.rotation[k][j];
                        pose[12 * chunk + 4 * k + 3] += g.center[k];
                    }
                } else {
                    ++refused;
                    g = SplatGradient{};
                    std::memset(sh, 0, width * sizeof(float));
                }
            } else {
                std::memset(sh, 0, width * sizeof(float));
            }
            std::memcpy(out.means + 3 * i, g.mean, sizeof(g.mean));
            std::memcpy(out.log_scales + 3 * i, g.log_scale, sizeof(g.log_scale));
            std::memcpy(out.quaternions + 4 * i, g.quaternion, sizeof(g.quaternion));
            std::memcpy(out.screen + 2 * i, g.screen, sizeof(g.screen));
            out.opacity_logits[i] = g.opacity_logit;
            out.betas[i] = g.beta;
        }
    }
    std::fill(out.pose, out.pose + 12, 0.0);
    for (size_t chunk = 0; chunk < chunks; ++chunk)
        for (int k = 0; k < 12; ++k) out.pose[k] += pose[12 * chunk + k];
    out.refused = refused;
}

}  // namespace splats
