// Matching cost of a plane or surface sweep: warp, ZNCC in adaptive windows, mean over the best views.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "lanes.hpp"
#include "stereo.hpp"
#include "windows.hpp"

namespace stereo {
namespace {

constexpr int kMaxBest = 8;

// Columns [from, to) of some rows.
struct Columns {
    int from, to;
    Columns wider(int by, int width) const { return {std::max(from - by, 0), std::min(to + by, width)}; }
};

// What a thread works in. Rows are as long as the windows' blocks together; `stride`: of samples.
struct Scratch {
    int padded, stride;
    std::vector<float> sample, seen, correlation, mean, variance, best;
    Scratch(const Windows& w, int top_k)
        : padded(w.blocks * Windows::kBlock), stride(padded + 2 * w.radius),
          sample(static_cast<std::size_t>(stride) * (kBand + 2 * w.radius), 0.0f),
          seen(static_cast<std::size_t>(padded) * (kBand + 2 * w.radius), 0.0f), correlation(padded), mean(padded),
          variance(padded), best(static_cast<std::size_t>(padded) * kBand * top_k) {}
};

// Where a row's pixels lie in the neighbor: the upper left of the four pixels around each, and the others' shares. The
// four come in two pairs, each one load: gathers are slow, and many instruction sets have none.
struct Footprints {
    static constexpr int kBlock = 64;
    std::int32_t at[kBlock];
    float right[kBlock], down[kBlock];
    float top[2 * kBlock], bottom[2 * kBlock];

