// From the sums of splats over their pairs to their parameters and the pose, by the chain rule through projection.hpp:
// sixteen splats at a time. Sums run in a fixed order, so the result does not depend on the number of threads.
#include <omp.h>

#include <cstring>
#include <optional>

#include "caught.hpp"
#include "rasterizer/pose_sum.hpp"
#include "rasterizer/shading.hpp"

namespace splats {
namespace {

constexpr float kLn2 = 0.6931471805599453f;
constexpr size_t kAhead = 96;  // slots fetched early

struct SplatGradient {
    Lanes mean[3], log_scale[3], quaternion[4], opacity_logit, beta, mean2d[2];
    Lanes sh[48];                   // by base and color
    Lanes rotation[3][3], offset[3];  // parts of the pose's gradient
};

struct ImageGradient {
    Lanes u, v;        // of the mean, px
    Lanes xx, xy, yy;  // of the covariance as a full symmetric matrix
    Lanes depth, log_opacity, beta, color[3];
};

ImageGradient on_image(const Frame& frame, size_t first, int count) {
    Lanes total[16] = {}, projected[16] = {};
    for (int i = 0; i < count; ++i) {
        const SlotSpan span = frame.spans[first + i];
        for (uint32_t k = 0; k < span.count; ++k) {
            __builtin_prefetch(frame.slots.data() + span.first + k + kAhead);
            total[i] += frame.slots[span.first + k];
        }
    }
    if (count == kLanes)
        std::memcpy(projected, frame.splats.data() + first, sizeof(projected));  // of a size known: no call
    else
        std::memcpy(projected, frame.splats.data() + first, size_t(count) * sizeof(ProjectedSplat));
    transpose(total);
    transpose(projected);
    const Lanes a = projected[4], k = projected[5], b = projected[6];  // pitch_u, shear, pitch_v
    const float unit = frame.exact ? 1.0f : kSqrtHalfLog2e, second = -0.5f / (unit * unit);
    const Lanes u = -0.5f / unit * total[kSumLane[kU]], v = -0.5f / unit * total[kSumLane[kV]];
    const Lanes uu = second * total[kSumLane[kUU]], uv = second * total[kSumLane[kUV]];
    const Lanes vv = second * total[kSumLane[kVV]];
    const Lanes pitch_u = a * (1.0f / unit), pitch_v = b * (1.0f / unit);
    ImageGradient g;
    g.u = -2.0f * pitch_u * u;
    g.v = 2.0f * pitch_u * k * u - 2.0f * pitch_v * v;
    g.xx = -pitch_u * pitch_u * uu;
    g.xy = pitch_u * pitch_u * k * uu - pitch_u * pitch_v * uv;
    g.yy = -(pitch_u * pitch_u * k * k * uu - 2.0f * pitch_u * pitch_v * k * uv + pitch_v * pitch_v * vv);
    g.beta = (frame.exact ? -0.25f * kLn2 : 0.0f) * total[kSumLane[kBeta]];
    g.depth = total[kSumLane[kDepth]];
    g.log_opacity = total[kSumLane[kAlpha]];
    g.color[0] = total[kSumLane[kRed]];
    g.color[1] = total[kSumLane[kGreen]];
    g.color[2] = total[kSumLane[kBlue]];
    return g;
}

SPLATS_INLINE void to_quaternion(const Projection& r, const Lanes (&d)[3][3], Lanes (&out)[4]) {
    const Lanes a = r.unit[0], b = r.unit[1], c = r.unit[2], e = r.unit[3];
    const Lanes g[4] = {
        2.0f * (c * d[0][2] - e * d[0][1] + e * d[1][0] - b * d[1][2] - c * d[2][0] + b * d[2][1]),
        2.0f * (c * (d[0][1] + d[1][0]) + e * (d[0][2] + d[2][0]) - 2.0f * b * (d[1][1] + d[2][2]) +
                a * (d[2][1] - d[1][2])),
        2.0f * (b * (d[0][1] + d[1][0]) + e * (d[1][2] + d[2][1]) - 2.0f * c * (d[0][0] + d[2][2]) +
                a * (d[0][2] - d[2][0])),
        2.0f * (b * (d[0][2] + d[2][0]) + c * (d[1][2] + d[2][1]) - 2.0f * e * (d[0][0] + d[1][1]) +
                a * (d[1][0] - d[0][1])),
    };
    const Lanes along = g[0] * a + g[1] * b + g[2] * c + g[3] * e;
    for (int k = 0; k < 4; ++k) out[k] = (g[k] - r.unit[k] * along) * r.inverse_norm;
}

// Adds the gradient of sqrt(sharp / determinant), the antialiased opacity factor, to that of the axes.
SPLATS_INLINE void add_compensation(const Projection& r, const Lanes& on_log, Lanes (&axes)[2][3]) {
    const Mask moves = at_least(r.compensation - kMinCompensation, 1e-9f);
    const Lanes xx = r.xx - kBlur, yy = r.yy - kBlur;
    const Lanes on_sharp = where(moves, 0.5f * on_log * (1.0f / r.sharp - 1.0f / r.determinant));
    const Lanes on_trace = where(moves, -0.5f * kBlur * on_log / r.determinant);
    for (int k = 0; k < 3; ++k) {
        const Lanes s = r.axes[0][k], t = r.axes[1][k];
        axes[0][k] += 2.0f * on_sharp * (s * yy - t * r.xy) + 2.0f * on_trace * s;
        axes[1][k] += 2.0f * on_sharp * (t * xx - s * r.xy) + 2.0f * on_trace * t;
    }
}

// Color to the coefficients and to the place; returns the gradient of the offset in world coordinates.
SPLATS_INLINE void shade_backward(const Parameters& p, int64_t first, int count, const Projection& r,
                                  const ImageGradient& g, SplatGradient& out, Lanes (&on_offset)[3]) {
    Shading shading;
    shade(p, first, count, r, shading);
    const int used = (p.degree + 1) * (p.degree + 1), width = 3 * p.bases;
    Lanes weight[16], on_color[3];
    for (int c = 0; c < 3; ++c) on_color[c] = where(at_least(shading.raw[c], 0.0f), g.color[c]);
    for (int b = 0; b < used; ++b)
        for (int c = 0; c < 3; ++c) out.sh[3 * b + c] = shading.basis[b] * on_color[c];
    for (int k = 0; k < 3; ++k) on_offset[k] = Lanes{};
    if (p.degree == 0) return;
    const float* sh = p.sh + width * first;
    for (int b = 0; b < used; ++b) {
        weight[b] = strided(sh + 3 * b, width, count) * on_color[0];
        weight[b] += strided(sh + 3 * b + 1, width, count) * on_color[1];
        weight[b] += strided(sh + 3 * b + 2, width, count) * on_color[2];
    }
    const Lanes(&d)[3] = shading.direction;
    Lanes on_direction[3];
    harmonics_gradient(p.degree, d[0], d[1], d[2], weight, on_direction);
    const Lanes along = on_direction[0] * d[0] + on_direction[1] * d[1] + on_direction[2] * d[2];
    for (int k = 0; k < 3; ++k) on_offset[k] = (on_direction[k] - d[k] * along) * shading.inverse_distance;
}

// The chain through `roll`: from the gradients of the mean on the image (u, v) and of `to_image` as the shutter sees them
// to those without it; `still` becomes what `to_image` was before. Returns the gradients of x/z, y/z and 1/z.
struct OnMotion {
    Lanes slope_x, slope_y, inverse_z;
};
SPLATS_INLINE OnMotion roll_backward(const Camera& camera, const Projection& r, Lanes& on_u, Lanes& on_v,
                                     Lanes (&on_to_image)[2][3], Lanes (&still)[2][3]) {
    const Motion& m = r.motion;
    const std::array<float, 6>& t = camera.readout;
    const float row = 1.0f / float(camera.height);
    const Lanes unstretch = 1.0f / m.stretch;
    Lanes on_shear{}, on_stretch{};
    for (int k = 0; k < 3; ++k) {
        still[1][k] = r.to_image[1][k] * unstretch;
        still[0][k] = r.to_image[0][k] - m.shear * still[1][k];
        on_shear += on_to_image[0][k] * still[1][k];
        on_stretch += on_to_image[1][k] * still[1][k];
        on_to_image[1][k] = m.shear * on_to_image[0][k] + m.stretch * on_to_image[1][k];
    }
    const Lanes on_late = on_u * m.u + on_v * m.v;
    on_stretch += (on_shear * m.u) * row + on_late * m.late * unstretch;
    const Lanes p = camera.fx * where(m.inside_u, on_u * m.late + on_shear * m.stretch * row);
    const Lanes q = camera.fy * where(m.inside_v, on_v * m.late + on_stretch * m.stretch * m.stretch * row);
    on_v += on_late * m.stretch * row;
    const Lanes a = r.slope_x, b = r.slope_y, inverse_z = 1.0f / r.z, nearer = t[2] * inverse_z + t[3] * b - t[4] * a;
    return {p * (nearer - t[4] * a) - q * (t[5] + t[4] * b), p * (t[5] + t[3] * a) + q * (nearer + t[3] * b),
            p * (t[2] * a - t[0]) + q * (t[2] * b - t[1])};
}

// All that `out` has, garbage in the lanes that are not seen.
SPLATS_INLINE void splats_backward(const Camera& camera, const Parameters& p, int64_t first, int count,
                                   const Projection& r, const ImageGradient& g, SplatGradient& out) {
    out.opacity_logit = g.log_opacity * (1.0f - r.sigmoid);
    out.beta = where(r.beta_inside, g.beta);
    out.mean2d[0] = g.u * (0.5f * camera.width);
    out.mean2d[1] = g.v * (0.5f * camera.height);

    Lanes axes[2][3];
    for (int k = 0; k < 3; ++k) {
        axes[0][k] = 2.0f * (g.xx * r.axes[0][k] + g.xy * r.axes[1][k]);
        axes[1][k] = 2.0f * (g.xy * r.axes[0][k] + g.yy * r.axes[1][k]);
    }
    if (p.antialiased) add_compensation(r, g.log_opacity, axes);
    Lanes rotation[3][3], to_image[2][3] = {};
    for (int k = 0; k < 3; ++k) {
        out.log_scale[k] = axes[0][k] * r.axes[0][k] + axes[1][k] * r.axes[1][k];
        for (int row = 0; row < 3; ++row) {
            rotation[row][k] = r.scale[k] * (r.to_image[0][row] * axes[0][k] + r.to_image[1][row] * axes[1][k]);
            to_image[0][row] += axes[0][k] * r.scale[k] * r.rotation[row][k];
            to_image[1][row] += axes[1][k] * r.scale[k] * r.rotation[row][k];
        }
    }
    to_quaternion(r, rotation, out.quaternion);

    const Lanes inverse_z = 1.0f / r.z, jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
    Lanes image_u = g.u, image_v = g.v, still[2][3];
    OnMotion on_motion{};
    if (camera.rolling)
        on_motion = roll_backward(camera, r, image_u, image_v, to_image, still);
    else
        std::memcpy(still, r.to_image, sizeof(still));
    Lanes on_jx{}, on_jy{}, toward_x{}, toward_y{};
    for (int k = 0; k < 3; ++k) {
        const float wz = float(camera.rotation[k][2]);
        on_jx += to_image[0][k] * still[0][k];
        on_jy += to_image[1][k] * still[1][k];
        toward_x += to_image[0][k] * wz;
        toward_y += to_image[1][k] * wz;
    }
    const Lanes on_slope_x = where(r.inside_x, on_motion.slope_x - jx * toward_x);
    const Lanes on_slope_y = where(r.inside_y, on_motion.slope_y - jy * toward_y);
    const Lanes on_u = image_u * jx, on_v = image_v * jy;
    const Lanes point[3] = {on_u + on_slope_x * inverse_z, on_v + on_slope_y * inverse_z,
                            g.depth - (on_jx + on_jy + on_u * r.x + on_v * r.y + on_slope_x * r.slope_x +
                                       on_slope_y * r.slope_y + on_motion.inverse_z * inverse_z) * inverse_z};
    Lanes on_offset[3];
    shade_backward(p, first, count, r, g, out, on_offset);
    for (int k = 0; k < 3; ++k) {
        const double(&turn)[3] = camera.rotation[k];
        out.mean[k] = point[0] * float(turn[0]) + point[1] * float(turn[1]) + point[2] * float(turn[2]) + on_offset[k];
        out.offset[k] = out.mean[k];
        const Lanes on_x = jx * to_image[0][k], on_y = jy * to_image[1][k];
        out.rotation[k][0] = r.offset[k] * point[0] + on_x;
        out.rotation[k][1] = r.offset[k] * point[1] + on_y;
        out.rotation[k][2] = r.offset[k] * point[2] - r.slope_x * on_x - r.slope_y * on_y;
    }
}

// Lane i to values[i * stride].
SPLATS_INLINE void scatter(const Lanes& lanes, float* values, size_t stride, int count) {
    alignas(64) float lane[kLanes];
    store(lanes, lane);
    if (count == kLanes)
        for (int i = 0; i < kLanes; ++i) values[i * stride] = lane[i];
    else
        for (int i = 0; i < count; ++i) values[i * stride] = lane[i];
}

// Clears every lane but those of `good`; for all that is finite or not seen, for what is not finite spreads otherwise.
template <int Count>
SPLATS_INLINE void keep(const Mask& good, Lanes (&values)[Count], int count = Count) {
    for (int k = 0; k < count; ++k) values[k] = where(good, values[k]);
}
template <int Count>
SPLATS_INLINE void find_bad(const Lanes (&values)[Count], Ints& bad, int count = Count) {
    for (int k = 0; k < count; ++k) bad = bad | not_finite(as_bits(values[k]));
}

// The gradients of up to sixteen splats to `out`, from its row `at` on; returns how many are refused, as they are not
// finite: these are 0, and `taken`, where it is not null, becomes false. Never inlined: what it rounds is then the same
// wherever it is called.
[[gnu::noinline]] int64_t backward_of(const Frame& frame, const Parameters& p, size_t first, int count, size_t at,
                                      Gradients& out, PoseSum& pose, bool* taken = nullptr) {
    const int used = 3 * (p.degree + 1) * (p.degree + 1);
    const size_t width = 3 * size_t(p.bases);
    float has_pairs[kLanes] = {};
    for (int i = 0; i < count; ++i) has_pairs[i] = float(frame.spans[first + i].count != 0);
    const Mask in_tiles = at_least(lanes(has_pairs), 0.5f);
    float* on_sh = out.sh + width * at;
    if (p.bases > 1) std::memset(on_sh, 0, width * size_t(count) * sizeof(float));
    SplatGradient g;
    int64_t refused = 0;
    if (any(in_tiles)) {
        Projection r;
        project(frame.camera, p, int64_t(first), count, r);
        splats_backward(frame.camera, p, int64_t(first), count, r, on_image(frame, first, count), g);
        const Mask seen = in_tiles & r.seen;
        Ints bad{};
        const Lanes others[2] = {g.opacity_logit, g.beta};
        find_bad(g.mean, bad);
        find_bad(g.log_scale, bad);
        find_bad(g.quaternion, bad);
        find_bad(others, bad);
        find_bad(g.mean2d, bad);
        find_bad(g.sh, bad, used);
        const Mask good = seen & without_sign(bad);
        refused = splats::count(seen) - splats::count(good);
        if (refused && taken) {
            alignas(64) float refuses[kLanes];
            store(where(seen, all(1.0f)) - where(good, all(1.0f)), refuses);
            for (int i = 0; i < count; ++i) taken[i] &= refuses[i] < 0.5f;
        }
        keep(good, g.mean);
        keep(good, g.log_scale);
        keep(good, g.quaternion);
        keep(good, g.mean2d);
        keep(good, g.sh, used);
        g.opacity_logit = where(good, g.opacity_logit);
        g.beta = where(good, g.beta);
        for (int k = 0; k < 3; ++k) {
            for (int j = 0; j < 3; ++j) pose.add(4 * k + j, where(good, g.rotation[k][j]));
            pose.add(4 * k + 3, -where(good, g.offset[k]));
        }
        if (p.bases > 1)
            for (int k = 0; k < used; ++k) scatter(g.sh[k], on_sh + k, width, count);
    } else {
        g = SplatGradient{};
    }
    if (p.bases == 1) store_rows(reinterpret_cast<const Lanes(&)[3]>(g.sh), on_sh, count);
    store_rows(g.mean, out.means + 3 * at, count);
    store_rows(g.log_scale, out.log_scales + 3 * at, count);
    store_rows(g.quaternion, out.quaternions + 4 * at, count);
    store_rows(g.mean2d, out.means2d + 2 * at, count);
    scatter(g.opacity_logit, out.opacity_logits + at, 1, count);
    scatter(g.beta, out.betas + at, 1, count);
    return refused;
}

// Gradients of a block of splats, where they stay in the cache until they are stepped.
struct BlockGradients {
    std::array<std::vector<float>, 7> rows;  // by field of Splats, and of the means on the image
    Gradients out;
    std::vector<adam::Group> groups;  // of the step, with these gradients

