// The benchmark's plain-loop rasterizer and the machine's peaks that it is measured against.
#pragma once

#include "rasterizer/frame.hpp"

namespace splats {

struct BaselineSeconds {
    double forward = 0.0, backward = 0.0;
};

// color: (H, W, 3); image_gradient: (N, 9), of color, opacity, mean and inverse covariance.
BaselineSeconds baseline(const Camera& camera, const Parameters& parameters, float* color, const float* color_gradient,
                         float* image_gradient, int threads);

// Kernel values per second: u and v to alpha, in registers, all threads together.
double peak_kernel_values(bool exact, int threads);

// Multiplications with addition per second, single precision, in registers, all threads together.
double peak_products(int threads);

// Bytes read and written per second when a tile's 4x4 blocks are updated in the first-level cache.
double peak_tile_bytes(int threads);

// Bytes read and written per second by a copy in main memory.
double peak_memory_bytes(int threads);

}  // namespace splats
