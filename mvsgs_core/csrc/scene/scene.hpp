// A scene of lit, textured triangles: rendered by ray casting, its light baked by ray casting too.
#pragma once
#include <memory>

#include "surfaces.hpp"

namespace scene {

struct Pose {  // x_to = rotation * x_from + translation, row-major
    float r[9];
    Vec3 t;
    Vec3 rotate(Vec3 d) const {
        return {r[0] * d.x + r[1] * d.y + r[2] * d.z, r[3] * d.x + r[4] * d.y + r[5] * d.z,
                r[6] * d.x + r[7] * d.y + r[8] * d.z};
    }
    Vec3 apply(Vec3 p) const { return rotate(p) + t; }
};

struct Camera {
    Pose world_from_cam;
    float fx, fy, cx, cy;  // pixels
    int height, width;
};

struct RectLight {  // a window or a lamp: shines to the side of cross(edge_u, edge_v)
    Vec3 corner, edge_u, edge_v;
    Color radiance;
};

struct Sky {  // what rays that hit nothing see, and what lights them
    Color horizon, zenith, below;
    Vec3 to_sun;  // unit
    float sun_radius;  // of its disk, radians
    Color sun;  // irradiance on a surface that faces it
    Color at(Vec3 direction) const;
};

class Scene {
public:
    Scene(Surfaces surfaces, const std::vector<Corners>& corners, Sky sky)
        : surfaces(std::move(surfaces)), bvh(corners), sky(sky) {}

    // Linear color (H, W, 3), anti-aliased with 4 rays a pixel, and z (H, W) at pixel centers, 0 where there is nothing.
    // `mover` is a second scene that stands at `mover_from_world`; its hits count where they are nearer. Of color and
    // depth, null is not wanted.
    void render(const Camera& camera, float gloss, Vec3 gloss_light, const Scene* mover, const Pose& mover_from_world,
                int threads, float* color, float* depth) const;

    // Irradiance / pi (N, 3) that reaches points straight from the lights and the sun.
    void direct_light(const float* points, const float* normals, size_t n, const std::vector<RectLight>& lights,
                      int rays, uint64_t seed, int threads, float* result) const;

    // Irradiance / pi (N, 3) from the sky and, after one bounce, from surfaces as they are lit now.
    void bounced_light(const float* points, const float* normals, size_t n, int rays, uint64_t seed, int threads,
                       float* result) const;

    Surfaces surfaces;
    Bvh bvh;
    Sky sky;

private:
    Color shade(const Packet& packet, int lane, float pixel_area, float gloss, Vec3 gloss_light) const;
};

}  // namespace scene
