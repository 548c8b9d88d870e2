// Light that reaches surfaces: soft shadows from window, lamp and sun, and one diffuse bounce gathered over the hemisphere.
#pragma GCC optimize("O3")  // the binding library asks for small code; these loops want lanes
#include <algorithm>
#include <numbers>
#include <utility>

#include "scene.hpp"

namespace scene {

namespace {

constexpr float PI = std::numbers::pi_v<float>;

// SplitMix64: a stream per texel, so that the result does not depend on the number of threads.
struct Random {
    uint64_t state;
    float next() {
        uint64_t z = (state += 0x9E3779B97F4A7C15ull);
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
        return static_cast<float>((z ^ (z >> 31)) >> 40) * 0x1p-24f;
    }
};

struct Frame {
    Vec3 x, y, z;
    explicit Frame(Vec3 normal) : z(normal) {
        const Vec3 helper = std::fabs(normal.z) < 0.9f ? Vec3{0, 0, 1} : Vec3{1, 0, 0};
        x = normalized(cross(helper, normal));
        y = cross(normal, x);
    }
    Vec3 at(float a, float b, float c) const { return a * x + b * y + c * z; }
};

Vec3 read(const float* p) { return {p[0], p[1], p[2]}; }

void set(Packet& packet, int lane, Vec3 direction, float limit) {
    packet.dx[lane] = direction.x;
    packet.dy[lane] = direction.y;
    packet.dz[lane] = direction.z;
    packet.t[lane] = limit;
}

// Jittered point `i` of a grid of about `n` cells on the unit square.
struct Stratified {
    int columns, rows;
    explicit Stratified(int n)
        : columns(std::max(1, static_cast<int>(std::sqrt(static_cast<float>(n))))), rows(std::max(1, n / columns)) {}
    int count() const { return columns * rows; }
    void at(int i, Random& random, float& a, float& b) const {
        a = (static_cast<float>(i % columns) + random.next()) / static_cast<float>(columns);
        b = (static_cast<float>(i / columns) + random.next()) / static_cast<float>(rows);
    }
};

}  // namespace

void Scene::direct_light(const float* points, const float* normals, size_t n, const std::vector<RectLight>& lights,
                         int rays, uint64_t seed, int threads, float* result) const {
    const Stratified grid(rays);
    const bool sunny = sky.sun[0] + sky.sun[1] + sky.sun[2] > 0;
#pragma omp parallel for schedule(dynamic, 64) num_threads(threads)
    for (size_t i = 0; i < n; ++i) {
        const Vec3 normal = read(normals + 3 * i);
        Random random{seed ^ (0xD1B54A32D192ED03ull * (i + 1))};
        Packet packet;
        packet.origin = read(points + 3 * i);
        Color sum{};
        Color weight[LANES];
        auto flush = [&](int used) {
            for (int l = used; l < LANES; ++l) set(packet, l, {0, 0, 1}, 0.0f);
            bvh.nearest(packet, 0.0f);
            for (int l = 0; l < used; ++l)
                if (packet.triangle[l] < 0) sum += weight[l];
        };
        for (const RectLight& light : lights) {
            const Vec3 facing = cross(light.edge_u, light.edge_v);
            const float area = length(facing);
            if (dot(packet.origin - light.corner, facing) <= 0) continue;
            int used = 0;
            for (int k = 0; k < grid.count(); ++k) {
                float a, b;
                grid.at(k, random, a, b);
                const Vec3 d = light.corner + a * light.edge_u + b * light.edge_v - packet.origin;
                const float r2 = dot(d, d), cosine = dot(d, normal), emitted = -dot(d, facing) / area;
                if (cosine <= 0 || emitted <= 0) continue;
                // Stops short of the light, whose own surface would shadow it; the floor keeps near lights finite.
                set(packet, used, d, 0.995f);
                weight[used] = light.radiance * (cosine * emitted * area / (PI * std::max(r2 * r2, 0.01f)));
                if (++used == LANES) flush(std::exchange(used, 0));
            }
            if (used) flush(used);
        }
        sum /= static_cast<float>(grid.count());
        if (sunny && dot(normal, sky.to_sun) > 0) {
            const Color indoors = sum;
            sum = Color{};
            const Frame frame(sky.to_sun);
            for (int l = 0; l < LANES; ++l) {
                const float angle = 2 * PI * (static_cast<float>(l) + random.next()) / LANES;
                const float radius = sky.sun_radius * std::sqrt(random.next());
                const Vec3 d = frame.at(radius * std::cos(angle), radius * std::sin(angle), 1.0f);
                set(packet, l, d, 1e30f);
                weight[l] = sky.sun * (std::max(0.0f, dot(normal, sky.to_sun)) / PI);
            }
            flush(LANES);
            sum = indoors + sum / static_cast<float>(LANES);
        }
        for (int c = 0; c < 3; ++c) result[3 * i + c] = sum[c];
    }
}

void Scene::bounced_light(const float* points, const float* normals, size_t n, int rays, uint64_t seed, int threads,
                          float* result) const {
    const Stratified grid(rays);
#pragma omp parallel for schedule(dynamic, 64) num_threads(threads)
    for (size_t i = 0; i < n; ++i) {
        const Frame frame(read(normals + 3 * i));
        Random random{seed ^ (0x9E6C63D0876A9A47ull * (i + 1))};
        Packet packet;
        packet.origin = read(points + 3 * i);
        Color sum{};
        for (int k = 0; k < grid.count(); k += LANES) {
            const int used = std::min(LANES, grid.count() - k);
            for (int l = 0; l < LANES; ++l) {
                float a, b;
                grid.at(k + std::min(l, used - 1), random, a, b);
                const float radius = std::sqrt(a), angle = 2 * PI * b;  // cosine-weighted
                const Vec3 d = frame.at(radius * std::cos(angle), radius * std::sin(angle), std::sqrt(1 - a));
                set(packet, l, d, l < used ? 1e30f : 0.0f);
            }
            bvh.nearest(packet, 0.0f);
            for (int l = 0; l < used; ++l) {
                if (packet.triangle[l] < 0) {
                    sum += sky.at({packet.dx[l], packet.dy[l], packet.dz[l]});
                    continue;
                }
                const Triangle& hit = surfaces.triangles[packet.triangle[l]];
                const Patch& patch = surfaces.patches[hit.patch];
                const float b = packet.u[l], c = packet.v[l], a = 1.0f - b - c;
                const float u = a * hit.u[0] + b * hit.u[1] + c * hit.u[2];
                const float v = a * hit.v[0] + b * hit.v[1] + c * hit.v[2];
                sum += patch.mean_albedo * surfaces.light_at(patch, u, v);
            }
        }
        for (int c = 0; c < 3; ++c) result[3 * i + c] = sum[c] / static_cast<float>(grid.count());
    }
}

}  // namespace scene
