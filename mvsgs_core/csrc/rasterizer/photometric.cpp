// L1 and SSIM between two images, and the gradient of their weighted sum, in one pass over the memory.
//
// SSIM as in Wang et al. 2004 with an 11x11 Gaussian window (sigma 1.5), zeros beyond the border. Images are (H, W, 3)
// with channels innermost, so a row is one run of 3 W floats, a horizontal tap is a shift by 3 and every loop below
// vectorizes. With a = G x, b = G y, p = G x^2, q = G y^2, r = G x y the gradient of the mean is
// G(dS/da) + 2 x G(dS/dp) + y G(dS/dr), the window being symmetric.
#include "rasterizer/photometric.hpp"

#include <omp.h>

#include <cmath>
#include <vector>

#include "rasterizer/frame.hpp"

namespace splats {
namespace {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1, kPad = 3 * kRadius;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float tap[kTaps];
    Window() {
        double total = 0, values[kTaps];
        for (int k = 0; k < kTaps; ++k) total += values[k] = std::exp(-(k - kRadius) * (k - kRadius) / (2 * 1.5 * 1.5));
        for (int k = 0; k < kTaps; ++k) tap[k] = float(values[k] / total);
    }
};
const Window kWindow;

// out[i] = sum over taps of in[i + 3 (k - 5)], `in` padded with zeros by kPad on both sides.
void horizontal(const float* __restrict in, float* __restrict out, int length) {
#pragma omp simd
    for (int i = 0; i < length; ++i) {
        float sum = 0.0f;
        for (int k = 0; k < kTaps; ++k) sum += kWindow.tap[k] * in[i + 3 * k];
        out[i] = sum;
    }
}

// Rows of `height` that the window around `row` covers, as taps [first, last).
void taps_inside(int row, int height, int& first, int& last) {
    first = std::max(0, kRadius - row);
    last = std::min(kTaps, height + kRadius - row);
}

// Moments of two images along the columns. Whole: all taps, a constant number of them, so that the loop unrolls.
template <bool Whole>
void vertical_moments(const float* __restrict x, const float* __restrict y, int length, int first, int last,
                      float* __restrict a, float* __restrict b, float* __restrict p, float* __restrict q,
                      float* __restrict r) {
#pragma omp simd
    for (int i = 0; i < length; ++i) {
        float sums[5] = {};
        for (int k = Whole ? 0 : first; k < (Whole ? kTaps : last); ++k) {
            const float u = x[k * length + i], v = y[k * length + i], w = kWindow.tap[k];
            const float wu = w * u, wv = w * v;
            sums[0] += wu;
            sums[1] += wv;
            sums[2] += wu * u;
            sums[3] += wv * v;
            sums[4] += wu * v;
        }
        a[i] = sums[0];
        b[i] = sums[1];
        p[i] = sums[2];
        q[i] = sums[3];
        r[i] = sums[4];
    }
}

template <bool Whole>
void vertical(const float* __restrict map, float* __restrict out, int length, int first, int last) {
#pragma omp simd
    for (int i = 0; i < length; ++i) {
        float sum = 0.0f;
        for (int k = Whole ? 0 : first; k < (Whole ? kTaps : last); ++k) sum += kWindow.tap[k] * map[k * length + i];
        out[i] = sum;
    }
}

struct Lines {
    std::vector<float> padded, filtered;
    int length;
    Lines(int count, int length) : padded(size_t(count) * (length + 2 * kPad)), filtered(size_t(count) * length), length(length) {}
    float* inner(int index) { return padded.data() + size_t(index) * (length + 2 * kPad) + kPad; }
    float* out(int index) { return filtered.data() + size_t(index) * length; }
    void filter(int count) {
        for (int k = 0; k < count; ++k) horizontal(inner(k) - kPad, out(k), length);
    }
};

// SSIM summed over a row; its derivatives by a, p and r go to on_a, on_p, on_r.
double similarity_row(Lines& lines, float* __restrict on_a, float* __restrict on_p, float* __restrict on_r) {
    const float *__restrict a = lines.out(0), *__restrict b = lines.out(1), *__restrict p = lines.out(2);
    const float *__restrict q = lines.out(3), *__restrict r = lines.out(4);
    float sum = 0.0f;
#pragma omp simd reduction(+ : sum)
    for (int i = 0; i < lines.length; ++i) {
        const float ab = a[i] * b[i], aa = a[i] * a[i], bb = b[i] * b[i];
        const float mean_top = 2 * ab + kC1, mean_bottom = aa + bb + kC1;
        const float top = 2 * (r[i] - ab) + kC2, bottom = (p[i] - aa) + (q[i] - bb) + kC2;
        const float inverse = 1.0f / (mean_bottom * bottom);
        const float s = mean_top * top * inverse;
        sum += s;
        on_p[i] = -s * mean_bottom * inverse;
        on_r[i] = 2 * mean_top * inverse;
        on_a[i] = 2 * (b[i] * (top - mean_top) * inverse - a[i] * s * (bottom - mean_bottom) * inverse);
    }
    return sum;
}

}  // namespace