    BlockGradients(int bases, const std::vector<adam::Group>& stepped, const std::vector<int>& fields) : groups(stepped) {
        const size_t widths[7] = {3, 3, 4, 1, 3 * size_t(bases), 1, 2};
        for (int k = 0; k < 7; ++k) rows[k].resize(widths[k] * adam::kBlock);
        out = {rows[0].data(), rows[1].data(), rows[2].data(), rows[3].data(),
               rows[4].data(), rows[5].data(), rows[6].data(), nullptr};
        for (size_t k = 0; k < groups.size(); ++k) groups[k].gradient = rows[fields[k]].data();
    }
};

}  // namespace

void project_backward(Frame& frame, const Parameters& p, Gradients& out, int threads) {
    const size_t count = size_t(p.count), chunks = (count + kChunk - 1) / kChunk;
    std::vector<double> pose(12 * chunks);
    int64_t refused = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) reduction(+ : refused)
    for (size_t chunk = 0; chunk < chunks; ++chunk) {
        PoseSum sums;
        const size_t end = std::min(count, (chunk + 1) * kChunk);
        for (size_t first = chunk * kChunk; first < end; first += kLanes)
            refused += backward_of(frame, p, first, int(std::min(size_t(kLanes), end - first)), first, out, sums);
        sums.total(pose.data() + 12 * chunk);
    }
    sum_pose(pose, out.pose);
    out.refused = refused;
}

