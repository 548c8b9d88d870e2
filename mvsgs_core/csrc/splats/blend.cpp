// Front-to-back blending, tile by tile: splats outside, the 4x4 blocks that a splat's ellipse touches inside, so that a
// splat's parameters stay in registers and blocks which are full drop out.
#include <omp.h>

#include "splats/tile.hpp"

namespace splats {
namespace {

struct Block {
    Lanes transmittance, red, green, blue, depth;
};
using Pixels = Block[16];

template <bool Exact, bool Weights>
int64_t blend_tile(Frame& frame, const Tile& tile, Pixels& pixels) {
    uint32_t open = 0;  // blocks with a pixel that is not full
    for (int block = 0; block < 16; ++block) {
        pixels[block] = {BlockSpan(tile, block).inside(), Lanes{}, Lanes{}, Lanes{}, Lanes{}};
        open |= uint32_t(any(at_least(pixels[block].transmittance, kMinTransmittance))) << block;
    }
    int64_t evaluated = 0;
    uint32_t index = tile.begin;
    for (; index < tile.end && open; ++index) {
        Pair& pair = frame.pairs[index];
        uint32_t blocks = pair.blocks & open, hit = 0;
        const ScreenSplat& s = frame.splats[pair.splat];
        if (index + 8 < tile.end) __builtin_prefetch(&frame.splats[frame.pairs[index + 8].splat]);
        const Placed placed(s, tile);
        Lanes weight_sum{}, weight_max{};
        for (; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            Lanes u, v, log2_m, power;
            placed.at(s, block, u, v);
            const Lanes exponent = log2_alpha<Exact>(s, u, v, log2_m, power);
            const Lanes before = pixels[block].transmittance;
            const Mask counted = at_least(exponent, kLog2MinAlpha) & at_least(before, kMinTransmittance);
            evaluated += kLanes;
            hit |= uint32_t(any(counted)) << block;
            const Lanes weight = where(counted, before * minimum(exp2_of_negative(exponent), all(kMaxAlpha)));
            const Lanes after = before - weight;
            pixels[block].transmittance = after;
            pixels[block].red += s.red * weight;
            pixels[block].green += s.green * weight;
            pixels[block].blue += s.blue * weight;
            pixels[block].depth += s.depth * weight;
            if (!any(at_least(after, kMinTransmittance))) [[unlikely]] open &= ~(1u << block);
            if constexpr (Weights) {
                weight_sum += weight;
                weight_max = maximum(weight_max, weight);
            }
        }
        pair.blocks = uint16_t(hit);
        if constexpr (Weights) {
            frame.weight_slots[2 * size_t(pair.slot)] = sum(weight_sum);
            frame.weight_slots[2 * size_t(pair.slot) + 1] = largest(weight_max);
        }
    }
    for (; index < tile.end; ++index) {
        Pair& pair = frame.pairs[index];
        pair.blocks = 0;
        if constexpr (Weights)
            frame.weight_slots[2 * size_t(pair.slot)] = frame.weight_slots[2 * size_t(pair.slot) + 1] = 0.0f;
    }
    return evaluated;
}

void write(const Frame& frame, const Tile& tile, Pixels& pixels, float* color, float* depth, float* opacity) {
    for (int block = 0; block < 16; ++block) {
        Block& b = pixels[block];
        const Lanes left = b.transmittance, covered = 1.0f - left;
        b.red += left * frame.background[0];
        b.green += left * frame.background[1];
        b.blue += left * frame.background[2];
        b.depth = b.depth / maximum(covered, all(kTiny));  // 0 / tiny where nothing is seen
        alignas(64) float sums[5][kLanes];
        store(b.red, sums[0]);
        store(b.green, sums[1]);
        store(b.blue, sums[2]);
        store(b.depth, sums[3]);
        store(covered, sums[4]);
        const BlockSpan span(tile, block);
        for (int dy = 0; dy < span.rows; ++dy) {
            const size_t first = size_t(span.y + dy) * frame.camera.width + span.x;
            for (int dx = 0; dx < span.columns; ++dx) {
                const int lane = 4 * dy + dx;
                for (int c = 0; c < 3; ++c) color[3 * (first + dx) + c] = sums[c][lane];
                depth[first + dx] = sums[3][lane];
                opacity[first + dx] = sums[4][lane];
            }
        }
    }
}

template <bool Exact, bool Weights>
void blend_all(Frame& frame, float* color, float* depth, float* opacity, int threads) {
    const int tiles = frame.tiles_x * frame.tiles_y;
    int64_t evaluated = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) reduction(+ : evaluated)
    for (int index = 0; index < tiles; ++index) {
        const Tile tile(frame, index);
        Pixels pixels;
        evaluated += blend_tile<Exact, Weights>(frame, tile, pixels);
        write(frame, tile, pixels, color, depth, opacity);
    }
    frame.exponentials = evaluated;
}

}  // namespace

void blend(Frame& frame, bool weights, float* color, float* depth, float* opacity, int threads) {
    if (weights) frame.weight_slots.resize(2 * size_t(frame.pair_count));
    auto* chosen = frame.exact ? (weights ? blend_all<true, true> : blend_all<true, false>)
                               : (weights ? blend_all<false, true> : blend_all<false, false>);
    chosen(frame, color, depth, opacity, threads);
}

}  // namespace splats
