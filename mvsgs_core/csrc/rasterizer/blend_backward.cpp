// Gradients of the image, tile by tile, front to back again: with q = dL/dweight of a splat at a pixel and R the sum of
// weight * q of all that lies behind, background included, dL/dalpha = T q - R / (1 - alpha). R starts as the whole
// sum, known from the image itself, so the transmittance is the forward pass's own product and no division undoes it.
#include <omp.h>

#include "rasterizer/pixels.hpp"
#include "rasterizer/tile.hpp"

namespace splats {
namespace {

constexpr uint32_t kAhead = 20;  // pairs whose splat and slot are fetched early

struct Target {
    Lanes transmittance, behind;
    Lanes red, green, blue, depth, covered;  // gradients of the sums over weights
};
using Targets = Target[kBlocks];

template <bool Depth>
void load(const Frame& frame, const Tile& tile, const Images<const float>& image, const Images<const float>& gradient,
          Targets& targets) {
    for (int block = 0; block < kBlocks; ++block) {
        const BlockSpan span(tile, block);
        Target& t = targets[block];
        Lanes rgb[3], g[3];
        read_color(frame, span, image.color, rgb);
        read_color(frame, span, gradient.color, g);
        t.transmittance = span.inside();
        t.red = g[0];
        t.green = g[1];
        t.blue = g[2];
        t.behind = rgb[0] * g[0] + rgb[1] * g[1] + rgb[2] * g[2];
        if constexpr (Depth) {
            const Lanes opacity = read_plane(frame, span, image.opacity);
            const Lanes on_opacity = read_plane(frame, span, gradient.opacity);
            const Lanes on_depth = read_plane(frame, span, gradient.depth);
            t.behind += opacity * on_opacity;
            t.depth = where(at_least(opacity, kTiny), on_depth / maximum(opacity, all(kTiny)));
            t.covered = on_opacity - t.depth * read_plane(frame, span, image.depth);
        }
    }
}

// Brings what lies under the tile to the right closer; it is next, most often. Inlined: GCC drops calls of functions
// that do nothing but this.
SPLATS_INLINE void fetch_next(const Tile& tile, int width, const float* color, const float* gradient) {
    if (tile.x + 2 * kTile > width) return;
    for (int row = 0; row < tile.height; ++row) {
        const size_t first = 3 * (size_t(tile.y + row) * width + tile.x + kTile);
        for (size_t at = first; at < first + 3 * kTile; at += 16) {
            __builtin_prefetch(color + at);
            __builtin_prefetch(gradient + at);
        }
    }
}

// The same for the splat of a pair, and for its slot.
SPLATS_INLINE void fetch(const Frame& frame, uint32_t index) {
    const Pair& pair = frame.pairs[std::min(index, uint32_t(frame.pair_count) - 1)];
    __builtin_prefetch(&frame.splats[pair.splat]);
    __builtin_prefetch(&frame.slots[pair.slot], 1);
}

// A splat on a block, as its kernel leaves it to the sums.
struct Visit {
    Lanes u, v, alpha;
    Lanes slope, growth;  // of the exact kernel: derivative of m^(beta/2) by m, and by beta / 2
};

// The Gaussian, on the spot: its chain of operations is short.
class Gaussians {
   public:
    SPLATS_INLINE_MEMBER explicit Gaussians(const Placed& splat) : splat_(splat) {}
    SPLATS_INLINE_MEMBER Visit next(Lanes x, Lanes y) const {
        Visit visit;
        visit.u = splat_.u(x, y);
        visit.v = splat_.v(y);
        const Lanes exponent = splat_.log2_opacity - visit.u * visit.u - visit.v * visit.v;
        visit.alpha = where_at_least(exponent, kLog2MinAlpha, exp2_of_negative(exponent));
        return visit;
    }

   private:
    const Placed& splat_;
};

template <bool Exact, bool Depth, class Visits>
SPLATS_INLINE void sum_pair(const Placed& s, uint32_t blocks, Visits& visits, const BlockPixels& pixels,
                            Targets& targets, Lanes& slot) {
    Total total[16] = {};
    for (; blocks; blocks &= blocks - 1) {
        const int block = __builtin_ctz(blocks);
        const Visit& visit = visits.next(pixels.x[block & 3], pixels.y[block >> 2]);
        Target& t = targets[block];
        const Lanes unclamped = visit.alpha, alpha = minimum(unclamped, all(kMaxAlpha));
        const Lanes before = t.transmittance;
        const Mask counted = at_least(before, kMinTransmittance);
        const Lanes weight = where(counted, before * alpha);
        const Lanes red = t.red, green = t.green, blue = t.blue;
        Lanes q = s.red * red + s.green * green + s.blue * blue;
        if constexpr (Depth) q += s.depth * t.depth + t.covered;
        const Lanes behind = t.behind - weight * q;
        t.behind = behind;
        t.transmittance = before - weight;
        // dL/dlog(alpha): none where alpha is clamped
        const Mask moves = counted & at_most(unclamped, kMaxAlpha);
        const Lanes on_log = where(moves, alpha * (before * q - behind * reciprocal(1.0f - alpha)));
        add_product(total[kRed], weight, red);
        add_product(total[kGreen], weight, green);
        add_product(total[kBlue], weight, blue);
        if constexpr (Depth) add_product(total[kDepth], weight, t.depth);
        add(total[kAlpha], on_log);
        Lanes on_m = on_log;  // times -1/2 in project_backward: dL/dm of the Gaussian
        if constexpr (Exact) {
            add_product(total[kBeta], on_log, visit.growth);
            on_m = on_log * visit.slope;
        }
        const Lanes u = visit.u, v = visit.v, on_u = on_m * u, on_v = on_m * v;
        add(total[kU], on_u);
        add(total[kV], on_v);
        add_product(total[kUU], on_u, u);
        add_product(total[kUV], on_u, v);
        add_product(total[kVV], on_v, v);
    }
    slot = sums(total);
}

// Some pairs of a tile and the blocks that they may color: the exact kernel's long chain of operations takes several
// blocks at once, of whichever splats.
struct Batch {
    using Several = Group<kBackward>;
    static constexpr int kVisits = 64;  // at the least: what they need stays in the first-level cache
    static constexpr int kRoom = kVisits + kBlocks + kBackward;

