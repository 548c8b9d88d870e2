// Matching cost of a plane or surface sweep: warp, windowed ZNCC by separable sums, mean over the best views.
#include "stereo.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace stereo {
namespace {

constexpr int kBand = 16;      // rows that a thread handles at once
constexpr int kMaxBest = 8;
constexpr int kTile = 8;       // the side of an `active` tile, pixels

// Rows [begin, end) of the reference, one hypothesis, one neighbor: samples and whether the neighbor sees them.
void warp_rows(const float* neighbor, int nh, int nw, const Warp& t, int begin, int end, int width, const float* first,
               const float* step, float k, float* sample, float* seen) {
    const float max_x = static_cast<float>(nw - 1), max_y = static_cast<float>(nh - 1);
    for (int y = begin; y < end; ++y) {
        const float v = static_cast<float>(y);
        const float cx = t.m[1] * v + t.m[2], cy = t.m[4] * v + t.m[5], cz = t.m[7] * v + t.m[8];
        const float* f = first + static_cast<std::size_t>(y) * width;
        const float* s = step + static_cast<std::size_t>(y) * width;
        float* out = sample + static_cast<std::size_t>(y - begin) * width;
        float* ok = seen + static_cast<std::size_t>(y - begin) * width;
#pragma omp simd
        for (int x = 0; x < width; ++x) {
            const float u = static_cast<float>(x);
            const float w = f[x] + k * s[x];
            const float xs = t.m[0] * u + cx + w * t.b[0];
            const float ys = t.m[3] * u + cy + w * t.b[1];
            const float zs = t.m[6] * u + cz + w * t.b[2];
            const bool front = zs > 1e-6f;
            const float inv = 1.0f / (front ? zs : 1.0f);
            const float px = front ? xs * inv : -1.0f;
            const float py = front ? ys * inv : -1.0f;
            const bool inside = px >= 0.0f && px <= max_x && py >= 0.0f && py <= max_y;
            const float qx = std::min(std::max(px, 0.0f), max_x);
            const float qy = std::min(std::max(py, 0.0f), max_y);
            const int ix = std::min(static_cast<int>(qx), nw - 2);
            const int iy = std::min(static_cast<int>(qy), nh - 2);
            const float ax = qx - static_cast<float>(ix), ay = qy - static_cast<float>(iy);
            const float* p = neighbor + iy * nw + ix;
            const float top = p[0] + ax * (p[1] - p[0]);
            const float bottom = p[nw] + ax * (p[nw + 1] - p[nw]);
            out[x] = top + ay * (bottom - top);
            ok[x] = (inside && w > 0.0f) ? 1.0f : 0.0f;
        }
    }
}

// Sums over the clipped window; in: rows [begin, end) of a map; out: rows [y0, y1).
void box_sum(const float* in, int begin, int end, int width, int radius, int y0, int y1, int height, float* row,
             float* out) {
    for (int y = y0; y < y1; ++y) {
        const int top = std::max(y - radius, 0), bottom = std::min(y + radius, height - 1);
        (void)end;
        const float* line = in + static_cast<std::size_t>(top - begin) * width;
        std::memcpy(row + radius, line, sizeof(float) * width);
        for (int yy = top + 1; yy <= bottom; ++yy) {
            line = in + static_cast<std::size_t>(yy - begin) * width;
#pragma omp simd
            for (int x = 0; x < width; ++x) row[radius + x] += line[x];
        }
        float* o = out + static_cast<std::size_t>(y - y0) * width;
        std::memcpy(o, row, sizeof(float) * width);
        for (int i = 1; i <= 2 * radius; ++i) {
            const float* shifted = row + i;
#pragma omp simd
            for (int x = 0; x < width; ++x) o[x] += shifted[x];
        }
    }
}

struct Scratch {
    std::vector<float> sample, seen, square, product, row, sw, sww, siw, best;
    Scratch(int width, int radius, int best_views)
        : sample(static_cast<std::size_t>(width) * (kBand + 2 * radius)),
          seen(sample.size()), square(sample.size()), product(sample.size()),
          row(static_cast<std::size_t>(width) + 2 * radius, 0.0f),
          sw(static_cast<std::size_t>(width) * kBand), sww(sw.size()), siw(sw.size()),
          best(static_cast<std::size_t>(width) * kBand * best_views) {}
};

// What the reference's windows contribute, once for all hypotheses: 1 / pixels, mean, variance + noise.
struct Reference {
    std::vector<float> inv_count, mean, variance;
    Reference(const float* image, int height, int width, int radius, float noise)
        : inv_count(static_cast<std::size_t>(height) * width), mean(inv_count.size()), variance(inv_count.size()) {
        const std::size_t n = inv_count.size();
        std::vector<float> square(n), row(static_cast<std::size_t>(width) + 2 * radius, 0.0f);
        for (std::size_t i = 0; i < n; ++i) square[i] = image[i] * image[i];
        box_sum(image, 0, height, width, radius, 0, height, height, row.data(), mean.data());
        box_sum(square.data(), 0, height, width, radius, 0, height, height, row.data(), variance.data());
        for (int y = 0; y < height; ++y) {
            const int ny = std::min(y + radius, height - 1) - std::max(y - radius, 0) + 1;
            for (int x = 0; x < width; ++x) {
                const int nx = std::min(x + radius, width - 1) - std::max(x - radius, 0) + 1;
                const std::size_t i = static_cast<std::size_t>(y) * width + x;
                inv_count[i] = 1.0f / static_cast<float>(nx * ny);
                mean[i] *= inv_count[i];
                variance[i] = std::max(variance[i] * inv_count[i] - mean[i] * mean[i], 0.0f) + noise;
            }
        }
    }
};

// ZNCC of one row from the sums; -2 where the neighbor does not see the pixel.
void correlate_row(const float* inv, const float* mean_i, const float* var_i, const float* sw, const float* sww,
                   const float* siw, const float* seen, int width, float noise, float* ncc) {
#pragma omp simd
    for (int x = 0; x < width; ++x) {
        const float mean_w = sw[x] * inv[x];
        const float var_w = std::max(sww[x] * inv[x] - mean_w * mean_w, 0.0f) + noise;
        const float covariance = siw[x] * inv[x] - mean_i[x] * mean_w;
        const float c = covariance / std::sqrt(var_i[x] * var_w);
        ncc[x] = seen[x] > 0.0f ? c : -2.0f;
    }
}

// One view, one hypothesis, rows [y0, y1): fills sums in scratch. Returns the first row of the halo.
int sums_of_view(const float* reference, int height, int width, const float* neighbor, int nh, int nw, const Warp& t,
                 const float* first, const float* step, float k, int radius, int y0, int y1, Scratch& s) {
    const int begin = std::max(y0 - radius, 0), end = std::min(y1 + radius, height);
    warp_rows(neighbor, nh, nw, t, begin, end, width, first, step, k, s.sample.data(), s.seen.data());
    const std::size_t n = static_cast<std::size_t>(end - begin) * width;
    const float* ref = reference + static_cast<std::size_t>(begin) * width;
    float *sample = s.sample.data(), *square = s.square.data(), *product = s.product.data();
#pragma omp simd
    for (std::size_t i = 0; i < n; ++i) {
        square[i] = sample[i] * sample[i];
        product[i] = sample[i] * ref[i];
    }
    box_sum(sample, begin, end, width, radius, y0, y1, height, s.row.data(), s.sw.data());
    box_sum(square, begin, end, width, radius, y0, y1, height, s.row.data(), s.sww.data());
    box_sum(product, begin, end, width, radius, y0, y1, height, s.row.data(), s.siw.data());
    return begin;
}

bool any_active(const std::uint8_t* active, int width, int y0, int y1) {
    if (active == nullptr) return true;
    const int columns = (width + kTile - 1) / kTile;
    for (int row = y0 / kTile; row <= (y1 - 1) / kTile; ++row)
        for (int c = 0; c < columns; ++c)
            if (active[static_cast<std::size_t>(row) * columns + c]) return true;
    return false;
}

}  // namespace

