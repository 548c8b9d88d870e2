// What the benchmark of the rasterizer compares with: 3D Gaussian Splatting's algorithm in plain loops. Lists by tile
// from 3-sigma boxes, each pixel walks its tile's list; backward from the last splat to the first, sums by atomic additions, down to the
// gradients on the image (mean, inverse covariance, opacity, color); the projection's backward pass is not in it.
#include "bench/bench.hpp"

#include <omp.h>

#include <chrono>

#include "bench/plain_projection.hpp"

namespace splats {
namespace {

struct Flat {
    float u, v, depth, a, b, c;  // inverse covariance
    float opacity, half_beta, color[3];
    int first_x, last_x, first_y, last_y;  // tiles
};

struct Scene {
    std::vector<Flat> splats;
    std::vector<std::vector<int>> tiles;
    int tiles_x, tiles_y;
};

float kernel(const Flat& s, float dx, float dy, bool exact, float& m) {
    m = s.a * dx * dx + 2 * s.b * dx * dy + s.c * dy * dy;
    return std::exp(-0.5f * (exact ? std::pow(larger(m, kCenterM), s.half_beta) : m));
}

void bin_plainly(const Camera& camera, const Parameters& p, Scene& scene, int threads) {
    scene.splats.assign(size_t(p.count), Flat{});
    scene.tiles_x = (camera.width + kTile - 1) / kTile;
    scene.tiles_y = (camera.height + kTile - 1) / kTile;
    scene.tiles.assign(size_t(scene.tiles_x) * scene.tiles_y, {});
#pragma omp parallel for num_threads(threads)
    for (int64_t i = 0; i < p.count; ++i) {
        Flat& s = scene.splats[i];
        PlainProjection r;
        s.last_x = -1;
        if (!project_plainly(camera, p, i, r)) continue;
        shade_plainly(p, i, r, s.color);
        s.u = r.u;
        s.v = r.v;
        s.depth = r.z;
        s.a = r.yy / r.determinant;
        s.b = -r.xy / r.determinant;
        s.c = r.xx / r.determinant;
        s.opacity = r.opacity;
        s.half_beta = 0.5f * r.beta;
        const float half = 0.5f * (r.xx + r.yy);
        float reach = 9.0f;
        if (p.exact) reach = std::pow(2.0f * std::log(255.0f * s.opacity), 2.0f / r.beta);  // 3 sigma would be wrong
        const float spread = std::sqrt(larger(half * half - r.determinant, 0.0f));
        const float radius = std::ceil(std::sqrt(smaller(reach, 1e6f) * (half + spread)));
        s.first_x = std::max(0, int(std::floor((s.u - radius) / kTile)));
        s.last_x = std::min(scene.tiles_x - 1, int(std::floor((s.u + radius) / kTile)));
        s.first_y = std::max(0, int(std::floor((s.v - radius) / kTile)));
        s.last_y = std::min(scene.tiles_y - 1, int(std::floor((s.v + radius) / kTile)));
    }
    for (int64_t i = 0; i < p.count; ++i) {
        const Flat& s = scene.splats[i];
        for (int y = s.first_y; y <= s.last_y && s.last_x >= 0; ++y)
            for (int x = s.first_x; x <= s.last_x; ++x) scene.tiles[size_t(y) * scene.tiles_x + x].push_back(int(i));
    }
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (size_t t = 0; t < scene.tiles.size(); ++t)
        std::stable_sort(scene.tiles[t].begin(), scene.tiles[t].end(),
                         [&](int a, int b) { return scene.splats[a].depth < scene.splats[b].depth; });
}

double seconds(std::chrono::steady_clock::time_point since) {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - since).count();
}

void add(float& sum, float value) {
#pragma omp atomic
    sum += value;
}

}  // namespace

BaselineSeconds baseline(const Camera& camera, const Parameters& p, float* color, const float* color_gradient,
                         float* image_gradient, int threads) {
    static Scene scene;
    static std::vector<float> left;
    static std::vector<int> used;
    const size_t pixels = size_t(camera.width) * camera.height;
    left.resize(pixels);
    used.resize(pixels);
    BaselineSeconds result;
    auto start = std::chrono::steady_clock::now();
    bin_plainly(camera, p, scene, threads);
    const int tile_count = int(scene.tiles.size());
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int t = 0; t < tile_count; ++t) {
        const std::vector<int>& list = scene.tiles[t];
        const int x0 = t % scene.tiles_x * kTile, y0 = t / scene.tiles_x * kTile;
        for (int y = y0; y < std::min(y0 + kTile, camera.height); ++y) {
            for (int x = x0; x < std::min(x0 + kTile, camera.width); ++x) {
                float transmittance = 1.0f, sum[3] = {}, m;
                int k = 0;
                for (; k < int(list.size()) && transmittance >= kMinTransmittance; ++k) {
                    const Flat& s = scene.splats[list[k]];
                    const float alpha = smaller(s.opacity * kernel(s, x - s.u, y - s.v, p.exact, m), kMaxAlpha);
                    if (alpha < 1.0f / 255.0f) continue;
                    for (int c = 0; c < 3; ++c) sum[c] += transmittance * alpha * s.color[c];
                    transmittance *= 1.0f - alpha;
                }
                const size_t at = size_t(y) * camera.width + x;
                for (int c = 0; c < 3; ++c) color[3 * at + c] = sum[c];
                left[at] = transmittance;
                used[at] = k;
            }
        }
    }
    result.forward = seconds(start);
    start = std::chrono::steady_clock::now();
    std::fill(image_gradient, image_gradient + 9 * p.count, 0.0f);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int t = 0; t < tile_count; ++t) {
        const std::vector<int>& list = scene.tiles[t];
        const int x0 = t % scene.tiles_x * kTile, y0 = t / scene.tiles_x * kTile;
        for (int y = y0; y < std::min(y0 + kTile, camera.height); ++y) {
            for (int x = x0; x < std::min(x0 + kTile, camera.width); ++x) {
                const size_t at = size_t(y) * camera.width + x;
                float transmittance = left[at], behind = 0.0f, m;
                for (int k = used[at] - 1; k >= 0; --k) {
                    const Flat& s = scene.splats[list[k]];
                    const float dx = x - s.u, dy = y - s.v, shape = kernel(s, dx, dy, p.exact, m);
                    const float alpha = smaller(s.opacity * shape, kMaxAlpha);
                    if (alpha < 1.0f / 255.0f) continue;
                    transmittance /= 1.0f - alpha;
                    float q = 0.0f, *g = image_gradient + 9 * size_t(list[k]);
                    for (int c = 0; c < 3; ++c) {
                        q += s.color[c] * color_gradient[3 * at + c];
                        add(g[c], transmittance * alpha * color_gradient[3 * at + c]);
                    }
                    const float on_alpha = transmittance * q - behind / (1.0f - alpha);
                    behind += transmittance * alpha * q;
                    if (s.opacity * shape > kMaxAlpha) continue;
                    add(g[3], on_alpha * shape);
                    float on_m = -0.5f * on_alpha * alpha;
                    if (p.exact) on_m *= s.half_beta * std::pow(larger(m, kCenterM), s.half_beta - 1.0f);
                    add(g[4], -2 * on_m * (s.a * dx + s.b * dy));
                    add(g[5], -2 * on_m * (s.b * dx + s.c * dy));
                    add(g[6], on_m * dx * dx);
                    add(g[7], on_m * dx * dy);
                    add(g[8], on_m * dy * dy);
                }
            }
        }
    }
    result.backward = seconds(start);
    return result;
}

}  // namespace splats
