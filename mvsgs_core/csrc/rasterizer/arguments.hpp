// What Python hands over, as the kernels take it. Arrays come in as they lie in memory; nothing is copied.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <omp.h>

#include "rasterizer/frame.hpp"

namespace splats {

namespace nb = nanobind;

template <class T, class... Shape>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;
using In = Array<const float>;
using Out = Array<float>;

inline Parameters parameters(const Frame& frame, In means, In log_scales, In quaternions, In opacity_logits, In sh, In betas) {
    return {means.data(), log_scales.data(), quaternions.data(), opacity_logits.data(), sh.data(), betas.data(),
            int64_t(means.shape(0)), int(sh.shape(1)), frame.degree, frame.exact, frame.antialiased};
}

inline int thread_count(int threads) { return std::max(1, threads > 0 ? threads : omp_get_max_threads()); }

using Intrinsics = std::tuple<float, float, float, float>;

inline Camera camera_of(Array<const double> pose, Intrinsics intrinsics, float near, int width, int height) {
    Camera camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[i][j] = pose.data()[4 * i + j];
        camera.center[i] = pose.data()[4 * i + 3];
    }
    std::tie(camera.fx, camera.fy, camera.cx, camera.cy) = intrinsics;
    camera.width = width;
    camera.height = height;
    camera.near = near;
    const float margin_x = kClampMargin * 0.5f * width / camera.fx, margin_y = kClampMargin * 0.5f * height / camera.fy;
    camera.slope_min[0] = -(camera.cx + 0.5f) / camera.fx - margin_x;
    camera.slope_max[0] = (width - 0.5f - camera.cx) / camera.fx + margin_x;
    camera.slope_min[1] = -(camera.cy + 0.5f) / camera.fy - margin_y;
    camera.slope_max[1] = (height - 0.5f - camera.cy) / camera.fy + margin_y;
    return camera;
}

}  // namespace splats
