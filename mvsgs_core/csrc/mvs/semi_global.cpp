// Semi-global smoothing (Hirschmueller 2008, eq. 13) over hypothesis indices, then the best one and its probability.
//
// Indices, not inverse depths, are smoothed: the hypotheses of two pixels are offsets from the surface `first`, so a
// slanted surface that an earlier stage found costs nothing. Where `first` itself jumps the path starts anew.
// Volumes are (H, D, W): paths with a vertical component vectorise along W; horizontal ones run on the transpose.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "caught.hpp"
#include "mvs/exponential.hpp"
#include "mvs/lanes.hpp"
#include "mvs/mvs.hpp"

namespace mvs {
namespace {

struct Plane {  // one orientation of the problem: rows are visited in order, pixels of a row are independent
    const float* cost;
    const float* image;
    const float* first;
    const float* step;
    int rows, hypotheses, columns;
};

// Adds the path costs of direction (dx, +1 or -1 row) to `sum` (rows, D, columns).
void add_path(const Plane& p, int dx, bool reverse, const SmoothOptions& o, float* sum) {
    const int w = p.columns, d = p.hypotheses;
    const std::size_t padded = static_cast<std::size_t>(w) + 2;
    constexpr float kHigh = 1e9f;
    std::vector<float> current(padded * (d + 2), 0.0f), previous(current.size(), 0.0f);
    std::vector<float> lowest(padded, 0.0f), lowest_previous(padded, 0.0f), relax(w, 1.0f);
    for (int side : {0, d + 1}) {  // no hypothesis beyond the first and the last
        std::fill_n(current.begin() + static_cast<std::ptrdiff_t>(side * padded), padded, kHigh);
        std::fill_n(previous.begin() + static_cast<std::ptrdiff_t>(side * padded), padded, kHigh);
    }
    const float inv_edge = 1.0f / o.edge;
    for (int i = 0; i < p.rows; ++i) {
        const int y = reverse ? p.rows - 1 - i : i;
        const std::size_t row = static_cast<std::size_t>(y) * w;
        if (i > 0) {
            const std::size_t before = static_cast<std::size_t>(reverse ? y + 1 : y - 1) * w;
            const int from = std::max(dx, 0), to = w + std::min(dx, 0);
            const auto relaxed = [&](int x, int q) {
                const float contrast = std::fabs(p.image[row + x] - p.image[before + q]) * inv_edge;
                const float jump = std::fabs(p.first[row + x] - p.first[before + q]);
                const bool broken = jump > o.break_steps * larger(p.step[row + x], p.step[before + q]);
                return broken ? 0.0f : 1.0f / (1.0f + contrast);
            };
            if (from > 0) relax[0] = relaxed(0, 0);  // where the path starts at the image's side
            if (to < w) relax[w - 1] = relaxed(w - 1, w - 1);
            float* out = relax.data();
#pragma omp simd
            for (int x = from; x < to; ++x) out[x] = relaxed(x, x - dx);
        }
        float* low = lowest.data() + 1;
        std::fill(low, low + w, kHigh);
        const float* low_q = lowest_previous.data() + 1 - dx;
        for (int k = 0; k < d; ++k) {
            const float* same = previous.data() + static_cast<std::size_t>(k + 1) * padded + 1 - dx;
            const float* below = same - padded;
            const float* above = same + padded;
            float* out = current.data() + static_cast<std::size_t>(k + 1) * padded + 1;
            const float* c = p.cost + (static_cast<std::size_t>(y) * d + k) * w;
            float* total = sum + (static_cast<std::size_t>(y) * d + k) * w;
            const float small = o.p1, large = o.p2;
            const float* eased = relax.data();
#pragma omp simd
            for (int x = 0; x < w; ++x) {
                const float base = low_q[x];
                const float beside = smaller(below[x], above[x]) + small * eased[x];
                const float value = c[x] + smaller(same[x], smaller(beside, base + large * eased[x])) - base;
                out[x] = value;
                total[x] += value;
                low[x] = smaller(low[x], value);
            }
        }
        std::swap(current, previous);
        std::swap(lowest, lowest_previous);
    }
}

void transpose(const float* in, int rows, int middle, int columns, float* out) {  // (R, M, C) -> (C, M, R)
    constexpr int kBlock = 16;
    for (int m = 0; m < middle; ++m)
        for (int r0 = 0; r0 < rows; r0 += kBlock)
            for (int c0 = 0; c0 < columns; c0 += kBlock)
                for (int c = c0; c < std::min(c0 + kBlock, columns); ++c)
                    for (int r = r0; r < std::min(r0 + kBlock, rows); ++r)
                        out[(static_cast<std::size_t>(c) * middle + m) * rows + r] =
                            in[(static_cast<std::size_t>(r) * middle + m) * columns + c];
}

// Best hypothesis of one row, refined by a parabola through its neighbors' costs (measured against the expectation of
// the softmax, which leans toward whole hypotheses: 15 % fewer errors), and how sure it is. `total` (D, W): mean costs.
void select_row(const float* total, int d, int w, float temperature, float* index, float* probability, float* margin,
                std::int32_t* best) {
    const float scale = -1.0f / temperature;
    std::vector<float> lowest(total, total + w), all(w, 0.0f), near(w, 0.0f);
    std::fill_n(best, w, 0);
    std::fill_n(margin, w, 1.0f);
    for (int k = 1; k < d; ++k) {
        const float* cost = total + static_cast<std::size_t>(k) * w;
#pragma omp simd
        for (int x = 0; x < w; ++x) {
            best[x] = cost[x] < lowest[x] ? k : best[x];
            lowest[x] = cost[x] < lowest[x] ? cost[x] : lowest[x];
        }
    }
    float *sum = all.data(), *sum_near = near.data();
    for (int k = 0; k < d; ++k) {
        const float* cost = total + static_cast<std::size_t>(k) * w;
#pragma omp simd
        for (int x = 0; x < w; ++x) {
            const float gap = cost[x] - lowest[x], weight = exponential(gap * scale);
            const bool beside = k - best[x] <= 1 && best[x] - k <= 1;
            sum[x] += weight;
            sum_near[x] += beside ? weight : 0.0f;
            margin[x] = !beside && gap < margin[x] ? gap : margin[x];
        }
    }
    for (int x = 0; x < w; ++x) {
        const float* at = total + static_cast<std::size_t>(best[x]) * w + x;
        float offset = 0.0f;
        if (best[x] > 0 && best[x] < d - 1) {
            const float before = at[-w] - lowest[x], after = at[w] - lowest[x];
            if (before + after > 1e-9f) offset = 0.5f * (before - after) / (before + after);
        }
        index[x] = static_cast<float>(best[x]) + offset;
        probability[x] = near[x] / all[x];
    }
}

}  // namespace

void semi_global(const float* cost, int height, int d, int width, const float* image, const float* first,
                 const float* step, const SmoothOptions& o, float* index, float* probability, float* margin,
                 std::int32_t* best) {
    const std::size_t pixels = static_cast<std::size_t>(height) * width, volume = pixels * d;
    std::vector<float> cost_t(volume), image_t(pixels), first_t(pixels), step_t(pixels);
    transpose(cost, height, d, width, cost_t.data());
    transpose(image, height, 1, width, image_t.data());
    transpose(first, height, 1, width, first_t.data());
    transpose(step, height, 1, width, step_t.data());
    const Plane upright{cost, image, first, step, height, d, width};
    const Plane sideways{cost_t.data(), image_t.data(), first_t.data(), step_t.data(), width, d, height};

    // Two accumulators per orientation, each filled by one thread in a fixed order: the sum does not depend on timing.
    std::vector<float> down(volume, 0.0f), up(volume, 0.0f), right(volume, 0.0f), left(volume, 0.0f);
    const auto add_paths = [&](int job) {
        if (job == 0 || job == 1) {
            float* sum = job == 0 ? down.data() : up.data();
            add_path(upright, 0, job == 1, o, sum);
            if (o.paths == 8) {
                add_path(upright, 1, job == 1, o, sum);
                add_path(upright, -1, job == 1, o, sum);
            }
        } else {
            add_path(sideways, 0, job == 3, o, job == 2 ? right.data() : left.data());
        }
    };
    Caught caught;
#pragma omp parallel for schedule(dynamic, 1) num_threads(o.threads)
    for (int job = 0; job < 4; ++job) caught([&] { add_paths(job); });
    caught.rethrow();
    std::vector<float>& horizontal_t = right;
    for (std::size_t i = 0; i < volume; ++i) horizontal_t[i] += left[i];
    std::vector<float>& horizontal = left;
    transpose(horizontal_t.data(), width, d, height, horizontal.data());
    const float share = 1.0f / static_cast<float>(o.paths);
#pragma omp parallel for schedule(static) num_threads(o.threads)
    for (int y = 0; y < height; ++y) {
        const std::size_t row = static_cast<std::size_t>(y) * d * width, out = static_cast<std::size_t>(y) * width;
        float* total = down.data() + row;
        for (int i = 0; i < d * width; ++i) total[i] = (total[i] + up[row + i] + horizontal[row + i]) * share;
        caught([&] {
            select_row(total, d, width, o.temperature, index + out, probability + out, margin + out, best + out);
        });
    }
    caught.rethrow();
}

}  // namespace mvs
