// What Python hands over, as the kernels take it. What is written into is never a copy.
#pragma once

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bindings.hpp"
#include "rasterizer/frame.hpp"

namespace splats {

using namespace bindings;

using In = Array<float>;
using Out = Written<float>;

// The fields of splats.py's Splats, in their order.
using SplatArrays = std::array<In, 6>;

inline Parameters parameters(const Frame& frame, const SplatArrays& splats) {
    const auto& [means, log_scales, quaternions, opacity_logits, sh, betas] = splats;
    return {means.data(), log_scales.data(), quaternions.data(), opacity_logits.data(), sh.data(), betas.data(),
            int64_t(means.shape(0)), int(sh.shape(1)), frame.degree, frame.exact, frame.antialiased};
}

// The data of an array, null for None.
inline const float* data_of(const std::optional<In>& array) { return array ? array->data() : nullptr; }

// A field of interface.py's RenderSettings.
template <class T>
T setting(nb::handle settings, const char* name) {
    return nb::cast<T>(settings.attr(name));
}

// pose: world_from_cam by rows, apart from the settings because it may carry a gradient.
inline Camera camera_of(nb::handle settings, Array<double> pose) {
    Camera camera;
    const auto [height, width] = setting<std::tuple<int, int>>(settings, "size");
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = pose.data()[4 * i + j];
        camera.center[i] = pose.data()[4 * i + 3];
    }
    std::tie(camera.fx, camera.fy, camera.cx, camera.cy) =
        setting<std::tuple<float, float, float, float>>(settings, "intrinsics");
    camera.width = width;
    camera.height = height;
    camera.near = setting<float>(settings, "near");
    camera.readout = setting<std::array<float, 6>>(settings, "readout");
    for (const float value : camera.readout) camera.rolling |= value != 0.0f;
    // In double: a compiler that may reorder float arithmetic would else round these limits by what surrounds them.
    const double fx = camera.fx, fy = camera.fy, cx = camera.cx, cy = camera.cy;
    const double margin_x = 0.5 * kClampMargin * width / fx, margin_y = 0.5 * kClampMargin * height / fy;
    camera.slope_min[0] = float(-(cx + 0.5) / fx - margin_x);
    camera.slope_max[0] = float((width - 0.5 - cx) / fx + margin_x);
    camera.slope_min[1] = float(-(cy + 0.5) / fy - margin_y);
    camera.slope_max[1] = float((height - 0.5 - cy) / fy + margin_y);
    return camera;
}

}  // namespace splats
