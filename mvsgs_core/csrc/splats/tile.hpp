// What the forward and the backward pass share inside a tile: 4x4 blocks of pixels, and a splat's density on a block.
#pragma once

#include "splats/frame.hpp"

namespace splats {

constexpr float kTiny = 1e-30f;
constexpr Lanes kLaneX = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
constexpr Lanes kLaneY = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

// A block's first pixel in its tile; loads, for a conversion from integer would wait for its register's last value.
alignas(64) constexpr float kBlockX[16] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
alignas(64) constexpr float kBlockY[16] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};

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
};

// A splat as a tile sees it: u and v of the tile's first pixel, and how they grow inside a block.
struct Placed {
    float dx, dy;         // tile's first pixel - mean
    Lanes inner_u, inner_v;

    SPLATS_INLINE_MEMBER Placed(const ScreenSplat& s, const Tile& tile)
        : dx((float(tile.x) - s.whole_x) - s.part_x), dy((float(tile.y) - s.whole_y) - s.part_y),
          inner_u(s.pitch_u * (kLaneX - s.shear * kLaneY)), inner_v(s.pitch_v * kLaneY) {}

    SPLATS_INLINE_MEMBER void at(const ScreenSplat& s, int block, Lanes& u, Lanes& v) const {
        const float x = dx + kBlockX[block], y = dy + kBlockY[block];
        u = inner_u + s.pitch_u * (x - s.shear * y);
        v = inner_v + s.pitch_v * y;
    }
};

// log2 of the unclamped alpha; for the exact density also log2(m) and power = m^(beta/2), with m limited from below.
template <bool Exact>
SPLATS_INLINE Lanes log2_alpha(const ScreenSplat& s, Lanes u, Lanes v, Lanes& log2_m, Lanes& power) {
    if constexpr (Exact) {
        log2_m = log2_of_positive(maximum(u * u + v * v, all(kCenterM)));
        power = exp2_limited(s.half_beta * log2_m);
        return s.log2_opacity - kHalfLog2e * power;
    } else {
        return s.log2_opacity - u * u - v * v;
    }
}

}  // namespace splats
