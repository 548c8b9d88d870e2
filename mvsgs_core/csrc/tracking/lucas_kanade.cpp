#include "lucas_kanade.hpp"

#include <cmath>

#include "lanes.hpp"

namespace mvsgs {
namespace {

constexpr int kWindow = 16;  // pixels; a row is one vector
constexpr float kCenter = 7.5f;

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

// The window of `a` with its gradients, weighted and freed of their means: what a brightness offset can't move.
struct Template {
    Window image, gx, gy;
    float hxx, hxy, hyy;
};

bool make_template(const Level& level, int border, float u, float v, const Window& weight, Template& t) {
    float fu, fv;
    const float* p = corner(level, border, u, v, 1, fu, fv);
    if (!p) return false;
    vf left[kWindow + 3], middle[kWindow + 3], right[kWindow + 3];
    p -= level.stride;
    for (int r = 0; r < kWindow + 3; ++r, p += level.stride) {
        const vf a = load_f(p - 1), b = load_f(p), c = load_f(p + 1), d = load_f(p + 2);
        left[r] = a + fu * (b - a);
        middle[r] = b + fu * (c - b);
        right[r] = c + fu * (d - c);
    }
    auto between = [&](const vf* rows, int r) { return rows[r] + fv * (rows[r + 1] - rows[r]); };
    vf sum_x{}, sum_y{};
    for (int r = 0; r < kWindow; ++r) {
        t.image.rows[r] = between(middle, r + 1);
        t.gx.rows[r] = 0.5f * (between(right, r + 1) - between(left, r + 1));
        t.gy.rows[r] = 0.5f * (between(middle, r + 2) - between(middle, r));
        sum_x += weight.rows[r] * t.gx.rows[r];
        sum_y += weight.rows[r] * t.gy.rows[r];
    }
    const vf mean_x = splat_f(sum(sum_x)), mean_y = splat_f(sum(sum_y));
    vf xx{}, xy{}, yy{};
    for (int r = 0; r < kWindow; ++r) {
        const vf gx = t.gx.rows[r] - mean_x, gy = t.gy.rows[r] - mean_y;
        t.gx.rows[r] = weight.rows[r] * gx;
        t.gy.rows[r] = weight.rows[r] * gy;
        xx += t.gx.rows[r] * gx;
        xy += t.gx.rows[r] * gy;
        yy += t.gy.rows[r] * gy;
    }
    t.hxx = sum(xx);
    t.hxy = sum(xy);
    t.hyy = sum(yy);
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
        for (int n = 0; n < options.iterations; ++n) {
            inside = sample(to, b.border, u * scale + x, v * scale + y, moved);
            if (!inside) break;
            vf bx{}, by{};
            for (int r = 0; r < kWindow; ++r) {
                const vf error = moved.rows[r] - t.image.rows[r];
                bx += t.gx.rows[r] * error;
                by += t.gy.rows[r] * error;
            }
            const float ex = sum(bx), ey = sum(by);
            const float step_x = (t.hyy * ex - t.hxy * ey) / det, step_y = (t.hxx * ey - t.hxy * ex) / det;
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
