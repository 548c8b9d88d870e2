// Gradients of the image, tile by tile, front to back again: with q = dL/dweight of a splat at a pixel and R the sum of
// weight * q of all that lies behind, background included, dL/dalpha = T q - R / (1 - alpha). R starts as the whole sum,
// known from the image itself, so the transmittance is the forward pass's own product and no division undoes it.
#include <omp.h>

#include "splats/tile.hpp"

namespace splats {
namespace {

struct Targets {
    Lanes transmittance[16], behind[16];
    Lanes red[16], green[16], blue[16], depth[16], covered[16];  // gradients of the sums over weights
};

struct Images {
    const float *color, *depth, *opacity, *color_gradient, *depth_gradient, *opacity_gradient;
};

void load(const Frame& frame, const Tile& tile, const Images& images, Targets& targets) {
    for (int block = 0; block < 16; ++block) {
        for (int lane = 0; lane < kLanes; ++lane) {
            int row, column;
            const bool inside = tile.pixel(block, lane, row, column);
            const size_t at = inside ? size_t(row) * frame.camera.width + column : 0;
            const float* c = images.color_gradient + 3 * at;
            const float covered = images.opacity[at], depth = images.depth[at];
            const float on_depth = images.depth_gradient && covered > 0.0f ? images.depth_gradient[at] : 0.0f;
            const float on_opacity = images.opacity_gradient ? images.opacity_gradient[at] : 0.0f;
            const float scaled = covered > 0.0f ? on_depth / covered : 0.0f;
            targets.transmittance[block][lane] = inside ? 1.0f : 0.0f;
            targets.red[block][lane] = c[0];
            targets.green[block][lane] = c[1];
            targets.blue[block][lane] = c[2];
            targets.depth[block][lane] = scaled;
            targets.covered[block][lane] = on_opacity - scaled * depth;
            targets.behind[block][lane] = images.color[3 * at] * c[0] + images.color[3 * at + 1] * c[1] +
                                          images.color[3 * at + 2] * c[2] + covered * on_opacity;
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
        Lanes total[16] = {};
        for (uint32_t blocks = pair.blocks; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            Lanes u, v, log2_m, power;
            placed.at(s, block, u, v);
            const Lanes exponent = log2_alpha<Exact>(s, u, v, log2_m, power);
            const Lanes before = targets.transmittance[block];
            const Ints counted = (exponent >= kLog2MinAlpha) & (before >= kMinTransmittance);
            const Lanes unclamped = exp2_of_negative(exponent);
            const Lanes alpha = counted ? minimum(unclamped, all(kMaxAlpha)) : Lanes{};
            const Lanes weight = before * alpha;
            const Lanes red = targets.red[block], green = targets.green[block], blue = targets.blue[block];
            Lanes q = s.red * red + s.green * green + s.blue * blue;
            if constexpr (Depth) q += s.depth * targets.depth[block] + targets.covered[block];
            const Lanes behind = targets.behind[block] - weight * q;
            targets.behind[block] = behind;
            targets.transmittance[block] = before - weight;
            // dL/dlog(alpha): none where alpha is clamped
            Lanes on_log = alpha * (before * q - behind / (1.0f - alpha));
            on_log = (counted & (unclamped <= kMaxAlpha)) ? on_log : Lanes{};
            total[kRed] += weight * red;
            total[kGreen] += weight * green;
            total[kBlue] += weight * blue;
            if constexpr (Depth) total[kDepth] += weight * targets.depth[block];
            total[kAlpha] += on_log;
            Lanes on_m = on_log;  // times -1/2 in project_backward: dL/dm of the Gaussian
            if constexpr (Exact) {
                const Lanes m = u * u + v * v;
                total[kBeta] += on_log * power * log2_m;
                on_m = m > kCenterM ? on_log * s.half_beta * power / m : Lanes{};
            }
            const Lanes on_u = on_m * u, on_v = on_m * v;
            total[kU] += on_u;
            total[kV] += on_v;
            total[kUU] += on_u * u;
            total[kUV] += on_u * v;
            total[kVV] += on_v * v;
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
        load(frame, tile, images, targets);
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
