// One of several surfaces at each pixel: semi-global smoothing (Hirschmueller 2008, eq. 13) over arbitrary candidates.
//
// What two neighboring pixels pay is the distance of their inverse depths, at most `p2`, not the distance of
// indices: candidates of a pixel are extrapolated from around it and have no order.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "caught.hpp"
#include "mvs/lanes.hpp"
#include "mvs/mvs.hpp"

namespace mvs {
namespace {

// (D, R, C) volumes: rows are visited in order, the pixels of a row are independent.
struct Candidates {
    const float* cost;
    const float* surfaces;
    const float* image;
    int count, rows, columns;
    std::size_t at(int k, int row) const { return (static_cast<std::size_t>(k) * rows + row) * columns; }
};

// Adds the path costs of direction (dx, +1 or -1 row) to `sum` (D, R, C).
void add_path(const Candidates& p, int dx, bool reverse, const ChooseOptions& o, float* sum) {
    const int w = p.columns, d = p.count;
    // A cache line more than a row needs: rows a power of two apart would drive each other out of the cache.
    const std::size_t padded = static_cast<std::size_t>((w + kLanes - 1) / kLanes) * kLanes + 16;
    // Of this row, and of each pixel's predecessor; where that lies outside the image all is 0: the path starts anew.
    std::vector<float> own(padded * d, 0.0f), path(padded * d, 0.0f);
    std::vector<float> beside(padded * d, 0.0f), cost_beside(padded * d, 0.0f);
    std::vector<float> small(padded, 0.0f), large(padded, 0.0f), least(w, 0.0f);
    const float inv_edge = 1.0f / o.edge;
    const int from = std::max(dx, 0), to = w + std::min(dx, 0);
    for (int i = 0; i < p.rows; ++i) {
        const int y = reverse ? p.rows - 1 - i : i, before = reverse ? y + 1 : y - 1;
        if (i > 0) {
            const float* here = p.image + static_cast<std::size_t>(y) * w;
            const float* there = p.image + static_cast<std::size_t>(before) * w - dx;
            for (int x = from; x < to; ++x) {
                const float relax = 1.0f / (1.0f + std::fabs(here[x] - there[x]) * inv_edge);
                small[x] = o.p1 * relax;
                large[x] = o.p2 * relax;
            }
            std::copy_n(path.data(), w, least.data());
            for (int k = 1; k < d; ++k)
                for (int x = 0; x < w; ++x) least[x] = std::min(least[x], path[k * padded + x]);
            // Inverse depths in units of cost: their difference is the penalty.
            for (int k = 0; k < d; ++k) {
                const float *surface = p.surfaces + p.at(k, y), *surface_beside = p.surfaces + p.at(k, before) - dx;
                const float* along = path.data() + k * padded - dx;
                float *scaled = own.data() + k * padded, *scaled_beside = beside.data() + k * padded;
                float* so_far = cost_beside.data() + k * padded;
                for (int x = from; x < to; ++x) scaled[x] = small[x] * surface[x];
                for (int x = from; x < to; ++x) scaled_beside[x] = small[x] * surface_beside[x];
                for (int x = from; x < to; ++x) so_far[x] = along[x] - least[x - dx];
            }
        }
        for (std::size_t x = 0; x < static_cast<std::size_t>(w); x += kLanes) {
            const Lanes most = load(&large[x]);
            for (int k = 0; k < d; ++k) {
                const Lanes surface = load(&own[k * padded + x]);
                Lanes lowest = most;  // from the best predecessor, whose cost so far counts 0
                for (int j = 0; j < d; ++j) {
                    const Lanes change = magnitude(surface - load(&beside[j * padded + x]));
                    lowest = smaller(lowest, load(&cost_beside[j * padded + x]) + change);
                }
                store(&path[k * padded + x], lowest);
            }
        }
        for (int k = 0; k < d; ++k) {
            const float* cost = p.cost + p.at(k, y);
            float* out = path.data() + k * padded;
            float* total = sum + p.at(k, y);
            for (int x = 0; x < w; ++x) {
                out[x] += cost[x];
                total[x] += out[x];
            }
        }
    }
}

void transpose(const float* in, int rows, int columns, float* out) {
    constexpr int kBlock = 16;
    for (int r0 = 0; r0 < rows; r0 += kBlock)
        for (int c0 = 0; c0 < columns; c0 += kBlock)
            for (int c = c0; c < std::min(c0 + kBlock, columns); ++c)
                for (int r = r0; r < std::min(r0 + kBlock, rows); ++r)
                    out[static_cast<std::size_t>(c) * rows + r] = in[static_cast<std::size_t>(r) * columns + c];
}

// The candidate with the lowest mean path cost (D, P), and how much worse the best one is that lies `apart` from it.
void select(const float* total, const float* surfaces, int count, std::size_t pixels, float apart, std::int32_t* best,
            float* gap) {
    std::vector<float> lowest(total, total + pixels), chosen(surfaces, surfaces + pixels);
    std::fill_n(best, pixels, 0);
    std::fill_n(gap, pixels, 1.0f);
    for (int k = 1; k < count; ++k) {
        const float *cost = total + k * pixels, *surface = surfaces + k * pixels;
        for (std::size_t i = 0; i < pixels; ++i) {
            const bool better = cost[i] < lowest[i];
            lowest[i] = better ? cost[i] : lowest[i];
            chosen[i] = better ? surface[i] : chosen[i];
            best[i] = better ? k : best[i];
        }
    }
    for (int k = 0; k < count; ++k) {
        const float *cost = total + k * pixels, *surface = surfaces + k * pixels;
        for (std::size_t i = 0; i < pixels; ++i) {
            const float worse = std::fabs(surface[i] - chosen[i]) > apart ? cost[i] - lowest[i] : 1.0f;
            gap[i] = std::min(gap[i], worse);
        }
    }
}

}  // namespace

void choose_surface(const float* cost, const float* surfaces, int count, int height, int width, const float* image,
                    const ChooseOptions& o, std::int32_t* best, float* gap) {
    const std::size_t pixels = static_cast<std::size_t>(height) * width, volume = pixels * count;
    std::vector<float> upright_cost(volume), cost_t(volume), surfaces_t(volume), image_t(pixels);
    for (int y = 0; y < height; ++y)  // (H, D, W) -> (D, H, W)
        for (int k = 0; k < count; ++k)
            std::copy_n(cost + (static_cast<std::size_t>(y) * count + k) * width, width,
                        upright_cost.data() + k * pixels + static_cast<std::size_t>(y) * width);
    for (int k = 0; k < count; ++k) {
        transpose(upright_cost.data() + k * pixels, height, width, cost_t.data() + k * pixels);
        transpose(surfaces + k * pixels, height, width, surfaces_t.data() + k * pixels);
    }
    transpose(image, height, width, image_t.data());
    const Candidates upright{upright_cost.data(), surfaces, image, count, height, width};
    const Candidates sideways{cost_t.data(), surfaces_t.data(), image_t.data(), count, width, height};

    // Each sum is filled by one thread in a fixed order: the result does not depend on timing.
    std::vector<float> down(volume, 0.0f), up(volume, 0.0f), right(volume, 0.0f), left(volume, 0.0f);
    const auto add_paths = [&](int job) {
        if (job < 2) {
            for (int dx : {0, 1, -1}) add_path(upright, dx, job == 1, o, job == 0 ? down.data() : up.data());
        } else {
            add_path(sideways, 0, job == 3, o, job == 2 ? right.data() : left.data());
        }
    };
    Caught caught;
#pragma omp parallel for schedule(dynamic, 1) num_threads(o.threads)
    for (int job = 0; job < 4; ++job) caught([&] { add_paths(job); });
    caught.rethrow();
    const float share = 1.0f / 8.0f;
    std::vector<float> horizontal(pixels);
    for (int k = 0; k < count; ++k) {
        const std::size_t at = k * pixels;
        for (std::size_t i = 0; i < pixels; ++i) right[at + i] += left[at + i];
        transpose(right.data() + at, width, height, horizontal.data());
        for (std::size_t i = 0; i < pixels; ++i)
            down[at + i] = (down[at + i] + up[at + i] + horizontal[i]) * share;
    }
    select(down.data(), surfaces, count, pixels, o.apart, best, gap);
}

}  // namespace mvs
