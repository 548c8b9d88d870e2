// Adaptive matching windows of the reference: a window's pixels count by how similar they are to its center (Yoon and
// Kweon 2006). At the edge of an object the window then holds that object's pixels only, which keeps it from growing
// over what is behind it.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "mvs/exponential.hpp"
#include "mvs/mvs.hpp"

namespace mvs {

constexpr int kBand = kTileRows;  // rows that a thread handles at once: their window weights stay in its cache

inline int taps_of(int radius) { return (2 * radius + 1) * (2 * radius + 1); }

// The windows of a band of rows of the reference: normalized weights, mean and variance; and the rows themselves.
// Weights lie in blocks of kBlock columns, all taps of a block together: read in order, whatever the image's width.
struct Windows {
    static constexpr int kBlock = kTileColumns;
    int radius, width, blocks;
    int y0 = 0, height = 0;  // the first row of the band, and the reference's
    std::vector<float> weight;          // [row][block][tap][column of the block]
    std::vector<float> gray;            // [row, `radius` more on both sides][column, as many more]; 0 outside the image
    std::vector<float> mean, variance;  // [row][x]; the variance includes the noise

    Windows(int width_, int radius_)
        : radius(radius_), width(width_), blocks((width_ + kBlock - 1) / kBlock),
          weight(static_cast<std::size_t>(kBand) * blocks * taps_of(radius_) * kBlock),
          gray(static_cast<std::size_t>(kBand + 2 * radius_) * stride()),
          mean(static_cast<std::size_t>(kBand) * blocks * kBlock), variance(mean.size()),
          line_(static_cast<std::size_t>(taps_of(radius_)) * blocks * kBlock), total_(width_), square_(width_) {}

    std::size_t stride() const { return static_cast<std::size_t>(blocks) * kBlock + 2 * radius; }
    const float* weights(int row, int block) const {
        return weight.data() + (static_cast<std::size_t>(row) * blocks + block) * taps_of(radius) * kBlock;
    }
    // Row y0 + row, which may be outside the band by `radius`, at column 0.
    const float* gray_row(int row) const { return gray.data() + (row + radius) * stride() + radius; }
    const float* mean_row(int row) const { return mean.data() + static_cast<std::size_t>(row) * blocks * kBlock; }
    const float* variance_row(int row) const { return variance.data() + (mean_row(row) - mean.data()); }

    void prepare(const float* image, int rows, int begin, int end, float contrast, float noise) {
        y0 = begin;
        height = rows;
        std::fill(gray.begin(), gray.end(), 0.0f);
        for (int y = std::max(y0 - radius, 0); y < std::min(end + radius, height); ++y)
            std::copy_n(image + static_cast<std::size_t>(y) * width, width,
                        gray.data() + (y - y0 + radius) * stride() + radius);
        for (int y = y0; y < end; ++y) prepare_row(image, y, y - y0, -1.0f / contrast, noise);
    }

  private:
    std::vector<float> line_, total_, square_;  // of one row: [tap][x], [x], [x]

    void prepare_row(const float* image, int y, int row, float sharpness, float noise) {
        const int side = 2 * radius + 1, taps = side * side, padded = blocks * kBlock;
        const float spread = -0.5f / static_cast<float>((radius + 1) * (radius + 1));
        const float* center = image + static_cast<std::size_t>(y) * width;
        float *total = total_.data(), *square = square_.data();
        float* mu = mean.data() + static_cast<std::size_t>(row) * padded;
        float* var = variance.data() + static_cast<std::size_t>(row) * padded;
        std::fill(line_.begin(), line_.end(), 0.0f);
        std::fill_n(total, width, 0.0f);
        std::fill_n(square, width, 0.0f);
        std::fill_n(mu, padded, 0.0f);
        for (int dy = std::max(-radius, -y); dy <= std::min(radius, height - 1 - y); ++dy) {
            for (int dx = -radius; dx <= radius; ++dx) {
                float* w = line_.data() + static_cast<std::size_t>((dy + radius) * side + dx + radius) * padded;
                const float* other = image + static_cast<std::size_t>(y + dy) * width + dx;
                const float distance = std::exp(spread * static_cast<float>(dx * dx + dy * dy));
                const int from = std::max(0, -dx), to = std::min(width, width - dx);
#pragma omp simd
                for (int x = from; x < to; ++x) {
                    const float here = distance * exponential(sharpness * std::fabs(other[x] - center[x]));
                    w[x] = here;
                    total[x] += here;
                    mu[x] += here * other[x];
                    square[x] += here * other[x] * other[x];
                }
            }
        }
        for (int x = 0; x < width; ++x) {
            total[x] = 1.0f / total[x];
            mu[x] *= total[x];
            var[x] = std::max(square[x] * total[x] - mu[x] * mu[x], 0.0f) + noise;
        }
        for (int i = 0; i < taps; ++i)
            for (int x = 0; x < width; ++x) line_[static_cast<std::size_t>(i) * padded + x] *= total[x];
        float* out = weight.data() + static_cast<std::size_t>(row) * blocks * taps * kBlock;
        for (int block = 0; block < blocks; ++block)
            for (int i = 0; i < taps; ++i, out += kBlock)
                std::copy_n(line_.data() + static_cast<std::size_t>(i) * padded + block * kBlock, kBlock, out);
    }
};

}  // namespace mvs
