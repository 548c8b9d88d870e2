// Which blocks of which tiles a splat's ellipse touches: rows of blocks side by side in the lanes, and then a window of
// 4x4 tiles at a time.
#pragma once

#include <climits>

#include "rasterizer/tile.hpp"

namespace splats {

constexpr float kMargin = 0.01f;  // px, so that rounding never cuts a pixel off the ellipse

// The ellipses alpha = 1/255 of sixteen splats: where one ends on a row is shear dy +- sqrt(reach - pitch_v^2 dy^2) /
// pitch_u. Limits are of the box on the image, px.
struct Footprints {
    alignas(64) float center_x[kLanes], center_y[kLanes], shear[kLanes];
    alignas(64) float half_height[kLanes];
    alignas(64) float turn[kLanes];  // dy at which the ellipse reaches furthest right
    alignas(64) float inverse_pitch_u[kLanes], pitch_v_squared[kLanes], reach[kLanes];
    alignas(64) float left[kLanes], right[kLanes], top[kLanes], bottom[kLanes];
};

class TileWalk {
   public:
    TileWalk(const Frame& frame, PairList& pairs)
        : width_(frame.camera.width), tiles_x_(frame.tiles_x), pairs_(pairs) {
        constexpr Ints kRow = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
        window_ = kColumn + kRow * (Ints{} + tiles_x_);
    }

    // Appends the pairs of the splat in lane i.
    SPLATS_INLINE_MEMBER void visit(const Footprints& f, int i) {
        if (!(f.top[i] <= f.bottom[i] && f.left[i] <= f.right[i])) return;
        // rows of blocks, from the first of a tile
        const int first_row = int(f.top[i]) / kTile * 4, last_row = int(f.bottom[i]) / 4;
        const int first_tile = int(f.left[i]) / kTile, last_tile = int(f.right[i]) / kTile;
        for (int start = first_row; start <= last_row; start += kLanes) {
            Ints first, last;
            reach(f, i, start, first, last);
            if (last_tile - first_tile < 4)
                append_window(start / 4, first_tile, first, last);
            else
                append_windows(start / 4, first, last);
        }
    }

   private:
    static constexpr int kFar = 1 << 23;  // beyond every column of pixels
    static constexpr Lanes kRows = {0, 4, 8, 12, 16, 20, 24, 28, 32, 36, 40, 44, 48, 52, 56, 60};
    static constexpr Ints kColumn = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};

    SPLATS_INLINE_MEMBER static Lanes within(const Lanes& value, const Lanes& low, const Lanes& high) {
        return minimum(maximum(value, low), high);
    }

    // First and last columns of blocks that the ellipse touches in sixteen rows of blocks.
    SPLATS_INLINE_MEMBER void reach(const Footprints& f, int i, int start, Ints& first, Ints& last) const {
        const float half_height = f.half_height[i];
        const Lanes rows = float(4 * start) + kRows;
        const Lanes low = rows - f.center_y[i], high = low + 3.0f;
        const Lanes height = all(half_height), turn = all(f.turn[i]);
        const Lanes right_y = within(within(turn, low, high), -height, height);
        const Lanes left_y = within(within(-turn, low, high), -height, height);
        const auto half_span = [&](const Lanes& dy) {
            return root(maximum(f.reach[i] - f.pitch_v_squared[i] * dy * dy, Lanes{})) * f.inverse_pitch_u[i];
        };
        Lanes right = f.center_x[i] + kMargin + f.shear[i] * right_y + half_span(right_y);
        Lanes left = f.center_x[i] - kMargin + f.shear[i] * left_y - half_span(left_y);
        right = minimum(right, all(float(width_ - 1)));
        left = minimum(maximum(left, Lanes{}), all(float(width_)));
        const Ints empty = (low > half_height + kMargin) | (high < -half_height - kMargin) |
                           (rows < f.top[i] - 3.0f) | (rows > f.bottom[i]) | (right < left);
        // pixel columns: left is rounded up, right down; neither is negative
        const Ints cut = toward_zero(left);
        const Ints from = cut - (left > to_floats(cut)), to = toward_zero(maximum(right, Lanes{}));
        const Ints none = empty | (to < from);
        first = choose(none, Ints{} + kFar, from >> 2);
        last = choose(none, Ints{} - 1, to >> 2);
    }

    // All windows of four rows of tiles that the ellipse touches.
    void append_windows(int tile_row, const Ints& first, const Ints& last) {
        alignas(64) int32_t from[kLanes], to[kLanes];
        store(first, from);
        store(last, to);
        const int begin = *std::min_element(from, from + kLanes) / 4, end = *std::max_element(to, to + kLanes) / 4;
        for (int tile = begin; tile <= end; tile += 4) append_window(tile_row, tile, first, last);
    }

    // The window's tiles are the lanes, row by row; every row of its blocks gives sixteen bits.
    SPLATS_INLINE_MEMBER void append_window(int tile_row, int tile, const Ints& first, const Ints& last) {
        const Ints begin = smaller(larger(first - 4 * tile, Ints{}), Ints{} + 16);
        const Ints end = smaller(larger(last - 4 * tile + 1, Ints{}), Ints{} + 16);
        const Ints columns = (((Ints{} + 1) << end) - 1) & -((Ints{} + 1) << begin);
        const Ints shift = kColumn << 2;
        Ints blocks = spread<0>(columns) >> shift & 15;
        blocks = blocks | (spread<1>(columns) >> shift & 15) << 4;
        blocks = blocks | (spread<2>(columns) >> shift & 15) << 8;
        blocks = blocks | (spread<3>(columns) >> shift & 15) << 12;
        const Ints tiles = window_ + (tile_row * tiles_x_ + tile);
        if (pairs_.count + kLanes > pairs_.tiles.size()) {
            const size_t room = 2 * pairs_.tiles.size() + 4096;
            if (room > UINT32_MAX) throw std::bad_alloc();  // more than a chunk's count can say
            pairs_.blocks.resize(room);  // first: tiles tell what there is room for
            pairs_.tiles.resize(room);
        }
        pairs_.count += append(blocks, tiles, pairs_.blocks.data() + pairs_.count, pairs_.tiles.data() + pairs_.count);
    }

    int width_, tiles_x_;
    PairList& pairs_;
    Ints window_;
};

}  // namespace splats
