// Python binding of the scene renderer: see mvsgs_core/scene/renderer.py for what the arrays mean.
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "bindings.hpp"
#include "scene.hpp"

using namespace bindings;
using nb::literals::operator""_a;

namespace {

using scene::Scene;
using Floats = Array<float, nb::ndim<1>>;
using Points = Array<float, nb::shape<-1, 3>>;
using Corners = Array<float, nb::shape<-1, 3, 3>>;
using Coordinates = Array<float, nb::shape<-1, 3, 2>>;
using Indices = Array<int32_t, nb::ndim<1>>;
using Texture = Array<uint8_t, nb::shape<-1, -1, 3>>;
using Sizes = Array<int32_t, nb::shape<-1, 2>>;
using Matrix = Array<double, nb::shape<4, 4>>;
using Rects = Array<float, nb::shape<-1, 4, 3>>;

scene::Vec3 vector_at(const float* p) { return {p[0], p[1], p[2]}; }
scene::Color color_at(const float* p) { return scene::Color{p[0], p[1], p[2], 0}; }

scene::Pose pose_of(const Matrix& m) {
    scene::Pose pose;
    const double* p = m.data();
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) pose.r[3 * i + j] = static_cast<float>(p[4 * i + j]);
    pose.t = {static_cast<float>(p[3]), static_cast<float>(p[7]), static_cast<float>(p[11])};
    return pose;
}

std::unique_ptr<Scene> make(const Corners& corners, const Coordinates& coordinates, const Indices& patch_of,
                            const std::vector<Texture>& textures, const Sizes& light_sizes, const Floats& gloss,
                            const Floats& sky) {
    const size_t n = corners.shape(0), patches = textures.size();
    if (coordinates.shape(0) != n || patch_of.shape(0) != n) throw std::invalid_argument("one triangle, one entry");
    if (light_sizes.shape(0) != patches || gloss.shape(0) != patches) throw std::invalid_argument("one patch, one entry");
    if (sky.shape(0) != 16) throw std::invalid_argument("sky: horizon, zenith, below, to_sun, sun (3 each), sun_radius");
    scene::Surfaces surfaces;
    for (size_t i = 0; i < patches; ++i) {
        const Texture& t = textures[i];
        const int32_t* size = light_sizes.data() + 2 * i;
        if (t.size() == 0 || size[0] < 1 || size[1] < 1) throw std::invalid_argument("empty texture or light map");
        surfaces.add_patch(t.data(), static_cast<int>(t.shape(0)), static_cast<int>(t.shape(1)), size[0], size[1],
                           gloss.data()[i]);
    }
    std::vector<scene::Corners> triangles;
    for (size_t i = 0; i < n; ++i) {
        const float *p = corners.data() + 9 * i, *uv = coordinates.data() + 6 * i;
        const int32_t patch = patch_of.data()[i];
        if (patch < 0 || static_cast<size_t>(patch) >= patches) throw std::invalid_argument("patch out of range");
        for (int k = 0; k < 9; ++k)
            if (!std::isfinite(p[k])) throw std::invalid_argument("a corner is not finite");
        const scene::Vec3 a = vector_at(p), ab = vector_at(p + 3) - a, ac = vector_at(p + 6) - a;
        const scene::Vec3 normal = cross(ab, ac);
        const float area = length(normal);
        const float uv_area = std::fabs((uv[2] - uv[0]) * (uv[5] - uv[1]) - (uv[4] - uv[0]) * (uv[3] - uv[1]));
        const auto& t = textures[patch];
        const float texels = uv_area * static_cast<float>(t.shape(0)) * static_cast<float>(t.shape(1));
        triangles.push_back({a, ab, ac});
        surfaces.triangles.push_back({scene::normalized(normal), {uv[0], uv[2], uv[4]}, {uv[1], uv[3], uv[5]},
                                      std::sqrt(texels / std::max(area, 1e-20f)), patch});
    }
    const float* s = sky.data();
    const scene::Sky outside{color_at(s), color_at(s + 3), color_at(s + 6), normalized(vector_at(s + 9)), s[15],
                             color_at(s + 12)};
    return std::make_unique<Scene>(std::move(surfaces), triangles, outside);
}

