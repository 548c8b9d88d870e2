// The photometric loss of a photograph as it came, bytes, against a render as the rasterizer made it: what the camera
// does to the colors is done on the way in and undone for the gradient on the way out, row by row.
#include <omp.h>

#include <array>
#include <vector>

#include "rasterizer/frame.hpp"
#include "rasterizer/photometric.hpp"

namespace splats {
namespace {

struct Levels {
    std::array<float, 256> value;
    Levels() {
        for (int i = 0; i < 256; ++i) value[i] = float(i / 255.0);
    }
};
const Levels kLevels;

// An exposure, most often of gains alone.
struct Affine {
    float matrix[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, offset[3] = {0, 0, 0};
    bool gains = true, identity = true;
    explicit Affine(const float* given) {
        if (!given) return;
        identity = false;
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) {
                matrix[i][j] = given[4 * i + j];
                gains &= i == j || matrix[i][j] == 0.0f;
            }
            offset[i] = given[4 * i + 3];
        }
    }
};

// The factor at each of a row's values.
void spread(const float* factor, int width, float* __restrict out) {
    for (int column = 0; column < width; ++column)
        out[3 * column] = out[3 * column + 1] = out[3 * column + 2] = factor[column];
}

// image = A color + b.
void expose(const Affine& affine, const float* __restrict color, int width, float* __restrict image) {
    const auto& m = affine.matrix;
    const auto& b = affine.offset;
    if (affine.gains) {
        for (int i = 0; i < width; ++i)
            for (int c = 0; c < 3; ++c) image[3 * i + c] = m[c][c] * color[3 * i + c] + b[c];
        return;
    }
    for (int i = 0; i < width; ++i) {
        const float red = color[3 * i], green = color[3 * i + 1], blue = color[3 * i + 2];
        for (int c = 0; c < 3; ++c) image[3 * i + c] = m[c][0] * red + m[c][1] * green + m[c][2] * blue + b[c];
    }
}

// In place, A^T of a row's gradients.
void expose_back(const Affine& affine, int width, float* gradient) {
    const auto& m = affine.matrix;
    if (affine.gains) {
        for (int i = 0; i < width; ++i)
            for (int c = 0; c < 3; ++c) gradient[3 * i + c] *= m[c][c];
        return;
    }
    for (int i = 0; i < width; ++i) {
        const float red = gradient[3 * i], green = gradient[3 * i + 1], blue = gradient[3 * i + 2];
        for (int c = 0; c < 3; ++c) gradient[3 * i + c] = m[0][c] * red + m[1][c] * green + m[2][c] * blue;
    }
}

// The photograph's row as a loss compares an image with it.
void read_target(const uint8_t* __restrict bytes, const float* __restrict image, const uint8_t* valid, bool clipped,
                 int width, float* __restrict target) {
    for (int i = 0; i < 3 * width; ++i) target[i] = kLevels.value[bytes[i]];
    if (clipped)
        for (int i = 0; i < 3 * width; ++i) {
            const bool beyond = (bytes[i] == 255 && image[i] > 1.0f) || (bytes[i] == 0 && image[i] < 0.0f);
            target[i] = beyond ? image[i] : target[i];
        }
    if (valid)
        for (int i = 0; i < width; ++i)
            for (int c = 0; c < 3; ++c) target[3 * i + c] = valid[i] ? target[3 * i + c] : image[3 * i + c];
}

}  // namespace

Photometric photograph_loss(const float* color, const uint8_t* photograph, const Formation& formation, int height,
                            int width, float l1_weight, float ssim_weight, float* gradient, int threads) {
    const size_t length = 3 * size_t(width);
    static thread_local Buffer<float> kept;  // as in photometric: fresh pages would cost as much
    float *target = kept.resize(size_t(height) * length), *image = gradient;
    const Affine affine(formation.exposure);
#pragma omp parallel num_threads(threads)
    {
        std::vector<float> factor(formation.factor ? length : 0);
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            const size_t at = size_t(row) * length, pixel = size_t(row) * width;
            expose(affine, color + at, width, image + at);
            if (formation.factor) {
                spread(formation.factor + pixel, width, factor.data());
                for (size_t i = 0; i < length; ++i) image[at + i] *= factor[i];
            }
            read_target(photograph + at, image + at, formation.valid ? formation.valid + pixel : nullptr,
                        formation.clipped, width, target + at);
        }
    }
    const Photometric result =
        photometric(image, target, nullptr, height, width, l1_weight, ssim_weight, gradient, threads);
    if (affine.identity && !formation.factor) return result;
#pragma omp parallel num_threads(threads)
    {
        std::vector<float> factor(formation.factor ? length : 0);
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            float* on = gradient + size_t(row) * length;
            if (formation.factor) {
                spread(formation.factor + size_t(row) * width, width, factor.data());
                for (size_t i = 0; i < length; ++i) on[i] *= factor[i];
            }
            expose_back(affine, width, on);
        }
    }
    return result;
}

}  // namespace splats
