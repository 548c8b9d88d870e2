#include "lucas_kanade.hpp"

#include <algorithm>
#include <cmath>

#include "lanes.hpp"

namespace mvsgs {
namespace {

constexpr int kWindow = 16;  // pixels; a row is one vector
constexpr float kCenter = 7.5f;
constexpr float kMostGain = 8.0f;  // of one image over the other

inline vf splat_f(float x) { return vf{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }

struct Window {
    vf rows[kWindow];
};

// Corner of a window around (u, v), or null where it leaves the padded image.
const float* corner(const Level& level, int border, float u, float v, int margin, float& fu, float& fv) {
    const float x = u - kCenter + border, y = v - kCenter + border;
    const int taken = kWindow + margin + 1 - 2 * border;
    // A guess may be any number: none is cast before it is seen to lie inside.
    if (!(x >= margin && y >= margin && x < level.width - taken && y < level.height - taken)) return nullptr;
    const int ix = static_cast<int>(x), iy = static_cast<int>(y);
    fu = x - ix;
    fv = y - iy;
    return level.data + static_cast<size_t>(iy) * level.stride + ix;
}

bool sample(const Level& level, int border, float u, float v, Window& out) {
    float fu, fv;
    const float* p = corner(level, border, u, v, 0, fu, fv);
    if (!p) return false;
    vf above = load_f(p) + fu * (load_f(p + 1) - load_f(p));
    for (int r = 0; r < kWindow; ++r) {
        p += level.stride;
        const vf below = load_f(p) + fu * (load_f(p + 1) - load_f(p));
        out.rows[r] = above + fv * (below - above);
        above = below;
    }
    return true;
}

// The window of `a` with its gradients, weighted and freed of their means and of what is proportional to the image:
// what neither an offset nor a gain of the brightness can move.
struct Template {
    Window image, gx, gy;
    float hxx, hxy, hyy;
    float contrast;  // gray levels, weighted standard deviation
};

bool make_template(const Level& level, int border, float u, float v, const Window& weight, Template& t) {
    float fu, fv;
    const float* p = corner(level, border, u, v, 1, fu, fv);
    if (!p) return false;
    vf rows[kWindow + 2], across[kWindow + 2];  // at (u, v), and the difference of the pixels beside it
    p -= level.stride;
    vf middle{}, beside{};
    for (int r = 0; r < kWindow + 3; ++r, p += level.stride) {
        const vf a = load_f(p - 1), b = load_f(p), c = load_f(p + 1), d = load_f(p + 2);
        const vf next_middle = b + fu * (c - b), next_beside = c - a + fu * ((d - c) - (b - a));
        if (r > 0) {
            rows[r - 1] = middle + fv * (next_middle - middle);
            across[r - 1] = beside + fv * (next_beside - beside);
        }
        middle = next_middle;
        beside = next_beside;
    }
    vf sum_x{}, sum_y{}, sum_1{}, sum_2{}, image_x{}, image_y{};
    for (int r = 0; r < kWindow; ++r) {
        t.image.rows[r] = rows[r + 1];
        t.gx.rows[r] = 0.5f * across[r + 1];
        t.gy.rows[r] = 0.5f * (rows[r + 2] - rows[r]);
        const vf weighted = weight.rows[r] * t.image.rows[r];
        sum_x += weight.rows[r] * t.gx.rows[r];
        sum_y += weight.rows[r] * t.gy.rows[r];
        sum_1 += weighted;
        sum_2 += weighted * t.image.rows[r];
        image_x += weighted * t.gx.rows[r];
        image_y += weighted * t.gy.rows[r];
    }
    const float mean_x = sum(sum_x), mean_y = sum(sum_y), mean = sum(sum_1);
    const float variance = std::max(0.01f, sum(sum_2) - mean * mean);  // what sums of floats tell
    const float share_x = (sum(image_x) - mean_x * mean) / variance;
    const float share_y = (sum(image_y) - mean_y * mean) / variance;
    const vf less_x = splat_f(mean_x - share_x * mean), less_y = splat_f(mean_y - share_y * mean);
    vf xx{}, xy{}, yy{};
    for (int r = 0; r < kWindow; ++r) {
        const vf gx = t.gx.rows[r] - less_x - share_x * t.image.rows[r];
        const vf gy = t.gy.rows[r] - less_y - share_y * t.image.rows[r];
        t.gx.rows[r] = weight.rows[r] * gx;
        t.gy.rows[r] = weight.rows[r] * gy;
        xx += t.gx.rows[r] * gx;
        xy += t.gx.rows[r] * gy;
        yy += t.gy.rows[r] * gy;
    }
    t.contrast = std::sqrt(variance);
    t.hxx = sum(xx);
    t.hxy = sum(xy);
    t.hyy = sum(yy);
    return true;
}

// The window of `level` around (u, v), times a template's gradients, summed up; its contrast, if asked for.
template <bool kWithContrast>
bool project(const Level& level, int border, float u, float v, const Template& t, const Window& weight, float& ex,
             float& ey, float& contrast) {
    float fu, fv;
    const float* p = corner(level, border, u, v, 0, fu, fv);
    if (!p) return false;
    vf above = load_f(p) + fu * (load_f(p + 1) - load_f(p)), bx{}, by{}, sum_1{}, sum_2{};
    for (int r = 0; r < kWindow; ++r) {
        p += level.stride;
        const vf below = load_f(p) + fu * (load_f(p + 1) - load_f(p));
        const vf moved = above + fv * (below - above);
        bx += t.gx.rows[r] * moved;
        by += t.gy.rows[r] * moved;
        if constexpr (kWithContrast) {
            const vf weighted = weight.rows[r] * moved;
            sum_1 += weighted;
            sum_2 += weighted * moved;
        }
        above = below;
    }
    ex = sum(bx);
    ey = sum(by);
    if constexpr (kWithContrast) {
        const float mean = sum(sum_1);
        contrast = std::sqrt(std::max(0.0f, sum(sum_2) - mean * mean));
    }
    return true;
}

float correlation(const Window& a, const Window& b, const Window& weight) {
    vf sa{}, sb{}, aa{}, ab{}, bb{};
    for (int r = 0; r < kWindow; ++r) {
        const vf wa = weight.rows[r] * a.rows[r], wb = weight.rows[r] * b.rows[r];
        sa += wa;
        sb += wb;
        aa += wa * a.rows[r];
        ab += wa * b.rows[r];
        bb += wb * b.rows[r];
    }
    const float ma = sum(sa), mb = sum(sb);
    const float va = sum(aa) - ma * ma, vb = sum(bb) - mb * mb;
    return va > 1e-6f && vb > 1e-6f ? (sum(ab) - ma * mb) / std::sqrt(va * vb) : 0.0f;
}

const Window& window_weight(float sigma) {
    static thread_local Window weight;
    static thread_local float made_for = -1.0f;
    if (made_for == sigma) return weight;
    float total = 0.0f;
    for (int r = 0; r < kWindow; ++r) {
        for (int c = 0; c < kWindow; ++c) {
            const float dy = r - kCenter, dx = c - kCenter;
            weight.rows[r][c] = std::exp(-0.5f * (dx * dx + dy * dy) / (sigma * sigma));
            total += weight.rows[r][c];
        }
    }
    for (auto& row : weight.rows) row /= splat_f(total);
    made_for = sigma;
    return weight;
}

}  // namespace

Tracked track_point(const Pyramid& a, const Pyramid& b, float u, float v, float guess_u, float guess_v,
                    const TrackOptions& options) {
    const Window& weight = window_weight(options.window_sigma);
    Tracked result{guess_u, guess_v, 0.0f, false};
    Template t;
    Window moved;
    float du = guess_u - u, dv = guess_v - v;
    for (int l = options.start_level; l >= 0; --l) {
        const float scale = 1.0f / static_cast<float>(1 << l);
        const Level &from = a.levels[l], &to = b.levels[l];
        if (!make_template(from, a.border, u * scale, v * scale, weight, t)) {
            if (l > 0) continue;
            return result;
        }
        const float half_trace = 0.5f * (t.hxx + t.hyy), det = t.hxx * t.hyy - t.hxy * t.hxy;
        const float smallest = half_trace - std::sqrt(std::max(0.0f, half_trace * half_trace - det));
        if (!(smallest >= options.min_eigenvalue)) {
            if (l > 0) continue;
            return result;
        }
        float x = du * scale, y = dv * scale;
        const float start_x = x, start_y = y, enough = l > 0 ? 0.05f : 0.01f;
        bool inside = true;
        float divisor = det;  // times the gain of b over a: it makes steps shorter, and they end in the same place
        for (int n = 0; n < options.iterations; ++n) {
            const float at_u = u * scale + x, at_v = v * scale + y;
            float ex, ey, contrast = 0.0f;
            inside = n == 0 ? project<true>(to, b.border, at_u, at_v, t, weight, ex, ey, contrast)
                            : project<false>(to, b.border, at_u, at_v, t, weight, ex, ey, contrast);
            if (!inside) break;
            if (n == 0) divisor = det * std::clamp(contrast / t.contrast, 1.0f / kMostGain, kMostGain);
            const float step_x = (t.hyy * ex - t.hxy * ey) / divisor, step_y = (t.hxx * ey - t.hxy * ex) / divisor;
            x -= step_x;
            y -= step_y;
            if (std::fabs(x - start_x) > kWindow || std::fabs(y - start_y) > kWindow) inside = false;
            if (!inside || step_x * step_x + step_y * step_y < enough * enough) break;
        }
        if (!inside) {
            if (l > 0) continue;
            return result;
        }
        du = x / scale;
        dv = y / scale;
    }
    result.u = u + du;
    result.v = v + dv;
    const Level& image = b.levels[0];
    if (!(result.u >= 0 && result.v >= 0 && result.u <= image.width - 1 && result.v <= image.height - 1)) return result;
    if (!sample(image, b.border, result.u, result.v, moved)) return result;
    result.correlation = correlation(t.image, moved, weight);
    result.found = true;
    return result;
}

}  // namespace mvsgs
