// The matching cost of mvsgs_core/csrc/mvs/cost_volume.cpp as plain loops over whole images: same inputs, weights,
// samples and result, each array written once and read once; no tiles, no bands, whatever -O3 makes of it.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace {

void window_weights(const float* image, int height, int width, int radius, float contrast, float noise, float* weight,
                    float* mean, float* variance) {
    const int side = 2 * radius + 1;
    const std::size_t pixels = static_cast<std::size_t>(height) * width;
#pragma omp parallel for
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            const std::size_t at = static_cast<std::size_t>(y) * width + x;
            float total = 0.0f, sum = 0.0f, square = 0.0f;
            for (int dy = -radius; dy <= radius; ++dy)
                for (int dx = -radius; dx <= radius; ++dx) {
                    float w = 0.0f;
                    if (y + dy >= 0 && y + dy < height && x + dx >= 0 && x + dx < width) {
                        const float v = image[at + static_cast<std::ptrdiff_t>(dy) * width + dx];
                        w = std::exp(-0.5f * (dx * dx + dy * dy) / ((radius + 1) * (radius + 1)) -
                                     std::fabs(v - image[at]) / contrast);
                        total += w;
                        sum += w * v;
                        square += w * v * v;
                    }
                    weight[static_cast<std::size_t>((dy + radius) * side + dx + radius) * pixels + at] = w;
                }
            for (int tap = 0; tap < side * side; ++tap) weight[tap * pixels + at] /= total;
            mean[at] = sum / total;
            variance[at] = std::max(square / total - mean[at] * mean[at], 0.0f) + noise;
        }
}

}  // namespace

// cost (H, D, W) of hypotheses first + k step; see mvsgs_core/csrc/mvs/stereo.hpp.
extern "C" void plain_cost_volume(const float* reference, int height, int width, const float* neighbors,
                                  const float* warps, int views, const float* first, const float* step, int hypotheses,
                                  int radius, int best, float noise, float contrast, float* cost) {
    const int side = 2 * radius + 1;
    const std::size_t pixels = static_cast<std::size_t>(height) * width;
    std::vector<float> weight(pixels * side * side), mean(pixels), variance(pixels);
    window_weights(reference, height, width, radius, contrast, noise, weight.data(), mean.data(), variance.data());
    std::vector<float> sample(pixels), seen(pixels), each(pixels * views);
    for (int k = 0; k < hypotheses; ++k) {
        for (int n = 0; n < views; ++n) {
            const float* image = neighbors + n * pixels;
            const float *m = warps + 12 * n, *b = m + 9;
#pragma omp parallel for
            for (int y = 0; y < height; ++y)
                for (int x = 0; x < width; ++x) {
                    const std::size_t at = static_cast<std::size_t>(y) * width + x;
                    const float w = first[at] + k * step[at];
                    const float z = m[6] * x + m[7] * y + m[8] + w * b[2];
                    const float px = (m[0] * x + m[1] * y + m[2] + w * b[0]) / z;
                    const float py = (m[3] * x + m[4] * y + m[5] + w * b[1]) / z;
                    seen[at] = z > 1e-6f && w > 0 && px >= 0 && px <= width - 1 && py >= 0 && py <= height - 1;
                    const float qx = std::min(std::max(z > 1e-6f ? px : 0.0f, 0.0f), width - 1.0f);
                    const float qy = std::min(std::max(z > 1e-6f ? py : 0.0f, 0.0f), height - 1.0f);
                    const int ix = std::min(static_cast<int>(qx), width - 2);
                    const int iy = std::min(static_cast<int>(qy), height - 2);
                    const float* p = image + static_cast<std::size_t>(iy) * width + ix;
                    const float top = p[0] + (qx - ix) * (p[1] - p[0]);
                    const float bottom = p[width] + (qx - ix) * (p[width + 1] - p[width]);
                    sample[at] = top + (qy - iy) * (bottom - top);
                }
#pragma omp parallel for
            for (int y = 0; y < height; ++y)
                for (int x = 0; x < width; ++x) {
                    const std::size_t at = static_cast<std::size_t>(y) * width + x;
                    float sum = 0.0f, square = 0.0f, product = 0.0f;
                    for (int dy = std::max(-radius, -y); dy <= std::min(radius, height - 1 - y); ++dy)
                        for (int dx = std::max(-radius, -x); dx <= std::min(radius, width - 1 - x); ++dx) {
                            const std::ptrdiff_t there = at + static_cast<std::ptrdiff_t>(dy) * width + dx;
                            const float w = weight[((dy + radius) * side + dx + radius) * pixels + at];
                            sum += w * sample[there];
                            square += w * sample[there] * sample[there];
                            product += w * sample[there] * reference[there];
                        }
                    const float spread = std::max(square - sum * sum, 0.0f) + noise;
                    const float zncc = (product - mean[at] * sum) / std::sqrt(variance[at] * spread);
                    each[n * pixels + at] = seen[at] > 0 ? std::min(std::max(1.0f - zncc, 0.0f), 1.0f) : 1.0f;
                }
        }
#pragma omp parallel for
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const std::size_t at = static_cast<std::size_t>(y) * width + x;
                float sorted[16];
                for (int n = 0; n < views; ++n) sorted[n] = each[n * pixels + at];
                std::sort(sorted, sorted + views);
                float sum = 0.0f;
                for (int n = 0; n < best; ++n) sum += sorted[n];
                cost[(static_cast<std::size_t>(y) * hypotheses + k) * width + x] = sum / best;
            }
    }
}