    void sample(const float* neighbor, int nw, int count, float* out) {
        for (int i = 0; i < count; ++i) {
            const float* p = neighbor + at[i];
            std::memcpy(top + 2 * i, p, 2 * sizeof(float));
            std::memcpy(bottom + 2 * i, p + nw, 2 * sizeof(float));
        }
#pragma omp simd
        for (int i = 0; i < count; ++i) {
            const float above = top[2 * i] + right[i] * (top[2 * i + 1] - top[2 * i]);
            const float below = bottom[2 * i] + right[i] * (bottom[2 * i + 1] - bottom[2 * i]);
            out[i] = above + down[i] * (below - above);
        }
    }
};

// Rows [begin, end) of the reference, one hypothesis, one neighbor: samples, in rows padded by `pad` on both sides,
// and whether the neighbor sees them, in `s`.
void warp_rows(const float* neighbor, int nh, int nw, const Warp& warp, int begin, int end, int width, Columns columns,
               const float* first, const float* step, float k, int pad, Scratch& s) {
    const float max_x = static_cast<float>(nw - 1), max_y = static_cast<float>(nh - 1);
    const int last_x = nw - 2, last_y = nh - 2;
    const Warp t = warp;
    Footprints found;
    for (int y = begin; y < end; ++y) {
        const float v = static_cast<float>(y);
        const float cx = t.m[1] * v + t.m[2], cy = t.m[4] * v + t.m[5], cz = t.m[7] * v + t.m[8];
        const float* f = first + static_cast<std::size_t>(y) * width;
        const float* per = step + static_cast<std::size_t>(y) * width;
        float* out = s.sample.data() + static_cast<std::size_t>(y - begin) * s.stride + pad;
        float* ok = s.seen.data() + static_cast<std::size_t>(y - begin) * s.padded;
        for (int block = columns.from; block < columns.to; block += Footprints::kBlock) {
            const int count = std::min(Footprints::kBlock, columns.to - block);
#pragma omp simd
            for (int i = 0; i < count; ++i) {
                const int x = block + i;
                const float u = static_cast<float>(x);
                const float w = f[x] + k * per[x];
                const float xs = t.m[0] * u + cx + w * t.b[0];
                const float ys = t.m[3] * u + cy + w * t.b[1];
                const float zs = t.m[6] * u + cz + w * t.b[2];
                const bool front = zs > 1e-6f;
                const float inv = 1.0f / (front ? zs : 1.0f);
                const float px = front ? xs * inv : -1.0f;
                const float py = front ? ys * inv : -1.0f;
                const float low_x = px > 0.0f ? px : 0.0f, low_y = py > 0.0f ? py : 0.0f;  // NaN becomes 0
                const float qx = low_x < max_x ? low_x : max_x, qy = low_y < max_y ? low_y : max_y;
                const int fx = static_cast<int>(qx), fy = static_cast<int>(qy);
                const int ix = fx < last_x ? fx : last_x, iy = fy < last_y ? fy : last_y;
                found.at[i] = iy * nw + ix;
                found.right[i] = qx - static_cast<float>(ix);
                found.down[i] = qy - static_cast<float>(iy);
                ok[x] = (qx == px) & (qy == py) & (w > 0.0f) ? 1.0f : 0.0f;  // what clamping moved lies outside
            }
            found.sample(neighbor, nw, count, out + block);
        }
    }
}

// ZNCC of row y against the samples, -2 where the neighbor does not see the pixel, and the samples' mean in each
// window: in `s`, from the first of the columns to the end of the last one's vector.
void correlate_row(const Windows& windows, int y, int y0, int begin, int height, Columns columns, float noise,
                   Scratch& s) {
    const int radius = windows.radius, side = 2 * radius + 1, row = y - y0;
    const int up = std::max(-radius, -y), down = std::min(radius, height - 1 - y);
    const float *mean_i = windows.mean_row(row), *var_i = windows.variance_row(row);
    for (int x = columns.from; x < columns.to; x += kLanes) {
        const float* w = windows.weights(row, x / Windows::kBlock) + x % Windows::kBlock;
        w += static_cast<std::ptrdiff_t>(up + radius) * side * Windows::kBlock;
        Lanes sum{}, square{}, product{};  // in registers through all taps
        for (int dy = up; dy <= down; ++dy) {
            const float* there = s.sample.data() + static_cast<std::size_t>(y + dy - begin) * s.stride + radius + x;
            const float* here = windows.gray_row(row + dy) + x;
            for (int dx = -radius; dx <= radius; ++dx, w += Windows::kBlock) {
                const Lanes value = load(there + dx), weighted = load(w) * value;
                sum += weighted;
                square += weighted * value;
                product += weighted * load(here + dx);
            }
        }
        const Lanes variance = square - sum * sum;
        store(&s.mean[x], sum);
        store(&s.variance[x], (variance > 0.0f ? variance : Lanes{}) + noise);
        store(&s.correlation[x], product - load(mean_i + x) * sum);
    }
    const float *seen = s.seen.data() + static_cast<std::size_t>(y - begin) * s.padded, *variance = s.variance.data();
    float* correlation = s.correlation.data();
#pragma omp simd
    for (int x = columns.from; x < columns.to; ++x) {
        const float c = correlation[x] / std::sqrt(var_i[x] * variance[x]);
        correlation[x] = seen[x] > 0.0f ? c : -2.0f;
    }
}

// Turns a row's correlation into costs, with the mean gray levels of both windows, and keeps the `best` smallest of
// each pixel, ascending; slots is [best][padded].
void insert_cost(const float* mean, Columns columns, const CostOptions& o, int best, Scratch& s, float* slots) {
    const float level = o.level, sharpness = 1.0f / o.level_range;
    const float* mean_there = s.mean.data();
    float* cost = s.correlation.data();
#pragma omp simd
    for (int x = columns.from; x < columns.to; ++x) {
        const float shape = std::min(std::max(1.0f - cost[x], 0.0f), 1.0f);
        const float apart = std::min(std::fabs(mean[x] - mean_there[x]) * sharpness, 1.0f);
        cost[x] = cost[x] < -1.5f ? 1.0f : shape + level * (apart - shape);
    }
    for (int j = 0; j < best; ++j) {
        float* slot = slots + static_cast<std::size_t>(j) * s.padded;
#pragma omp simd
        for (int x = columns.from; x < columns.to; ++x) {
            const float lower = std::min(slot[x], cost[x]);
            cost[x] = std::max(slot[x], cost[x]);
            slot[x] = lower;
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
        Windows windows(width, o.radius);
        Scratch s(windows, best);
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
                                  width, run.wider(o.radius, width), h.first + k * h.stride, h.step,
                                  h.factor * static_cast<float>(k), o.radius, s);
                        for (int y = y0; y < y1; ++y) {
                            correlate_row(windows, y, y0, begin, height, run, o.noise, s);
                            insert_cost(windows.mean_row(y - y0), run, o, best, s,
                                        s.best.data() + static_cast<std::size_t>(y - y0) * s.padded * best);
                        }
                    }
                    for (int y = y0; y < y1; ++y) {
                        const float* slots = s.best.data() + static_cast<std::size_t>(y - y0) * s.padded * best;
                        float* out = cost + (static_cast<std::size_t>(y) * o.hypotheses + k) * width;
                        for (int x = run.from; x < run.to; ++x) out[x] = slots[x] * share;
                        for (int j = 1; j < best; ++j) {
                            slots += s.padded;
                            for (int x = run.from; x < run.to; ++x) out[x] += slots[x] * share;
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
        Windows windows(width, o.radius);
        Scratch s(windows, 1);
#pragma omp for schedule(dynamic)
        for (int band = 0; band < bands; ++band) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            const int begin = std::max(y0 - o.radius, 0), end = std::min(y1 + o.radius, height);
            windows.prepare(reference, height, y0, y1, o.contrast, o.noise);
            for (int n = 0; n < views; ++n) {
                warp_rows(neighbors + static_cast<std::size_t>(n) * nh * nw, nh, nw, warps[n], begin, end, width,
                          {0, width}, inverse_depth, step.data(), 0.0f, o.radius, s);
                for (int y = y0; y < y1; ++y) {
                    correlate_row(windows, y, y0, begin, height, {0, width}, o.noise, s);
                    std::copy_n(s.correlation.data(), width,
                                correlation + (static_cast<std::size_t>(n) * height + y) * width);
                }
            }
        }
    }
}

}  // namespace stereo
