#pragma GCC optimize("O3")  // the binding library asks for small code; these loops want lanes
#include <algorithm>

#include "scene.hpp"

namespace scene {

namespace {

constexpr int TILE = 4;  // pixels: a tile's centers are one packet, each of its 2x2 blocks is another
// Rotated grid: no two samples share a row or a column, so that near-horizontal and near-vertical edges get 4 levels.
constexpr float SAMPLE_X[4] = {-0.125f, 0.375f, -0.375f, 0.125f};
constexpr float SAMPLE_Y[4] = {-0.375f, -0.125f, 0.125f, 0.375f};

void aim(Packet& packet, int lane, const Camera& camera, float px, float py) {
    const Vec3 d = camera.world_from_cam.rotate({(px - camera.cx) / camera.fx, (py - camera.cy) / camera.fy, 1.0f});
    packet.dx[lane] = d.x;
    packet.dy[lane] = d.y;
    packet.dz[lane] = d.z;
    packet.t[lane] = 1e30f;
}

// The same rays in the mover's frame, limited to what is nearer than the hits so far.
Packet moved(const Packet& packet, const Pose& mover_from_world) {
    Packet result = packet;
    result.origin = mover_from_world.apply(packet.origin);
    for (int l = 0; l < LANES; ++l) {
        const Vec3 d = mover_from_world.rotate({packet.dx[l], packet.dy[l], packet.dz[l]});
        result.dx[l] = d.x;
        result.dy[l] = d.y;
        result.dz[l] = d.z;
    }
    return result;
}

}  // namespace

Color Sky::at(Vec3 direction) const {
    const float up = direction.z / std::max(length(direction), 1e-12f);
    return up >= 0 ? horizon + std::sqrt(up) * (zenith - horizon) : below;
}

Color Scene::shade(const Packet& packet, int lane, float pixel_area, float gloss, Vec3 gloss_light) const {
    const Vec3 d{packet.dx[lane], packet.dy[lane], packet.dz[lane]};
    if (packet.triangle[lane] < 0) return sky.at(d);
    const Triangle& triangle = surfaces.triangles[packet.triangle[lane]];
    const Patch& patch = surfaces.patches[triangle.patch];
    const float b = packet.u[lane], c = packet.v[lane], a = 1.0f - b - c, t = packet.t[lane];
    const float u = a * triangle.u[0] + b * triangle.u[1] + c * triangle.u[2];
    const float v = a * triangle.v[0] + b * triangle.v[1] + c * triangle.v[2];
    // A pixel's share of the surface: z^2 / (fx fy |d . n|) with |d| the ray per unit of z.
    const float facing = std::max(std::fabs(dot(d, triangle.normal)), 1e-3f);
    const float footprint = t * t * pixel_area / facing * triangle.density * triangle.density;
    Color color = surfaces.albedo(patch, u, v, footprint) * surfaces.light_at(patch, u, v);
    if (gloss > 0 && patch.gloss > 0) {
        const Vec3 hit = packet.origin + t * d;
        const Vec3 mirrored = d - (2.0f * dot(d, triangle.normal)) * triangle.normal;
        const float aligned = dot(normalized(mirrored), normalized(gloss_light - hit));
        if (aligned > 0) color += gloss * patch.gloss * std::pow(aligned, 60.0f) * surfaces.light_at(patch, u, v);
    }
    return color;
}

void Scene::render(const Camera& camera, float gloss, Vec3 gloss_light, const Scene* mover, const Pose& mover_from_world,
                   int threads, float* color, float* depth) const {
    const int tiles_x = (camera.width + TILE - 1) / TILE, tiles_y = (camera.height + TILE - 1) / TILE;
    const float sample_area = 0.25f / (camera.fx * camera.fy);
#pragma omp parallel for schedule(dynamic, 2) num_threads(threads)
    for (int tile_y = 0; tile_y < tiles_y; ++tile_y) {
        Packet packet, other;
        packet.origin = camera.world_from_cam.t;
        auto cast = [&] {
            bvh.nearest(packet, 0.0f);
            if (mover) {
                other = moved(packet, mover_from_world);
                mover->bvh.nearest(other, 0.0f);
            }
        };
        for (int tile_x = 0; tile_x < tiles_x; ++tile_x) {
            const int left = tile_x * TILE, top = tile_y * TILE;
            if (depth) {
                for (int l = 0; l < LANES; ++l)
                    aim(packet, l, camera, static_cast<float>(left + l % TILE), static_cast<float>(top + l / TILE));
                cast();
                for (int l = 0; l < LANES; ++l) {
                    const int x = left + l % TILE, y = top + l / TILE;
                    if (x >= camera.width || y >= camera.height) continue;
                    const bool moving = mover && other.triangle[l] >= 0;
                    const float t = moving ? other.t[l] : packet.triangle[l] >= 0 ? packet.t[l] : 0.0f;
                    depth[static_cast<size_t>(y) * camera.width + x] = t;
                }
            }
            for (int block = 0; color && block < 4; ++block) {
                const int x0 = left + 2 * (block % 2), y0 = top + 2 * (block / 2);
                if (x0 >= camera.width || y0 >= camera.height) continue;
                for (int l = 0; l < LANES; ++l)
                    aim(packet, l, camera, static_cast<float>(x0 + (l / 4) % 2) + SAMPLE_X[l % 4],
                        static_cast<float>(y0 + l / 8) + SAMPLE_Y[l % 4]);
                cast();
                for (int pixel = 0; pixel < 4; ++pixel) {
                    const int x = x0 + pixel % 2, y = y0 + pixel / 2;
                    if (x >= camera.width || y >= camera.height) continue;
                    Color sum{};
                    for (int l = 4 * pixel; l < 4 * pixel + 4; ++l)
                        sum += mover && other.triangle[l] >= 0
                                   ? mover->shade(other, l, sample_area, gloss, mover_from_world.apply(gloss_light))
                                   : shade(packet, l, sample_area, gloss, gloss_light);
                    float* out = color + 3 * (static_cast<size_t>(y) * camera.width + x);
                    for (int c = 0; c < 3; ++c) out[c] = 0.25f * sum[c];
                }
            }
        }
    }
}

}  // namespace scene