void cost_volume(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views,
                 int nh, int nw, const float* first, const float* step, const std::uint8_t* active,
                 const CostOptions& o, float* cost) {
    const Reference stats(reference, height, width, o.radius, o.noise);
    const int best = std::min({o.best, views, kMaxBest});
    const int bands = (height + kBand - 1) / kBand;
#pragma omp parallel num_threads(o.threads)
    {
        Scratch s(width, o.radius, best);
        std::vector<float> value(width);
#pragma omp for schedule(dynamic)
        for (int band = 0; band < bands; ++band) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            if (!any_active(active, width, y0, y1)) {
                for (int y = y0; y < y1; ++y)
                    std::fill_n(cost + static_cast<std::size_t>(y) * o.hypotheses * width,
                                static_cast<std::size_t>(o.hypotheses) * width, 1.0f);
                continue;
            }
            for (int k = 0; k < o.hypotheses; ++k) {
                std::fill(s.best.begin(), s.best.end(), 1.0f);
                for (int n = 0; n < views; ++n) {
                    const int begin =
                        sums_of_view(reference, height, width, neighbors + static_cast<std::size_t>(n) * nh * nw, nh,
                                     nw, warps[n], first, step, static_cast<float>(k), o.radius, y0, y1, s);
                    for (int y = y0; y < y1; ++y) {
                        const std::size_t r = static_cast<std::size_t>(y) * width;
                        const std::size_t b = static_cast<std::size_t>(y - y0) * width;
                        correlate_row(&stats.inv_count[r], &stats.mean[r], &stats.variance[r], &s.sw[b], &s.sww[b],
                                      &s.siw[b], &s.seen[static_cast<std::size_t>(y - begin) * width], width, o.noise,
                                      value.data());
                        float* slots = s.best.data() + b * best;  // [best][width] of this row, ascending
#pragma omp simd
                        for (int x = 0; x < width; ++x) {
                            float c = std::min(std::max(1.0f - value[x], 0.0f), 1.0f);
                            for (int j = 0; j < best; ++j) {
                                float& slot = slots[static_cast<std::size_t>(j) * width + x];
                                const float lower = std::min(slot, c);
                                c = std::max(slot, c);
                                slot = lower;
                            }
                        }
                    }
                }
                const float share = 1.0f / static_cast<float>(best);
                for (int y = y0; y < y1; ++y) {
                    const float* slots = s.best.data() + static_cast<std::size_t>(y - y0) * width * best;
                    float* out = cost + (static_cast<std::size_t>(y) * o.hypotheses + k) * width;
#pragma omp simd
                    for (int x = 0; x < width; ++x) {
                        float sum = 0.0f;
                        for (int j = 0; j < best; ++j) sum += slots[static_cast<std::size_t>(j) * width + x];
                        out[x] = sum * share;
                    }
                }
            }
        }
    }
}

