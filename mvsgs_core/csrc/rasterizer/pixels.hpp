// Blocks of pixels from and to images in memory.
#pragma once

#include "rasterizer/tile.hpp"

namespace splats {

template <class Value>
struct Images {
    Value *color, *depth, *opacity;  // (H, W, 3), (H, W), (H, W)
};

// What blending sums up in a block.
struct PixelSums {
    Lanes transmittance{}, red{}, green{}, blue{}, depth{};
};

// The block's values of an image; 0 off the image and where there is none.
SPLATS_INLINE Lanes read_plane(const Frame& frame, const BlockSpan& span, const float* plane) {
    if (!plane) return Lanes{};
    alignas(64) float values[kLanes] = {};
    const float* first = plane + size_t(span.y) * frame.camera.width + span.x;
    for (int dy = 0; dy < span.rows; ++dy, first += frame.camera.width)
        for (int dx = 0; dx < span.columns; ++dx) values[4 * dy + dx] = first[dx];
    return lanes(values);
}

SPLATS_INLINE void read_color(const Frame& frame, const BlockSpan& span, const float* color, Lanes (&rgb)[3]) {
    const size_t stride = 3 * size_t(frame.camera.width);
    const float* first = color + span.y * stride + 3 * size_t(span.x);
    if (span.whole()) return gather_color(first, stride, rgb);
    alignas(64) float values[3][kLanes] = {};
    for (int dy = 0; dy < span.rows; ++dy, first += stride)
        for (int i = 0; i < 3 * span.columns; ++i) values[i % 3][4 * dy + i / 3] = first[i];
    for (int c = 0; c < 3; ++c) rgb[c] = lanes(values[c]);
}

SPLATS_INLINE void write_plane(const Frame& frame, const BlockSpan& span, Lanes value, float* plane) {
    alignas(64) float values[kLanes];
    store(value, values);
    float* first = plane + size_t(span.y) * frame.camera.width + span.x;
    for (int dy = 0; dy < span.rows; ++dy, first += frame.camera.width) {
        if (span.columns == 4)
            std::memcpy(first, values + 4 * dy, 4 * sizeof(float));
        else
            for (int dx = 0; dx < span.columns; ++dx) first[dx] = values[4 * dy + dx];
    }
}

SPLATS_INLINE void write_color(const Frame& frame, const BlockSpan& span, const Lanes (&rgb)[3], float* color) {
    const size_t stride = 3 * size_t(frame.camera.width);
    float* first = color + span.y * stride + 3 * size_t(span.x);
    if (span.whole()) return scatter_color(rgb, first, stride);
    alignas(64) float values[3][kLanes];
    for (int c = 0; c < 3; ++c) store(rgb[c], values[c]);
    for (int dy = 0; dy < span.rows; ++dy, first += stride)
        for (int i = 0; i < 3 * span.columns; ++i) first[i] = values[i % 3][4 * dy + i / 3];
}

// The background goes behind; depth becomes the expected one.
SPLATS_INLINE void write_pixels(const Frame& frame, const BlockSpan& span, const PixelSums& sums,
                                const Images<float>& images) {
    const Lanes left = sums.transmittance, covered = 1.0f - left;
    const Lanes rgb[3] = {sums.red + left * frame.background[0], sums.green + left * frame.background[1],
                          sums.blue + left * frame.background[2]};
    write_color(frame, span, rgb, images.color);
    write_plane(frame, span, sums.depth / maximum(covered, all(kTiny)), images.depth);  // 0 / tiny: nothing is seen
    write_plane(frame, span, covered, images.opacity);
}

}  // namespace splats
