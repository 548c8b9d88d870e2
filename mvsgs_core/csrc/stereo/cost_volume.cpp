// Matching cost of a plane or surface sweep: warp, ZNCC in adaptive windows, mean over the best views.
//
// A window's pixels count by how similar they are to its center in the reference (Yoon and Kweon 2006): at the edge of
// an object the window then holds that object's pixels only, which keeps it from growing over what is behind it.
#include "stereo.hpp"

#include <algorithm>
#include <cmath>

namespace stereo {
namespace {

constexpr int kBand = kTileRows;  // rows that a thread handles at once: their window weights stay in its cache
constexpr int kMaxBest = 8;

int taps_of(int radius) { return (2 * radius + 1) * (2 * radius + 1); }

// Columns [from, to) of some rows.
struct Columns {
    int from, to;
    Columns wider(int by, int width) const { return {std::max(from - by, 0), std::min(to + by, width)}; }
};

// Rows [begin, end) of the reference, one hypothesis, one neighbor: samples, in rows padded by `pad` on both sides,
// and whether the neighbor sees them.
void warp_rows(const float* neighbor, int nh, int nw, const Warp& t, int begin, int end, int width, Columns columns,
               int pad, const float* first, const float* step, float k, float* sample, float* seen) {
    const float max_x = static_cast<float>(nw - 1), max_y = static_cast<float>(nh - 1);
    for (int y = begin; y < end; ++y) {
        const float v = static_cast<float>(y);
        const float cx = t.m[1] * v + t.m[2], cy = t.m[4] * v + t.m[5], cz = t.m[7] * v + t.m[8];
        const float* f = first + static_cast<std::size_t>(y) * width;
        const float* s = step + static_cast<std::size_t>(y) * width;
        float* out = sample + static_cast<std::size_t>(y - begin) * (width + 2 * pad) + pad;
        float* ok = seen + static_cast<std::size_t>(y - begin) * width;
#pragma omp simd
        for (int x = columns.from; x < columns.to; ++x) {
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

// The windows of rows [y0, y1) of the reference: normalized weights, weights times gray level, mean and variance.
struct Windows {
    int radius, width;
    std::vector<float> weight, weighted;  // [row][tap][x]
    std::vector<float> mean, variance;    // [row][x]; the variance includes the noise

    Windows(int width_, int radius_)
        : radius(radius_), width(width_),
          weight(static_cast<std::size_t>(kBand) * taps_of(radius_) * width_), weighted(weight.size()),
          mean(static_cast<std::size_t>(kBand) * width_), variance(mean.size()) {}

    void prepare(const float* image, int height, int y0, int y1, float contrast, float noise) {
        const int side = 2 * radius + 1, taps = side * side;
        const float sharpness = -1.0f / contrast;
        const float spread = -0.5f / static_cast<float>((radius + 1) * (radius + 1));
        std::vector<float> total(width), square(width);
        for (int y = y0; y < y1; ++y) {
            const float* center = image + static_cast<std::size_t>(y) * width;
            float* g = weight.data() + static_cast<std::size_t>(y - y0) * taps * width;
            float* gi = weighted.data() + static_cast<std::size_t>(y - y0) * taps * width;
            float* mu = mean.data() + static_cast<std::size_t>(y - y0) * width;
            float* var = variance.data() + static_cast<std::size_t>(y - y0) * width;
            std::fill(total.begin(), total.end(), 0.0f);
            std::fill(square.begin(), square.end(), 0.0f);
            std::fill(mu, mu + width, 0.0f);
            for (int dy = -radius; dy <= radius; ++dy) {
                for (int dx = -radius; dx <= radius; ++dx) {
                    float* w = g + static_cast<std::size_t>((dy + radius) * side + dx + radius) * width;
                    float* wi = gi + static_cast<std::size_t>((dy + radius) * side + dx + radius) * width;
                    const int yy = y + dy;
                    std::fill(w, w + width, 0.0f);
                    std::fill(wi, wi + width, 0.0f);
                    if (yy < 0 || yy >= height) continue;
                    const float* other = image + static_cast<std::size_t>(yy) * width + dx;
                    const float distance = std::exp(spread * static_cast<float>(dx * dx + dy * dy));
                    const int from = std::max(0, -dx), to = std::min(width, width - dx);
                    for (int x = from; x < to; ++x) {
                        const float weight_here = distance * std::exp(sharpness * std::fabs(other[x] - center[x]));
                        w[x] = weight_here;
                        wi[x] = weight_here * other[x];
                        total[x] += weight_here;
                        mu[x] += weight_here * other[x];
                        square[x] += weight_here * other[x] * other[x];
                    }
                }
            }
            for (int x = 0; x < width; ++x) {
                total[x] = 1.0f / total[x];
                mu[x] *= total[x];
                var[x] = std::max(square[x] * total[x] - mu[x] * mu[x], 0.0f) + noise;
            }
            for (int i = 0; i < taps; ++i) {
                for (int x = 0; x < width; ++x) {
                    g[static_cast<std::size_t>(i) * width + x] *= total[x];
                    gi[static_cast<std::size_t>(i) * width + x] *= total[x];
                }
            }
        }
    }
};

struct Scratch {
    int pad;
    std::vector<float> sample, seen, sum, square, product, best, value;
    Scratch(int width, int radius, int best_views)
        : pad(radius), sample(static_cast<std::size_t>(width + 2 * radius) * (kBand + 2 * radius), 0.0f),
          seen(static_cast<std::size_t>(width) * (kBand + 2 * radius)), sum(width), square(width), product(width),
          best(static_cast<std::size_t>(width) * kBand * best_views), value(width) {}
};

// ZNCC of row y against the samples; -2 where the neighbor does not see the pixel.
void correlate_row(const Windows& windows, int y, int y0, int begin, int height, Columns columns, float noise,
                   Scratch& s, float* ncc) {
    const int width = windows.width, radius = windows.radius, side = 2 * radius + 1;
    const int from = columns.from, to = columns.to;
    const std::size_t row = static_cast<std::size_t>(y - y0);
    float *sum = s.sum.data(), *square = s.square.data(), *product = s.product.data();
    std::fill(sum + from, sum + to, 0.0f);
    std::fill(square + from, square + to, 0.0f);
    std::fill(product + from, product + to, 0.0f);
    const int stride = width + 2 * s.pad;
    for (int dy = std::max(-radius, -y); dy <= std::min(radius, height - 1 - y); ++dy) {
        const float* line = s.sample.data() + static_cast<std::size_t>(y + dy - begin) * stride + s.pad;
        for (int dx = -radius; dx <= radius; ++dx) {
            const std::size_t tap = (row * side * side + static_cast<std::size_t>((dy + radius) * side + dx + radius)) *
                                    static_cast<std::size_t>(width);
            const float* w = windows.weight.data() + tap;
            const float* wi = windows.weighted.data() + tap;
            const float* v = line + dx;
#pragma omp simd
            for (int x = from; x < to; ++x) {
                const float weighted = w[x] * v[x];
                sum[x] += weighted;
                square[x] += weighted * v[x];
                product[x] += wi[x] * v[x];
            }
        }
    }
    const float* mean_i = windows.mean.data() + row * width;
    const float* var_i = windows.variance.data() + row * width;
    const float* seen = s.seen.data() + static_cast<std::size_t>(y - begin) * width;
#pragma omp simd
    for (int x = from; x < to; ++x) {
        const float var_w = std::max(square[x] - sum[x] * sum[x], 0.0f) + noise;
        const float covariance = product[x] - mean_i[x] * sum[x];
        const float c = covariance / std::sqrt(var_i[x] * var_w);
        ncc[x] = seen[x] > 0.0f ? c : -2.0f;
    }
}

// Costs of a row from its correlation and the mean gray levels of both windows; keeps the `best` smallest of each
// pixel, ascending; slots is [best][width].
void insert_cost(const float* ncc, const float* mean, const float* mean_there, int width, Columns columns,
                 const CostOptions& o, int best, float* slots) {
    const float level = o.level, sharpness = 1.0f / o.level_range;
#pragma omp simd
    for (int x = columns.from; x < columns.to; ++x) {
        const float shape = std::min(std::max(1.0f - ncc[x], 0.0f), 1.0f);
        const float apart = std::min(std::fabs(mean[x] - mean_there[x]) * sharpness, 1.0f);
        float c = ncc[x] < -1.5f ? 1.0f : shape + level * (apart - shape);
        for (int j = 0; j < best; ++j) {
            float& slot = slots[static_cast<std::size_t>(j) * width + x];
            const float lower = std::min(slot, c);
            c = std::max(slot, c);
            slot = lower;
        }
    }
}

// Runs of needed tiles of one band and hypothesis; all columns where nothing says otherwise.
void runs_of(const std::uint8_t* needed, int tiles, int width, std::vector<Columns>& runs) {
    runs.clear();
    if (needed == nullptr) {
        runs.push_back({0, width});
        return;
    }
    for (int t = 0; t < tiles; ++t) {
        if (!needed[t]) continue;
        const int from = t * kTileColumns, to = std::min(from + kTileColumns, width);
        if (!runs.empty() && runs.back().to == from)
            runs.back().to = to;
        else
            runs.push_back({from, to});
    }
}

// Hypothesis k of a pixel: first[k stride] + k factor step, of maps (H, W).
struct Hypotheses {
    const float* first;
    std::size_t stride;
    const float* step;
    float factor;
};

// cost (H, D, W) of the hypotheses: see cost_volume.
void sweep(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views, int nh,
           int nw, const Hypotheses& h, const std::uint8_t* needed, const CostOptions& o, float* cost) {
    const int best = std::min({o.best, views, kMaxBest});
    const float share = 1.0f / static_cast<float>(best);
    const int bands = (height + kBand - 1) / kBand, tiles = (width + kTileColumns - 1) / kTileColumns;
#pragma omp parallel num_threads(o.threads)
    {
        Scratch s(width, o.radius, best);
        Windows windows(width, o.radius);
        std::vector<Columns> runs;
#pragma omp for schedule(dynamic)
        for (int band = 0; band < bands; ++band) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            const int begin = std::max(y0 - o.radius, 0), end = std::min(y1 + o.radius, height);
            windows.prepare(reference, height, y0, y1, o.contrast, o.noise);
            for (int k = 0; k < o.hypotheses; ++k) {
                const std::size_t at = (static_cast<std::size_t>(band) * o.hypotheses + k) * tiles;
                runs_of(needed == nullptr ? nullptr : needed + at, tiles, width, runs);
                if (needed != nullptr)
                    for (int y = y0; y < y1; ++y) {
                        float* out = cost + (static_cast<std::size_t>(y) * o.hypotheses + k) * width;
                        std::fill(out, out + width, 1.0f);
                    }
                for (const Columns& run : runs) {
                    std::fill(s.best.begin(), s.best.end(), 1.0f);
                    for (int n = 0; n < views; ++n) {
                        warp_rows(neighbors + static_cast<std::size_t>(n) * nh * nw, nh, nw, warps[n], begin, end,
                                  width, run.wider(o.radius, width), o.radius, h.first + k * h.stride, h.step,
                                  h.factor * static_cast<float>(k), s.sample.data(), s.seen.data());
                        for (int y = y0; y < y1; ++y) {
                            correlate_row(windows, y, y0, begin, height, run, o.noise, s, s.value.data());
                            insert_cost(s.value.data(),
                                        windows.mean.data() + static_cast<std::size_t>(y - y0) * width, s.sum.data(),
                                        width, run, o, best,
                                        s.best.data() + static_cast<std::size_t>(y - y0) * width * best);
                        }
                    }
                    for (int y = y0; y < y1; ++y) {
                        const float* slots = s.best.data() + static_cast<std::size_t>(y - y0) * width * best;
                        float* out = cost + (static_cast<std::size_t>(y) * o.hypotheses + k) * width;
#pragma omp simd
                        for (int x = run.from; x < run.to; ++x) {
                            float sum = 0.0f;
                            for (int j = 0; j < best; ++j) sum += slots[static_cast<std::size_t>(j) * width + x];
                            out[x] = sum * share;
                        }
                    }
                }
            }
        }
    }
}

}  // namespace

void cost_volume(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views,
                 int nh, int nw, const float* first, const float* step, const std::uint8_t* needed,
                 const CostOptions& o, float* cost) {
    sweep(reference, height, width, neighbors, warps, views, nh, nw, {first, 0, step, 1.0f}, needed, o, cost);
}

void surface_costs(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views,
                   int nh, int nw, const float* surfaces, const std::uint8_t* needed,
                   const CostOptions& o, float* cost) {
    const std::size_t pixels = static_cast<std::size_t>(height) * width;
    const std::vector<float> step(pixels, 0.0f);
    sweep(reference, height, width, neighbors, warps, views, nh, nw, {surfaces, pixels, step.data(), 0.0f}, needed, o,
          cost);
}

void view_correlation(const float* reference, int height, int width, const float* neighbors, const Warp* warps,
                      int views, int nh, int nw, const float* inverse_depth, const CostOptions& o,
                      float* correlation) {
    const std::vector<float> step(static_cast<std::size_t>(height) * width, 0.0f);
    const int bands = (height + kBand - 1) / kBand;
#pragma omp parallel num_threads(o.threads)
    {
        Scratch s(width, o.radius, 1);
        Windows windows(width, o.radius);
#pragma omp for schedule(dynamic)
        for (int band = 0; band < bands; ++band) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            const int begin = std::max(y0 - o.radius, 0), end = std::min(y1 + o.radius, height);
            windows.prepare(reference, height, y0, y1, o.contrast, o.noise);
            for (int n = 0; n < views; ++n) {
                warp_rows(neighbors + static_cast<std::size_t>(n) * nh * nw, nh, nw, warps[n], begin, end, width,
                          {0, width}, o.radius, inverse_depth, step.data(), 0.0f, s.sample.data(), s.seen.data());
                for (int y = y0; y < y1; ++y)
                    correlate_row(windows, y, y0, begin, height, {0, width}, o.noise, s,
                                  correlation + (static_cast<std::size_t>(n) * height + y) * width);
            }
        }
    }
}

}  // namespace stereo