void view_correlation(const float* reference, int height, int width, const float* neighbors, const Warp* warps,
                      int views, int nh, int nw, const float* inverse_depth, int radius, float noise, int threads,
                      float* correlation) {
    const Reference stats(reference, height, width, radius, noise);
    const std::vector<float> step(static_cast<std::size_t>(height) * width, 0.0f);
    const int bands = (height + kBand - 1) / kBand;
#pragma omp parallel num_threads(threads)
    {
        Scratch s(width, radius, 1);
#pragma omp for schedule(dynamic)
        for (int band = 0; band < bands; ++band) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            for (int n = 0; n < views; ++n) {
                const int begin = sums_of_view(reference, height, width,
                                               neighbors + static_cast<std::size_t>(n) * nh * nw, nh, nw, warps[n],
                                               inverse_depth, step.data(), 0.0f, radius, y0, y1, s);
                for (int y = y0; y < y1; ++y) {
                    const std::size_t r = static_cast<std::size_t>(y) * width;
                    const std::size_t b = static_cast<std::size_t>(y - y0) * width;
                    correlate_row(&stats.inv_count[r], &stats.mean[r], &stats.variance[r], &s.sw[b], &s.sww[b],
                                  &s.siw[b], &s.seen[static_cast<std::size_t>(y - begin) * width], width, noise,
                                  correlation + static_cast<std::size_t>(n) * height * width + r);
                }
            }
        }
    }
}

}  // namespace stereo