nb::tuple render(const Scene& self, const Matrix& world_from_cam, double fx, double fy, double cx, double cy,
                 int height, int width, float gloss, const Floats& gloss_light, const Scene* mover,
                 const Matrix& mover_from_world, int threads, bool wants_color, bool wants_depth) {
    if (height < 1 || width < 1 || !(fx > 0) || !(fy > 0)) throw std::invalid_argument("size and focal length must be positive");
    if (gloss_light.shape(0) != 3) throw std::invalid_argument("gloss_light: (3,)");
    const scene::Camera camera{pose_of(world_from_cam), static_cast<float>(fx), static_cast<float>(fy),
                               static_cast<float>(cx), static_cast<float>(cy), height, width};
    const scene::Pose mover_pose = pose_of(mover_from_world);
    const size_t h = static_cast<size_t>(height), w = static_cast<size_t>(width);
    auto color = wants_color ? allocate<float>({h, w, 3}) : allocate<float>({0, 0, 3});
    auto depth = wants_depth ? allocate<float>({h, w}) : allocate<float>({0, 0});
    {
        nb::gil_scoped_release release;
        self.render(camera, gloss, vector_at(gloss_light.data()), mover, mover_pose, thread_count(threads),
                    wants_color ? color.data() : nullptr, wants_depth ? depth.data() : nullptr);
    }
    return nb::make_tuple(color, depth);
}

Result<float> direct_light(const Scene& self, const Points& points, const Points& normals, const Rects& lights,
                           int rays, uint64_t seed, int threads) {
    if (normals.shape(0) != points.shape(0)) throw std::invalid_argument("one point, one normal");
    std::vector<scene::RectLight> rects;
    for (size_t i = 0; i < lights.shape(0); ++i) {
        const float* p = lights.data() + 12 * i;
        rects.push_back({vector_at(p), vector_at(p + 3), vector_at(p + 6), color_at(p + 9)});
    }
    auto result = allocate<float>({points.shape(0), 3});
    nb::gil_scoped_release release;
    self.direct_light(points.data(), normals.data(), points.shape(0), rects, rays, seed, thread_count(threads),
                      result.data());
    return result;
}

Result<float> bounced_light(const Scene& self, const Points& points, const Points& normals, int rays, uint64_t seed,
                            int threads) {
    if (normals.shape(0) != points.shape(0)) throw std::invalid_argument("one point, one normal");
    auto result = allocate<float>({points.shape(0), 3});
    nb::gil_scoped_release release;
    self.bounced_light(points.data(), normals.data(), points.shape(0), rays, seed, thread_count(threads),
                       result.data());
    return result;
}

void set_light(Scene& self, const Points& light) {
    if (light.shape(0) != self.surfaces.light_texels()) throw std::invalid_argument("one light texel, one entry");
    for (size_t i = 0; i < light.shape(0); ++i) self.surfaces.light()[i] = color_at(light.data() + 3 * i);
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    nb::class_<Scene>(m, "Scene")
        .def(nb::new_(&make), "corners"_a, "coordinates"_a, "patch_of"_a, "textures"_a, "light_sizes"_a, "gloss"_a, "sky"_a)
        .def("render", &render, "world_from_cam"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a, "height"_a, "width"_a, "gloss"_a,
             "gloss_light"_a, "mover"_a.none(), "mover_from_world"_a, "threads"_a = 0, "wants_color"_a = true,
             "wants_depth"_a = true)
        .def("direct_light", &direct_light, "points"_a, "normals"_a, "lights"_a, "rays"_a, "seed"_a, "threads"_a = 0)
        .def("bounced_light", &bounced_light, "points"_a, "normals"_a, "rays"_a, "seed"_a, "threads"_a = 0)
        .def("set_light", &set_light, "light"_a);
}
