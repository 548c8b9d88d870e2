// Gradients of the image, tile by tile, front to back again: with q = dL/dweight of a splat at a pixel and R the sum of
// weight * q of all that lies behind, background included, dL/dalpha = T q - R / (1 - alpha). R starts as the whole
// sum, known from the image itself, so the transmittance is the forward pass's own product and no division undoes it.
#include <omp.h>

#include "splats/tile.hpp"

namespace splats {
namespace {

struct Target {
    Lanes transmittance, behind;
    Lanes red, green, blue, depth, covered;  // gradients of the sums over weights
};
using Targets = Target[16];

struct Images {
    const float *color, *depth, *opacity, *color_gradient, *depth_gradient, *opacity_gradient;
};

template <bool Depth>
void load(const Frame& frame, const Tile& tile, const Images& images, Targets& targets) {
    for (int block = 0; block < 16; ++block) {
        const BlockSpan span(tile, block);
        alignas(64) float g[5][kLanes] = {}, image[5][kLanes] = {};  // red, green, blue, depth, opacity
        for (int dy = 0; dy < span.rows; ++dy) {
            const size_t first = size_t(span.y + dy) * frame.camera.width + span.x;
            for (int dx = 0; dx < span.columns; ++dx) {
                const int lane = 4 * dy + dx;
                for (int c = 0; c < 3; ++c) {
                    g[c][lane] = images.color_gradient[3 * (first + dx) + c];
                    image[c][lane] = images.color[3 * (first + dx) + c];
                }
                if constexpr (Depth) {
                    image[3][lane] = images.depth[first + dx];
                    image[4][lane] = images.opacity[first + dx];
                    if (images.depth_gradient) g[3][lane] = images.depth_gradient[first + dx];
                    if (images.opacity_gradient) g[4][lane] = images.opacity_gradient[first + dx];
                }
            }
        }
        Target& t = targets[block];
        t.transmittance = span.inside();
        t.red = lanes(g[0]);
        t.green = lanes(g[1]);
        t.blue = lanes(g[2]);
        t.behind = lanes(image[0]) * t.red + lanes(image[1]) * t.green + lanes(image[2]) * t.blue;
        if constexpr (Depth) {
            const Lanes opacity = lanes(image[4]), on_opacity = lanes(g[4]);
            t.behind += opacity * on_opacity;
            t.depth = where(at_least(opacity, kTiny), lanes(g[3]) / maximum(opacity, all(kTiny)));
            t.covered = on_opacity - t.depth * lanes(image[3]);
        }
    }
}

template <bool Exact, bool Depth>
void backward_tile(Frame& frame, const Tile& tile, Targets& targets) {
    for (uint32_t index = tile.begin; index < tile.end; ++index) {
        const Pair pair = frame.pairs[index];
        if (index + 8 < tile.end) __builtin_prefetch(&frame.splats[frame.pairs[index + 8].splat]);
        if (!pair.blocks) {
            frame.slots[pair.slot] = Lanes{};
            continue;
        }
        const ScreenSplat& s = frame.splats[pair.splat];
        const Placed placed(s, tile);
        Total total[16] = {};
        for (uint32_t blocks = pair.blocks; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            Target& t = targets[block];
            Lanes u, v, log2_m, power;
            placed.at(s, block, u, v);
            const Lanes exponent = log2_alpha<Exact>(s, u, v, log2_m, power);
            const Lanes before = t.transmittance;
            const Mask counted = at_least(exponent, kLog2MinAlpha) & at_least(before, kMinTransmittance);
            const Lanes unclamped = exp2_of_negative(exponent);
            const Lanes alpha = where(counted, minimum(unclamped, all(kMaxAlpha)));
            const Lanes weight = before * alpha;
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
                const Lanes m = u * u + v * v;
                add_product(total[kBeta], on_log * power, log2_m);
                const Lanes slope = s.half_beta * power * reciprocal(maximum(m, all(kCenterM)));
                on_m = where(at_least(m, kCenterM), on_log * slope);
            }
            const Lanes on_u = on_m * u, on_v = on_m * v;
            add(total[kU], on_u);
            add(total[kV], on_v);
            add_product(total[kUU], on_u, u);
            add_product(total[kUV], on_u, v);
            add_product(total[kVV], on_v, v);
        }
        frame.slots[pair.slot] = sums(total);
    }
}

template <bool Exact, bool Depth>
void backward_all(Frame& frame, const Images& images, int threads) {
    const int tiles = frame.tiles_x * frame.tiles_y;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int index = 0; index < tiles; ++index) {
        const Tile tile(frame, index);
        if (tile.begin == tile.end) continue;
        Targets targets;
        load<Depth>(frame, tile, images, targets);
        backward_tile<Exact, Depth>(frame, tile, targets);
    }
}

}  // namespace

void blend_backward(Frame& frame, const float* color, const float* depth, const float* opacity,
                    const float* color_gradient, const float* depth_gradient, const float* opacity_gradient,
                    int threads) {
    frame.slots.resize(size_t(frame.pair_count));
    const Images images{color, depth, opacity, color_gradient, depth_gradient, opacity_gradient};
    const bool with_depth = depth_gradient || opacity_gradient;
    auto* chosen = frame.exact ? (with_depth ? backward_all<true, true> : backward_all<true, false>)
                               : (with_depth ? backward_all<false, true> : backward_all<false, false>);
    chosen(frame, images, threads);
}

}  // namespace splats
