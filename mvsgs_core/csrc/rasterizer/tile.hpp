// What the forward and the backward pass share inside a tile: 4x4 blocks of pixels, and a splat's kernel on a block.
#pragma once

#include "rasterizer/frame.hpp"

namespace splats {

constexpr float kTiny = 1e-30f;
constexpr int kBlocks = 16;  // of a tile
constexpr Lanes kLaneX = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr Lanes kLaneY = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

struct Tile {
    int x, y;          // of its first pixel
    int width, height; // pixels on the image, at most 16
    uint32_t begin, end;

    Tile(const Frame& frame, int index)
        : x(index % frame.tiles_x * kTile), y(index / frame.tiles_x * kTile),
          width(std::min(kTile, frame.camera.width - x)), height(std::min(kTile, frame.camera.height - y)),
          begin(frame.tile_begin[index]), end(frame.tile_begin[index + 1]) {}
};

// The pixels of a block that lie on the image.
struct BlockSpan {
    int x, y, columns, rows;

    SPLATS_INLINE_MEMBER BlockSpan(const Tile& tile, int block)
        : x(tile.x + 4 * (block & 3)), y(tile.y + 4 * (block >> 2)),
          columns(std::clamp(tile.width - 4 * (block & 3), 0, 4)), rows(std::clamp(tile.height - 4 * (block >> 2), 0, 4)) {}

    // 1 in the lanes on the image, 0 elsewhere.
    SPLATS_INLINE_MEMBER Lanes inside() const {
        return where(at_most(kLaneX, float(columns) - 0.5f) & at_most(kLaneY, float(rows) - 0.5f), all(1.0f));
    }
    SPLATS_INLINE_MEMBER bool whole() const { return columns == 4 && rows == 4; }
};

// Where the pixels of every block lie in their tile.
struct BlockPixels {
    Lanes x[4], y[4];  // by column and row of blocks

    SPLATS_INLINE_MEMBER BlockPixels() {
        for (int i = 0; i < 4; ++i) {
            x[i] = kLaneX + float(4 * i);
            y[i] = kLaneY + float(4 * i);
        }
    }
};

// A splat as a tile sees it, with x and y from the tile's first pixel: u = u0 + u_x x + u_y y, v = v0 + v_y y.
struct Placed {
    float u0, u_x, u_y, v0, v_y;
    float log2_opacity, half_beta;
    float red, green, blue, depth;

    Placed() = default;
    SPLATS_INLINE_MEMBER Placed(const ProjectedSplat& s, const Tile& tile)
        : u_x(s.pitch_u), u_y(-s.pitch_u * s.shear), v_y(s.pitch_v), log2_opacity(s.log2_opacity),
          half_beta(s.half_beta), red(s.red), green(s.green), blue(s.blue), depth(s.depth) {
        const float dx = (float(tile.x) - s.whole_x) - s.part_x, dy = (float(tile.y) - s.whole_y) - s.part_y;
        u0 = s.pitch_u * (dx - s.shear * dy);
        v0 = s.pitch_v * dy;
    }
    SPLATS_INLINE_MEMBER Lanes u(Lanes x, Lanes y) const { return (u0 + u_y * y) + u_x * x; }
    SPLATS_INLINE_MEMBER Lanes v(Lanes y) const { return v0 + v_y * y; }
};

// Kernel values of a group of splats, each on a block.
template <bool Exact, int Count>
struct KernelValues {
    using Wide = Group<Count>;

    Wide u, v;
    Wide m, log2_m, power;  // of the exact kernel: power = m^(beta/2), with m limited from below
    Wide alpha;             // before it is clamped; 0 where it is below 1/255

    // at(i): the splat of place i in the group; x(i), y(i): its pixels.
    template <class At, class X, class Y>
    SPLATS_INLINE_MEMBER KernelValues(At at, X x, Y y) {
        u = group<Count>([&](int i) { return at(i).u(x(i), y(i)); });
        v = group<Count>([&](int i) { return at(i).v(y(i)); });
        const Wide log2_opacity = group<Count>([&](int i) { return all(at(i).log2_opacity); });
        Wide exponent;
        if constexpr (Exact) {
            m = u * u + v * v;
            log2_m = log2_of_positive(maximum(m, Wide{} + kCenterM));
            power = exp2_limited(group<Count>([&](int i) { return all(at(i).half_beta); }) * log2_m);
            exponent = log2_opacity - kHalfLog2e * power;
        } else {
            exponent = log2_opacity - u * u - v * v;
        }
        alpha = where_at_least(exponent, kLog2MinAlpha, exp2_of_negative(exponent));
    }
};

}  // namespace splats
