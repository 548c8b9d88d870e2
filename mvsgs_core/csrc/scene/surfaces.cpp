#pragma GCC optimize("O3")  // the binding library asks for small code; these loops want lanes
#include "surfaces.hpp"

#include <algorithm>
#include <array>
#include <cstring>

namespace scene {

namespace {

typedef uint8_t Bytes __attribute__((vector_size(4)));
typedef int32_t Whole __attribute__((vector_size(16)));

float decode(float srgb) { return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f); }
float encode(float x) { return x <= 0.0031308f ? 12.92f * x : 1.055f * std::pow(x, 1 / 2.4f) - 0.055f; }

constexpr int FINE = 8;  // entries of the decoding table per 8-bit level
std::array<float, 255 * FINE + 2> decode_table() {
    std::array<float, 255 * FINE + 2> table;
    for (size_t i = 0; i < table.size(); ++i) table[i] = decode(static_cast<float>(i) / (255.0f * FINE));
    return table;
}
std::array<uint8_t, 4097> encode_table() {  // indexed by the square root of the linear value: fine where sRGB is steep
    std::array<uint8_t, 4097> table;
    for (size_t i = 0; i < table.size(); ++i) {
        const float root = static_cast<float>(i) / 4096.0f;
        table[i] = static_cast<uint8_t>(std::lround(255.0f * encode(root * root)));
    }
    return table;
}
const auto DECODE = decode_table();
const auto ENCODE = encode_table();

Color unpack(uint32_t packed) {
    Bytes bytes;
    std::memcpy(&bytes, &packed, 4);
    return __builtin_convertvector(__builtin_convertvector(bytes, Whole), Color);  // in two steps: no scalar ones
}

uint32_t pack(Color linear) {
    uint32_t packed = 0;
    for (int c = 0; c < 3; ++c) {
        const float root = std::sqrt(std::clamp(linear[c], 0.0f, 1.0f));
        packed |= static_cast<uint32_t>(ENCODE[static_cast<size_t>(4096.0f * root + 0.5f)]) << (8 * c);
    }
    return packed;
}

struct Bilinear {
    int x0, x1, y0, y1;
    float fx, fy;
    Bilinear(float u, float v, int width, int height) {
        const float x = std::clamp(u * static_cast<float>(width) - 0.5f, 0.0f, static_cast<float>(width - 1));
        const float y = std::clamp(v * static_cast<float>(height) - 0.5f, 0.0f, static_cast<float>(height - 1));
        x0 = static_cast<int>(x);
        y0 = static_cast<int>(y);
        x1 = std::min(x0 + 1, width - 1);
        y1 = std::min(y0 + 1, height - 1);
        fx = x - static_cast<float>(x0);
        fy = y - static_cast<float>(y0);
    }
    Color mix(Color a, Color b, Color c, Color d) const {
        const Color top = a + fx * (b - a), bottom = c + fx * (d - c);
        return top + fy * (bottom - top);
    }
};

}  // namespace

Color to_linear(Color srgb) {
    const Color i = srgb * static_cast<float>(FINE) + 0.5f;
    return Color{DECODE[static_cast<size_t>(i[0])], DECODE[static_cast<size_t>(i[1])], DECODE[static_cast<size_t>(i[2])], 0};
}

void Surfaces::add_patch(const uint8_t* rgb, int height, int width, int light_height, int light_width, float gloss) {
    Patch patch{height, width, light_height, light_width, gloss};
    patch.offsets[0] = pool_.size();
    patch.levels = 1;
    for (int i = 0; i < height * width; ++i)
        pool_.push_back(rgb[3 * i] | (rgb[3 * i + 1] << 8) | (static_cast<uint32_t>(rgb[3 * i + 2]) << 16));
    int h = height, w = width;
    while ((h > 1 || w > 1) && patch.levels < 16) {
        const int h2 = std::max(1, h / 2), w2 = std::max(1, w / 2);
        const size_t from = patch.offsets[patch.levels - 1], to = pool_.size();
        pool_.resize(to + static_cast<size_t>(h2) * w2);
        for (int y = 0; y < h2; ++y)
            for (int x = 0; x < w2; ++x) {
                // Average of all texels below, three of them in a direction where the size is odd at the end.
                Color sum{};
                const int y_end = (y + 1) * h / h2, x_end = (x + 1) * w / w2;
                for (int i = y * h / h2; i < y_end; ++i)
                    for (int j = x * w / w2; j < x_end; ++j) sum += to_linear(unpack(pool_[from + static_cast<size_t>(i) * w + j]));
                const int n = (y_end - y * h / h2) * (x_end - x * w / w2);
                pool_[to + static_cast<size_t>(y) * w2 + x] = pack(sum / static_cast<float>(n));
            }
        patch.offsets[patch.levels++] = to;
        h = h2;
        w = w2;
    }
    patch.mean_albedo = to_linear(unpack(pool_.back()));
    patch.light_offset = light_.size();
    light_.resize(light_.size() + static_cast<size_t>(light_height) * light_width, Color{1, 1, 1, 0});
    patches.push_back(patch);
}

Color Surfaces::texel(const Patch& patch, int level, float u, float v) const {
    const int w = std::max(1, patch.width >> level), h = std::max(1, patch.height >> level);
    const uint32_t* map = pool_.data() + patch.offsets[level];
    const Bilinear at(u, v, w, h);
    const uint32_t *row0 = map + static_cast<size_t>(at.y0) * w, *row1 = map + static_cast<size_t>(at.y1) * w;
    return at.mix(unpack(row0[at.x0]), unpack(row0[at.x1]), unpack(row1[at.x0]), unpack(row1[at.x1]));
}

Color Surfaces::albedo(const Patch& patch, float u, float v, float footprint) const {
    if (!(footprint > 1.0f)) return to_linear(texel(patch, 0, u, v));
    const float level = std::min(0.5f * std::log2(footprint), static_cast<float>(patch.levels - 1));
    const int below = static_cast<int>(level), above = std::min(below + 1, patch.levels - 1);
    const Color fine = texel(patch, below, u, v), coarse = texel(patch, above, u, v);
    return to_linear(fine + (level - static_cast<float>(below)) * (coarse - fine));
}

Color Surfaces::light_at(const Patch& patch, float u, float v) const {
    const Color* map = light_.data() + patch.light_offset;
    const int w = patch.light_width;
    const Bilinear at(u, v, w, patch.light_height);
    return at.mix(map[at.y0 * w + at.x0], map[at.y0 * w + at.x1], map[at.y1 * w + at.x0], map[at.y1 * w + at.x1]);
}

}  // namespace scene