    int pairs = 0, visits = 0;
    Placed placed[kVisits];
    uint32_t slots[kVisits], blocks[kVisits];
    uint8_t who[kRoom], where[kRoom];
    Visit found[kRoom];

    SPLATS_INLINE_MEMBER void add(const ProjectedSplat& s, const Tile& tile, const Pair& pair) {
        placed[pairs] = Placed(s, tile);
        slots[pairs] = pair.slot;
        blocks[pairs] = pair.blocks;
        for (uint32_t left = pair.blocks; left; left &= left - 1) {
            who[visits] = uint8_t(pairs);
            where[visits++] = uint8_t(__builtin_ctz(left));
        }
        ++pairs;
    }

    void evaluate(const BlockPixels& pixels) {
        for (int i = 0; i < kBackward; ++i) who[visits + i] = where[visits + i] = 0;
        for (int first = 0; first < visits; first += kBackward) {
            const KernelValues<true, kBackward> d([&](int i) -> const Placed& { return placed[who[first + i]]; },
                                    [&](int i) { return pixels.x[where[first + i] & 3]; },
                                    [&](int i) { return pixels.y[where[first + i] >> 2]; });
            const Several half_beta =
                group<kBackward>([&](int i) { return all(placed[who[first + i]].half_beta); });
            const Several slope = half_beta * d.power * reciprocal(maximum(d.m, Several{} + kCenterM));
            Lanes part[5][kBackward];
            store<kBackward>(d.u, part[0]);
            store<kBackward>(d.v, part[1]);
            store<kBackward>(d.alpha, part[2]);
            store<kBackward>(where_at_least(d.m, kCenterM, slope), part[3]);
            store<kBackward>(d.power * d.log2_m, part[4]);
            for (int i = 0; i < kBackward; ++i)
                found[first + i] = {part[0][i], part[1][i], part[2][i], part[3][i], part[4][i]};
        }
    }

    // The visits as evaluated, one after the other.
    struct Cursor {
        const Visit* at;
        SPLATS_INLINE_MEMBER const Visit& next(Lanes, Lanes) { return *at++; }
    };
};

template <bool Depth>
void exact_tile(Frame& frame, const Tile& tile, Targets& targets, const BlockPixels& pixels, Batch& batch) {
    for (uint32_t index = tile.begin; index < tile.end;) {
        batch.pairs = batch.visits = 0;
        for (; index < tile.end && batch.visits < Batch::kVisits; ++index) {
            const Pair pair = frame.pairs[index];
            fetch(frame, index + kAhead);
            if (pair.blocks)
                batch.add(frame.splats[pair.splat], tile, pair);
            else
                frame.slots[pair.slot] = Lanes{};
        }
        batch.evaluate(pixels);
        Batch::Cursor cursor{batch.found};
        for (int i = 0; i < batch.pairs; ++i)
            sum_pair<true, Depth>(batch.placed[i], batch.blocks[i], cursor, pixels, targets,
                                  frame.slots[batch.slots[i]]);
    }
}

template <bool Depth>
void gaussian_tile(Frame& frame, const Tile& tile, Targets& targets, const BlockPixels& pixels) {
    for (uint32_t index = tile.begin; index < tile.end; ++index) {
        const Pair pair = frame.pairs[index];
        fetch(frame, index + kAhead);
        if (!pair.blocks) {
            frame.slots[pair.slot] = Lanes{};
            continue;
        }
        const Placed placed(frame.splats[pair.splat], tile);
        Gaussians visits(placed);
        sum_pair<false, Depth>(placed, pair.blocks, visits, pixels, targets, frame.slots[pair.slot]);
    }
}

template <bool Exact, bool Depth>
void backward_all(Frame& frame, const Images<const float>& image, const Images<const float>& gradient, int threads) {
    const int tiles = frame.tiles_x * frame.tiles_y;
#pragma omp parallel num_threads(threads)
    {
        Targets targets;
        Batch batch;
        const BlockPixels pixels;
#pragma omp for schedule(dynamic, 4)
        for (int index = 0; index < tiles; ++index) {
            const Tile tile(frame, index);
            if (tile.begin == tile.end) continue;
            load<Depth>(frame, tile, image, gradient, targets);
            fetch_next(tile, frame.camera.width, image.color, gradient.color);
            if constexpr (Exact)
                exact_tile<Depth>(frame, tile, targets, pixels, batch);
            else
                gaussian_tile<Depth>(frame, tile, targets, pixels);
        }
    }
}

}  // namespace

void blend_backward(Frame& frame, const float* color, const float* depth, const float* opacity,
                    const float* color_gradient, const float* depth_gradient, const float* opacity_gradient,
                    int threads) {
    frame.slots.resize(size_t(frame.pair_count));
    const bool with_depth = depth_gradient || opacity_gradient;
    auto* chosen = frame.exact ? (with_depth ? backward_all<true, true> : backward_all<true, false>)
                               : (with_depth ? backward_all<false, true> : backward_all<false, false>);
    chosen(frame, {color, depth, opacity}, {color_gradient, depth_gradient, opacity_gradient}, threads);
}

}  // namespace splats
