// Agreement of depth maps: geometric consistency, and fusion by support and free-space violation.
#include <algorithm>
#include <cmath>

#include "fusion/fusion.hpp"
#include "mvs/exponential.hpp"

namespace fusion {

using mvs::exponential;

namespace {

struct Projected {
    float x, y, depth;
    bool front;
};

// A pixel (u, v) with depth z, seen by the other camera.
inline Projected project(const Warp& t, float u, float v, float z) {
    const float w = 1.0f / z;
    const float xs = t.m[0] * u + t.m[1] * v + t.m[2] + w * t.b[0];
    const float ys = t.m[3] * u + t.m[4] * v + t.m[5] + w * t.b[1];
    const float zs = t.m[6] * u + t.m[7] * v + t.m[8] + w * t.b[2];
    const bool front = zs > 1e-6f;
    const float inv = 1.0f / (front ? zs : 1.0f);
    return {xs * inv, ys * inv, zs * z, front};
}

// Depth at the pixel nearest to (x, y); 0 outside. Nearest: a mix across an edge is on neither surface.
inline int nearest(float x, float y, int height, int width) {
    if (!(x > -0.5f && y > -0.5f && x < static_cast<float>(width) - 0.5f && y < static_cast<float>(height) - 0.5f))
        return -1;
    const int ix = std::min(static_cast<int>(x + 0.5f), width - 1), iy = std::min(static_cast<int>(y + 0.5f), height - 1);
    return iy * width + ix;
}

}  // namespace

void parallax(const DepthMaps& maps, int threads, float* moved) {
    const int height = maps.height, width = maps.width;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            const std::size_t i = static_cast<std::size_t>(y) * width + x;
            const float z = maps.depth[i], u = static_cast<float>(x), v = static_cast<float>(y);
            float squares = 0.0f;
            for (int n = 0; z > 0.0f && n < maps.views; ++n) {
                const Projected p = project(maps.warps[n], u, v, z);
                if (!p.front || nearest(p.x, p.y, maps.neighbor_height, maps.neighbor_width) < 0) continue;
                const float* b = maps.warps[n].b;
                const float dx = (b[0] - p.x * b[2]) / p.depth, dy = (b[1] - p.y * b[2]) / p.depth;
                squares += dx * dx + dy * dy;
            }
            moved[i] = std::sqrt(squares);
        }
    }
}

void consistent_views(const DepthMaps& maps, const float* relative, int threads, std::uint8_t* count) {
    const int height = maps.height, width = maps.width, views = maps.views;
    const int nh = maps.neighbor_height, nw = maps.neighbor_width;
    const float *depth = maps.depth, *neighbor_depths = maps.neighbors;
    const Warp* warps = maps.warps;
    const std::size_t stride = static_cast<std::size_t>(nh) * nw;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            const std::size_t i = static_cast<std::size_t>(y) * width + x;
            const float z = depth[i], u = static_cast<float>(x), v = static_cast<float>(y);
            int agreeing = 0;
            if (z > 0.0f) {
                for (int n = 0; n < views; ++n) {
                    const Projected p = project(warps[n], u, v, z);
                    const int at = p.front ? nearest(p.x, p.y, nh, nw) : -1;
                    if (at < 0) continue;
                    const float found = neighbor_depths[n * stride + at];
                    if (!(found > 0.0f)) continue;
                    agreeing += std::fabs(found - p.depth) < relative[i] * std::max(found, p.depth);
                }
            }
            count[i] = static_cast<std::uint8_t>(agreeing);
        }
    }
}

void splat_depth(const float* neighbor_depth, const float* neighbor_confidence, int nh, int nw, const Warp& back,
                 float min_neighbor_confidence, int height, int width, float* splatted) {
    std::fill_n(splatted, static_cast<std::size_t>(height) * width, 0.0f);
    for (int y = 0; y < nh; ++y) {
        for (int x = 0; x < nw; ++x) {
            const std::size_t i = static_cast<std::size_t>(y) * nw + x;
            if (!(neighbor_depth[i] > 0.0f && neighbor_confidence[i] >= min_neighbor_confidence)) continue;
            const Projected p = project(back, static_cast<float>(x), static_cast<float>(y), neighbor_depth[i]);
            const int at = p.front ? nearest(p.x, p.y, height, width) : -1;
            if (at < 0) continue;
            float& slot = splatted[at];
            if (slot == 0.0f || p.depth < slot) slot = p.depth;
        }
    }
}

void fuse_depth(const DepthMaps& maps, const float* confidence, const float* neighbor_confidences,
                const float* splatted, const float* sigma, const FuseOptions& o, float* fused, float* support,
                float* violation, float* own) {
    const int height = maps.height, width = maps.width, views = maps.views;
    const int nh = maps.neighbor_height, nw = maps.neighbor_width;
    const float *depth = maps.depth, *neighbor_depths = maps.neighbors;
    const Warp* warps = maps.warps;
    const std::size_t stride = static_cast<std::size_t>(nh) * nw, pixels = static_cast<std::size_t>(height) * width;
#pragma omp parallel for schedule(dynamic, 8) num_threads(o.threads)
    for (int y = 0; y < height; ++y) {
        for (int x = 0; x < width; ++x) {
            const std::size_t i = static_cast<std::size_t>(y) * width + x;
            const float z_own = depth[i], c_own = z_own > 0.0f ? confidence[i] : 0.0f;
            const float u = static_cast<float>(x), v = static_cast<float>(y);
            const float tolerance = 3.0f * sigma[i], sharpness = -0.5f / (sigma[i] * sigma[i]);
            float best_score = -1e9f, best_depth = 0.0f, best_support = 0.0f, best_violation = 0.0f, best_own = 0.0f;
            for (int candidate = -1; candidate < views; ++candidate) {
                const float z = candidate < 0 ? z_own : splatted[candidate * pixels + i];
                if (!(z > 0.0f)) continue;
                float weights = 0.0f, inverse = 0.0f, for_it = 0.0f, against = 0.0f, from_own = 0.0f;
                if (z_own > 0.0f) {
                    const float difference = (z_own - z) / z;
                    from_own = c_own * exponential(sharpness * difference * difference);
                    weights = from_own;
                    inverse = from_own / z_own;
                    if (std::fabs(difference) > tolerance) against += c_own;
                }
                for (int n = 0; n < views; ++n) {
                    const Projected p = project(warps[n], u, v, z);
                    const int at = p.front ? nearest(p.x, p.y, nh, nw) : -1;
                    if (at < 0) continue;
                    const float found = neighbor_depths[n * stride + at], c = neighbor_confidences[n * stride + at];
                    if (!(found > 0.0f && c >= o.min_neighbor_confidence)) continue;
                    const float difference = (found - p.depth) / p.depth;
                    const float weight = c * exponential(sharpness * difference * difference);
                    for_it += weight;
                    weights += weight;
                    inverse += weight / (z * (1.0f + difference));
                    if (difference > tolerance) against += c;  // the neighbor sees through the point
                }
                const float score = for_it + from_own - o.violation * against;
                if (score > best_score) {
                    best_score = score;
                    best_depth = inverse > 0.0f ? weights / inverse : z;
                    best_support = for_it;
                    best_violation = against;
                    best_own = from_own;
                }
            }
            fused[i] = best_depth;
            support[i] = best_support;
            violation[i] = best_violation;
            own[i] = best_own;
        }
    }
}

}  // namespace fusion
