// An image split into rectangles, each worth one splat: what mapping/partition.py looks for, and says.
#pragma once

#include <cstdint>
#include <vector>

namespace partition {

constexpr int kLevels = 3;            // halvings of the largest rectangle along an axis
constexpr int kSide = 1 << kLevels;   // pixels of it; images are of whole ones

// Of an image of height x width pixels, all by rows.
struct Image {
    int64_t height, width;
    const float* colors;      // 3 a pixel
    const float* weight;      // of a pixel's squared error, 0 of one that does not count
    const float* left;        // error of a pixel without a splat
    const bool* taken;        // that can get one
    const bool* sure;         // whose depth is known
    const double* logarithm;  // of that depth, 0 of others
};

// Labels (height, width) of the pixels, -1 of those in no rectangle; returns rows and columns of each, one after the
// other. angle: of a pixel, radians; depth_noise: deviation of the logarithm that depth has anyway;
// price: of a splat.
std::vector<int64_t> split(const Image& image, double angle, double depth_noise, float price, int threads,
                           int64_t* labels);

}  // namespace partition
