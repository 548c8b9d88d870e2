// Front-to-back blending, tile by tile and in a tile block by block: the block's pixels stay in registers while the
// splats whose ellipse touches it pass by, a group of them at a time, until the block is full.
#include <omp.h>

#include "caught.hpp"
#include "rasterizer/pixels.hpp"
#include "rasterizer/tile.hpp"

namespace splats {
namespace {

constexpr uint32_t kAhead = 32;  // pairs whose splat is fetched early

// What a thread keeps of the tile at hand.
struct Workspace {
    std::vector<Placed> placed;         // of every pair; behind them one that is seen nowhere
    std::vector<uint16_t> blocks;       // of every pair: blocks that the ellipse touches and that aren't full before it
    std::vector<uint32_t> list;         // pairs that touch the block at hand
    std::vector<Lanes> weight_max;
    int64_t evaluated = 0, contributed = 0;

    void take(const Frame& frame, const Tile& tile, bool weights) {
        const uint32_t count = tile.end - tile.begin, last = uint32_t(frame.pair_count) - 1;
        if (placed.size() < count + 1) {
            const size_t room = size_t(count) + count / 2 + 64;
            blocks.resize(room + kLanes);
            list.resize(room + kLanes);
            placed.resize(room);  // last: it tells what there is room for
        }
        for (uint32_t i = 0; i < count; ++i) {
            __builtin_prefetch(&frame.splats[frame.pairs[std::min(tile.begin + i + kAhead, last)].splat]);
            const Pair& pair = frame.pairs[tile.begin + i];
            placed[i] = Placed(frame.splats[pair.splat], tile);
            blocks[i] = pair.blocks;
        }
        placed[count] = Placed{};
        placed[count].log2_opacity = 2.0f * kLog2MinAlpha;
        if (!weights) return;
        weight_max.assign(count + 1, Lanes{});
    }

    // Lists the pairs that touch `block`, filled up to whole groups; returns how many touch it.
    uint32_t find(uint32_t count, int block) {
        const uint32_t found = list_with_bit(blocks.data(), count, block, list.data());
        for (int i = 0; i < kForward; ++i) list[found + i] = count;
        return found;
    }
};

template <bool Exact, bool Weights>
PixelSums blend_block(const Tile& tile, int block, Workspace& work) {
    PixelSums sums;
    const Lanes inside = BlockSpan(tile, block).inside();
    Lanes ahead = inside;  // transmittance, and on below the least one; sums.transmittance stops there
    sums.transmittance = inside;
    const uint32_t found = work.find(tile.end - tile.begin, block);
    const BlockPixels pixels;
    const Lanes x = pixels.x[block & 3], y = pixels.y[block >> 2];
    uint32_t first = 0;
    for (; first < found && any(at_least(ahead, kMinTransmittance)); first += kForward) {
        const uint32_t* list = work.list.data() + first;
        const Placed* placed = work.placed.data();
        const KernelValues<Exact, kForward> values([&](int i) -> const Placed& { return placed[list[i]]; },
                                                   [&](int) { return x; }, [&](int) { return y; });
        Lanes alphas[kForward];
        store<kForward>(minimum(values.alpha, Group<kForward>{} + kMaxAlpha), alphas);
        for (int i = 0; i < kForward; ++i) {
            const Placed& s = placed[list[i]];
            const Mask counted = at_least(ahead, kMinTransmittance);
            const Lanes weight = where(counted, ahead * alphas[i]);
            ahead = ahead - ahead * alphas[i];
            sums.transmittance = choose(counted, ahead, sums.transmittance);
            sums.red += s.red * weight;
            sums.green += s.green * weight;
            sums.blue += s.blue * weight;
            sums.depth += s.depth * weight;
            if constexpr (Weights) {
                work.weight_max[list[i]] = maximum(work.weight_max[list[i]], weight);
                work.contributed += count(at_least(weight, kTiny));
            }
        }
    }
    work.evaluated += kLanes * first;
    for (; first < found; ++first) work.blocks[work.list[first]] &= uint16_t(~(1 << block));
    return sums;
}

// Brings what the tile's pixels are written to closer while its splats are blended. Inlined: GCC drops calls of
// functions that do nothing but this.
SPLATS_INLINE void fetch(const Frame& frame, const Tile& tile, const Images<float>& images) {
    for (int row = 0; row < tile.height; ++row) {
        const size_t first = size_t(tile.y + row) * frame.camera.width + tile.x;
        for (int k = 0; k < 3; ++k) __builtin_prefetch(images.color + 3 * first + kTile * k, 1);
        __builtin_prefetch(images.depth + first, 1);
        __builtin_prefetch(images.opacity + first, 1);
    }
}

// Never inlined: its registers are then its own.
template <bool Exact, bool Weights>
[[gnu::noinline]] void blend_tile(Frame& frame, const Tile& tile, const Images<float>& images, Workspace& work) {
    work.take(frame, tile, Weights);
    fetch(frame, tile, images);
    for (int block = 0; block < kBlocks; ++block) {
        const BlockSpan span(tile, block);
        if (span.columns <= 0 || span.rows <= 0) continue;
        write_pixels(frame, span, blend_block<Exact, Weights>(tile, block, work), images);
    }
    for (uint32_t i = 0; i < tile.end - tile.begin; ++i) {
        Pair& pair = frame.pairs[tile.begin + i];
        pair.blocks = work.blocks[i];
        if constexpr (Weights) frame.weight_slots[pair.slot] = largest(work.weight_max[i]);
    }
}

template <bool Exact, bool Weights>
void blend_all(Frame& frame, const Images<float>& images, int threads) {
    const int tiles = frame.tiles_x * frame.tiles_y;
    int64_t evaluated = 0, contributed = 0;
    Caught caught;
#pragma omp parallel num_threads(threads) reduction(+ : evaluated, contributed)
    {
        Workspace work;
#pragma omp for schedule(dynamic, 4)
        for (int index = 0; index < tiles; ++index)
            caught([&] { blend_tile<Exact, Weights>(frame, Tile(frame, index), images, work); });
        evaluated += work.evaluated;
        contributed += work.contributed;
    }
    caught.rethrow();
    frame.evaluated = evaluated;
    frame.contributed = contributed;
}

}  // namespace

void blend(Frame& frame, bool weights, float* color, float* depth, float* opacity, int threads) {
    if (weights) frame.weight_slots.resize(size_t(frame.pair_count));
    auto* chosen = frame.exact ? (weights ? blend_all<true, true> : blend_all<true, false>)
                               : (weights ? blend_all<false, true> : blend_all<false, false>);
    chosen(frame, {color, depth, opacity}, threads);
}

}  // namespace splats
