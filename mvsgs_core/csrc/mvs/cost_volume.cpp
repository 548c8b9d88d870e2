// A plane or surface sweep: warp, match in adaptive windows, mean over the best views.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include <memory>
#include <vector>

#include <omp.h>

#include "caught.hpp"
#include "mvs/matching_cost.hpp"
#include "mvs/mvs.hpp"
#include "mvs/windows.hpp"
#include "mvs/zncc.hpp"

namespace mvs {
namespace {

// Rows are as long as the windows' blocks together.
int padded_width(int width) { return (width + Windows::kBlock - 1) / Windows::kBlock * Windows::kBlock; }

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

// What neighbor n shows of rows [begin, end) of the reference, as far as there are such, at one hypothesis.
void warp_rows(const Images& images, int n, int begin, int end, Columns columns, const float* first, const float* step,
               float k, NeighborRows& there) {
    const float* neighbor = images.neighbor(n);
    const int nh = images.neighbor_height, nw = images.neighbor_width, width = images.width;
    begin = std::max(begin, 0);
    end = std::min(end, images.height);
    there.begin = begin;
    const float max_x = static_cast<float>(nw - 1), max_y = static_cast<float>(nh - 1);
    const int last_x = nw - 2, last_y = nh - 2;
    const Warp t = images.warps[n];
    Footprints found;
    for (int y = begin; y < end; ++y) {
        const float v = static_cast<float>(y);
        const float cx = t.m[1] * v + t.m[2], cy = t.m[4] * v + t.m[5], cz = t.m[7] * v + t.m[8];
        const float* f = first + static_cast<std::size_t>(y) * width;
        const float* per = step + static_cast<std::size_t>(y) * width;
        float* out = there.sample.data() + static_cast<std::size_t>(y - begin) * there.stride + there.radius;
        float* ok = there.seen.data() + static_cast<std::size_t>(y - begin) * there.padded;
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

// Keeps the `best` smallest costs of each pixel of a row, ascending; slots is [best][padded]. What is not seen costs 1.
void insert_cost(const float* seen, Columns columns, int best, int padded, float* cost, float* slots) {
#pragma omp simd
    for (int x = columns.from; x < columns.to; ++x) cost[x] = seen[x] > 0.0f ? cost[x] : 1.0f;
    for (int j = 0; j < best; ++j) {
        float* slot = slots + static_cast<std::size_t>(j) * padded;
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

// cost (H, D, W) of `count` hypotheses: see cost_volume.
void sweep(const Images& images, const Hypotheses& h, int count, const std::uint8_t* needed, const CostOptions& o,
           float* cost) {
    const int height = images.height, width = images.width, views = images.views;
    const int best = std::min(o.top_k, views);
    const float mean = 1.0f / static_cast<float>(best);
    const int bands = (height + kBand - 1) / kBand, tiles = (width + kTileColumns - 1) / kTileColumns;
    const int padded = padded_width(width);
    const MakeCost make = find_cost(o.name);
    std::vector<std::unique_ptr<MatchingCost>> matching;  // here: what options without sense raise cannot leave a thread
    for (int i = 0; i < o.threads; ++i) matching.push_back(make(o, padded));
    std::atomic<int> next{0};  // band; a thread without memory leaves them to the others
    Caught caught;
#pragma omp parallel num_threads(o.threads)
    caught([&] {
        MatchingCost& match = *matching[omp_get_thread_num()];
        Windows windows(width, o.radius);
        NeighborRows there(padded, o.radius);
        std::vector<float> row(padded), lowest(static_cast<std::size_t>(padded) * kBand * best);
        const auto slots_of = [&](int band_row) {
            return lowest.data() + static_cast<std::size_t>(band_row) * padded * best;
        };
        std::vector<Columns> runs;
        for (int band = next++; band < bands; band = next++) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            windows.prepare(images.reference, height, y0, y1, o.contrast, o.noise);
            for (int k = 0; k < count; ++k) {
                const std::size_t at = (static_cast<std::size_t>(band) * count + k) * tiles;
                runs_of(needed == nullptr ? nullptr : needed + at, tiles, width, runs);
                const auto out_of = [&](int y) { return cost + (static_cast<std::size_t>(y) * count + k) * width; };
                if (needed != nullptr)
                    for (int y = y0; y < y1; ++y) std::fill_n(out_of(y), width, 1.0f);
                for (const Columns& run : runs) {
                    std::fill(lowest.begin(), lowest.end(), 1.0f);
                    for (int n = 0; n < views; ++n) {
                        warp_rows(images, n, y0 - o.radius, y1 + o.radius, run.wider(o.radius, width),
                                  h.first + k * h.stride, h.step, h.factor * static_cast<float>(k), there);
                        for (int y = y0; y < y1; ++y) {
                            match.row(windows, there, y, run, row.data());
                            insert_cost(there.seen_row(y), run, best, padded, row.data(), slots_of(y - y0));
                        }
                    }
                    for (int y = y0; y < y1; ++y) {
                        const float* slots = slots_of(y - y0);
                        float* out = out_of(y);
                        for (int x = run.from; x < run.to; ++x) out[x] = slots[x] * mean;
                        for (int j = 1; j < best; ++j) {
                            slots += padded;
                            for (int x = run.from; x < run.to; ++x) out[x] += slots[x] * mean;
                        }
                    }
                }
            }
        }
    });
    caught.rethrow();
}

}  // namespace

void cost_volume(const Images& images, const float* first, const float* step, int hypotheses,
                 const std::uint8_t* needed, const CostOptions& o, float* cost) {
    sweep(images, {first, 0, step, 1.0f}, hypotheses, needed, o, cost);
}

void surface_costs(const Images& images, const float* surfaces, int count, const std::uint8_t* needed,
                   const CostOptions& o, float* cost) {
    const std::size_t pixels = static_cast<std::size_t>(images.height) * images.width;
    const std::vector<float> step(pixels, 0.0f);
    sweep(images, {surfaces, pixels, step.data(), 0.0f}, count, needed, o, cost);
}

void view_correlation(const Images& images, const float* inverse_depth, const CostOptions& o, float* correlation) {
    const int height = images.height, width = images.width;
    const std::vector<float> step(static_cast<std::size_t>(height) * width, 0.0f);
    const int bands = (height + kBand - 1) / kBand, padded = padded_width(width);
    std::atomic<int> next{0};
    Caught caught;
#pragma omp parallel num_threads(o.threads)
    caught([&] {
        Windows windows(width, o.radius);
        NeighborRows there(padded, o.radius);
        Correlation found(padded);
        for (int band = next++; band < bands; band = next++) {
            const int y0 = band * kBand, y1 = std::min(y0 + kBand, height);
            windows.prepare(images.reference, height, y0, y1, o.contrast, o.noise);
            for (int n = 0; n < images.views; ++n) {
                warp_rows(images, n, y0 - o.radius, y1 + o.radius, {0, width}, inverse_depth, step.data(), 0.0f, there);
                for (int y = y0; y < y1; ++y) {
                    found.row(windows, there, y, {0, width}, o.noise);
                    const float *value = found.value.data(), *seen = there.seen_row(y);
                    float* out = correlation + (static_cast<std::size_t>(n) * height + y) * width;
                    for (int x = 0; x < width; ++x) out[x] = seen[x] > 0.0f ? value[x] : -2.0f;
                }
            }
        }
    });
    caught.rethrow();
}

}  // namespace mvs