Photometric photometric(const float* image, const float* target, const float* pixel_weight, int height, int width,
                        float l1_weight, float ssim_weight, float* gradient, int threads) {
    const int length = 3 * width;
    const size_t size = size_t(height) * length;
    static thread_local Buffer<float> partials;  // kept: fresh pages would cost as much as the sums
    float *on_a = partials.resize(3 * size), *on_p = on_a + size, *on_r = on_p + size;
    std::vector<double> row_l1(height), row_ssim(height);
#pragma omp parallel num_threads(threads)
    {
        Lines lines(5, length);
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            int first, last;
            taps_inside(row, height, first, last);
            float *__restrict a = lines.inner(0), *__restrict b = lines.inner(1), *__restrict p = lines.inner(2);
            float *__restrict q = lines.inner(3), *__restrict r = lines.inner(4);
            const float *x = image + (row - kRadius) * int64_t(length), *y = target + (row - kRadius) * int64_t(length);
            if (last - first == kTaps)
                vertical_moments<true>(x, y, length, 0, kTaps, a, b, p, q, r);
            else
                vertical_moments<false>(x, y, length, first, last, a, b, p, q, r);
            lines.filter(5);
            const size_t at = size_t(row) * length;
            row_ssim[row] = similarity_row(lines, on_a + at, on_p + at, on_r + at);
        }
    }
    const float mean = 1.0f / float(size), ssim_scale = -ssim_weight * mean;
#pragma omp parallel num_threads(threads)
    {
        Lines lines(3, length);
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            int first, last;
            taps_inside(row, height, first, last);
            const float* maps[3] = {on_a, on_p, on_r};
            for (int m = 0; m < 3; ++m) {
                const float* map = maps[m] + (row - kRadius) * int64_t(length);
                if (last - first == kTaps)
                    vertical<true>(map, lines.inner(m), length, 0, kTaps);
                else
                    vertical<false>(map, lines.inner(m), length, first, last);
            }
            lines.filter(3);
            const float *a = lines.out(0), *p = lines.out(1), *r = lines.out(2);
            const float *x = image + size_t(row) * length, *y = target + size_t(row) * length;
            float* out = gradient + size_t(row) * length;  // may be x
            float* __restrict weight = lines.inner(0);
            for (int column = 0; column < width; ++column) {
                const float extra = pixel_weight ? pixel_weight[size_t(row) * width + column] : 0.0f;
                weight[3 * column] = weight[3 * column + 1] = weight[3 * column + 2] = (l1_weight + extra) * mean;
            }
            float l1 = 0.0f;
#pragma omp simd reduction(+ : l1)
            for (int i = 0; i < length; ++i) {
                const float difference = x[i] - y[i];
                const float sign = difference > 0.0f ? 1.0f : difference < 0.0f ? -1.0f : 0.0f;
                l1 += weight[i] * difference * sign;
                out[i] = weight[i] * sign + ssim_scale * (a[i] + 2 * x[i] * p[i] + y[i] * r[i]);
            }
            row_l1[row] = l1;
        }
    }
    Photometric result;
    for (int row = 0; row < height; ++row) {
        result.l1 += row_l1[row];
        result.ssim += row_ssim[row];
    }
    result.ssim /= double(size);
    return result;
}

}  // namespace splats