int64_t opacity_backward(const Frame& frame, const float* opacity_logits, int64_t count, float* on_logits, int threads) {
    int64_t refused = 0;
#pragma omp parallel for num_threads(threads) schedule(static) reduction(+ : refused)
    for (int64_t i = 0; i < count; ++i) {
        const SlotSpan span = frame.spans[i];
        float on_log_alpha = 0.0f;  // alpha is the opacity, sigmoid(logit), times what does not depend on it
        for (uint32_t slot = span.first; slot < span.first + span.count; ++slot)
            on_log_alpha += frame.slots[slot][kSumLane[kAlpha]];
        const float gradient = on_log_alpha / (1.0f + std::exp(opacity_logits[i]));
        const bool usable = finite(&gradient, 1);
        refused += !usable;
        on_logits[i] = usable ? gradient : 0.0f;
    }
    return refused;
}

void project_and_step(Frame& frame, const Parameters& p, const adam::Step& step, const std::vector<int>& fields,
                      Stepped& out, int threads) {
    static_assert(kChunk % adam::kBlock == 0 && adam::kBlock % kLanes == 0);
    const size_t count = size_t(p.count), chunks = (count + kChunk - 1) / kChunk;
    std::vector<double> pose(12 * chunks);
    int64_t refused = 0, refused_steps = 0;
    Caught caught;
#pragma omp parallel num_threads(threads) reduction(+ : refused, refused_steps)
    {
        std::optional<BlockGradients> gradients;
        caught([&] { gradients.emplace(p.bases, step.groups, fields); });
        adam::Block block;
        bool seen[adam::kBlock], taken[adam::kBlock];
#pragma omp barrier
        const size_t stepped = caught.any() ? 0 : chunks;  // all splats or none
#pragma omp for schedule(dynamic, 1)
        for (size_t chunk = 0; chunk < stepped; ++chunk) {
            PoseSum sums;
            const size_t last = std::min(count, (chunk + 1) * kChunk);
            for (size_t begin = chunk * kChunk; begin < last; begin += adam::kBlock) {
                const size_t end = std::min(last, begin + adam::kBlock);
                bool any_seen = false;
                for (size_t i = begin; i < end; ++i)
                    any_seen |= taken[i - begin] = seen[i - begin] = frame.splats[i].radius > 0.0f;
                if (!any_seen) continue;
                for (size_t first = begin; first < end; first += kLanes)
                    refused += backward_of(frame, p, first, int(std::min(size_t(kLanes), end - first)), first - begin,
                                           gradients->out, sums, taken + (first - begin));
                for (size_t i = begin; i < end; ++i) {
                    if (!seen[i - begin]) continue;
                    const float* mean2d = gradients->out.means2d + 2 * (i - begin);
                    const double x = mean2d[0], y = mean2d[1];
                    const float length = std::sqrt(float(double(float(x * x)) + y * y));  // rounded as PyTorch's norm
                    out.means2d_gradient[i] += finite(&length, 1) ? length : 0.0f;
                    out.means2d_views[i] += 1.0f;
                }
                block.origin = int64_t(begin);
                refused_steps += step.of_block(block, gradients->groups, taken, int64_t(begin), int64_t(end));
            }
            sums.total(pose.data() + 12 * chunk);
        }
    }
    caught.rethrow();
    sum_pose(pose, out.pose);
    out.refused = refused;
    out.refused_steps = refused_steps;
}

}  // namespace splats
