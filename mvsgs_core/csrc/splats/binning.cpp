// From the map to lists of splats by tile, front to back: one stable depth sort for the view, then a counting
// distribution to the tiles. The lists do not depend on the number of threads.
#include <omp.h>

#include <cmath>
#include <cstring>

#include "splats/shading.hpp"

namespace splats {
namespace {

constexpr size_t kAhead = 12;     // splats fetched early: the depth order jumps through memory
constexpr float kMargin = 0.01f;  // px, so that rounding never cuts a pixel off the ellipse

// False if the splat's box misses the image.
bool place(const Camera& camera, const Parameters& p, const Projection& r, ScreenSplat& s, Footprint& f) {
    const float opacity = r.sigmoid * r.compensation;
    const float twice_log = 2.0f * std::log(larger(opacity * 255.0f, 1.0f));
    f.reach = p.exact ? smaller(std::pow(twice_log, 2.0f / r.beta), kMaxReach) : twice_log;
    const float half_width = std::sqrt(f.reach * r.xx);
    f.half_height = std::sqrt(f.reach * r.yy);
    s.radius = 0.0f;
    if (!(r.u + half_width >= 0 && r.u - half_width <= camera.width - 1)) return false;
    if (!(r.v + f.half_height >= 0 && r.v - f.half_height <= camera.height - 1)) return false;
    s.radius = larger(half_width, f.half_height);
    const double whole_x = std::nearbyint(r.u), whole_y = std::nearbyint(r.v);
    s.whole_x = float(whole_x);
    s.whole_y = float(whole_y);
    s.part_x = float(r.u - whole_x);
    s.part_y = float(r.v - whole_y);
    s.shear = r.xy / r.yy;
    const float pitch_u = std::sqrt(r.yy / r.determinant), pitch_v = 1.0f / std::sqrt(r.yy);
    f.turn = r.xy * std::sqrt(f.reach / r.xx);
    f.inverse_pitch_u = std::sqrt(r.determinant / r.yy);
    f.pitch_v_squared = 1.0f / r.yy;
    const float unit = p.exact ? 1.0f : kSqrtHalfLog2e;
    s.pitch_u = unit * pitch_u;
    s.pitch_v = unit * pitch_v;
    s.log2_opacity = std::log2(opacity);
    s.half_beta = 0.5f * r.beta;
    s.depth = r.z;
    return true;
}

// Stable least-significant-digit radix sort of positive floats by their bits, 11 bits at a time.
void sort_by_depth(Frame& frame, size_t count) {
    uint32_t *keys = frame.depth_keys.data(), *order = frame.order.data();
    uint32_t *other_keys = frame.depth_keys_scratch.resize(count), *other = frame.order_scratch.resize(count);
    for (int shift = 0; shift < 33; shift += 11) {
        uint32_t places[2048] = {};
        for (size_t i = 0; i < count; ++i) ++places[(keys[i] >> shift) & 2047];
        uint32_t total = 0;
        for (uint32_t& place : places) total += std::exchange(place, total);
        for (size_t i = 0; i < count; ++i) {
            const uint32_t to = places[(keys[i] >> shift) & 2047]++;
            other_keys[to] = keys[i];
            other[to] = order[i];
        }
        std::swap(keys, other_keys);
        std::swap(order, other);
    }
    if (order != frame.order.data()) std::memcpy(frame.order.data(), order, count * sizeof(uint32_t));
}

// The pairs of one splat, in the order of tile rows and columns; in place of its slot each has its tile.
class TileWalk {
   public:
    TileWalk(Frame& frame, const bool* mask, std::vector<Pair>& pairs) : frame_(frame), mask_(mask), pairs_(pairs) {}

    void visit(uint32_t id) {
        const Camera& camera = frame_.camera;
        const ScreenSplat& s = frame_.splats[id];
        const Footprint& f = frame_.footprints[id];
        const float center_y = s.whole_y + s.part_y, center_x = s.whole_x + s.part_x;
        const float top = larger(std::ceil(center_y - f.half_height - kMargin), 0.0f);
        const float bottom = smaller(std::floor(center_y + f.half_height + kMargin), float(camera.height - 1));
        if (!(top <= bottom)) return;
        const int first_row = int(top) / 16 * 4, last_row = int(bottom) / 4;  // from the first row of a tile
        for (int start = first_row; start <= last_row; start += kLanes) {
            // sixteen rows of blocks at once: how far left and right the ellipse reaches within each
            const Lanes rows = float(4 * start) + 4.0f * kRows;
            const Lanes low = rows - center_y, high = low + 3.0f;
            const Lanes height = all(f.half_height), turn = all(f.turn);
            const Lanes right_y = within(within(turn, low, high), -height, height);
            const Lanes left_y = within(within(-turn, low, high), -height, height);
            Lanes right = center_x + kMargin + s.shear * right_y + half_span(f, right_y);
            Lanes left = center_x - kMargin + s.shear * left_y - half_span(f, left_y);
            right = minimum(right, all(float(camera.width - 1)));
            left = minimum(maximum(left, Lanes{}), all(float(camera.width)));
            const Ints empty = (low > f.half_height + kMargin) | (high < -f.half_height - kMargin) |
                               (rows < top - 3.0f) | (rows > bottom) | (right < left);
            // pixel columns: left is rounded up, right down; neither is negative
            const Ints cut = toward_zero(left);
            const Ints first = cut - (left > to_floats(cut));
            const Ints last = toward_zero(maximum(right, Lanes{}));
            const Ints none = empty | (last < first);
            alignas(64) int32_t from[kLanes], to[kLanes];
            store(choose(none, Ints{} + kFar, first >> 2), from);
            store(choose(none, Ints{} - 1, last >> 2), to);
            const int end = std::min(kLanes, last_row - start + 1);
            for (int row = 0; row < end; row += 4) pair(id, (start + row) >> 2, from, to, row);
        }
    }

   private:
    static constexpr int kFar = 1 << 23;  // beyond every column of pixels
    static constexpr Lanes kRows = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

    SPLATS_INLINE Lanes within(Lanes value, Lanes low, Lanes high) { return minimum(maximum(value, low), high); }

    SPLATS_INLINE Lanes half_span(const Footprint& f, Lanes dy) {
        return root(maximum(f.reach - f.pitch_v_squared * dy * dy, Lanes{})) * f.inverse_pitch_u;
    }

    // The pairs of one row of tiles, from the first and last block columns of its four rows of blocks: sixteen tiles at
    // a time, 64 columns, a bit each.
    void pair(uint32_t id, int tile_row, const int32_t (&from)[kLanes], const int32_t (&to)[kLanes], int row) {
        const int first = std::min(std::min(from[row], from[row + 1]), std::min(from[row + 2], from[row + 3])) >> 2;
        const int last = std::max(std::max(to[row], to[row + 1]), std::max(to[row + 2], to[row + 3])) >> 2;
        for (int start = first; start <= last; start += 16) {
            uint64_t columns[4];
            for (int k = 0; k < 4; ++k) {
                const int begin = std::max(from[row + k] - 4 * start, 0), end = std::min(to[row + k] - 4 * start, 63);
                columns[k] = begin <= end ? ~uint64_t(0) >> (63 - end) & ~uint64_t(0) << begin : 0;
            }
            for (int x = start; x <= std::min(last, start + 15); ++x) {
                uint32_t blocks = 0;
                for (int k = 0; k < 4; ++k) {
                    blocks |= uint32_t(columns[k] & 15) << (4 * k);
                    columns[k] >>= 4;
                }
                const uint32_t tile = uint32_t(tile_row * frame_.tiles_x + x);
                if (!blocks || (mask_ && !mask_[tile])) continue;
                pairs_.push_back({id, tile, uint16_t(blocks)});
            }
        }
    }

    Frame& frame_;
    const bool* mask_;
    std::vector<Pair>& pairs_;
};

// Projects all splats; the depth keys and ids of those seen, in the order of their index, go to `frame`.
size_t project_all(Frame& frame, const Parameters& p, int threads) {
    const size_t count = size_t(p.count);
    frame.splats.resize(count);
    frame.footprints.resize(count);
    uint32_t *keys = frame.depth_keys.resize(count), *order = frame.order.resize(count);
    int64_t refused = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 512) reduction(+ : refused)
    for (size_t i = 0; i < count; ++i) {
        ScreenSplat& s = frame.splats[i];
        Projection r;
        const Fate fate = project(frame.camera, p, int64_t(i), r);
        refused += fate == Fate::kRefused;
        s.radius = 0.0f;
        s.slot = s.slot_count = 0;
        if (fate != Fate::kSeen || !place(frame.camera, p, r, s, frame.footprints[i])) continue;
        Shading shading;
        shade(p, int64_t(i), r, shading);
        s.red = larger(shading.raw[0], 0.0f);
        s.green = larger(shading.raw[1], 0.0f);
        s.blue = larger(shading.raw[2], 0.0f);
    }
    frame.refused = refused;
    size_t seen = 0;
    for (size_t i = 0; i < count; ++i) {
        if (frame.splats[i].radius <= 0.0f) continue;
        std::memcpy(&keys[seen], &frame.splats[i].depth, sizeof(float));  // positive: bits sort as the values do
        order[seen++] = uint32_t(i);
    }
    return seen;
}

}  // namespace

void bin(Frame& frame, const Parameters& parameters, const bool* tile_mask, int threads) {
    const size_t seen = project_all(frame, parameters, threads);
    frame.visible_count = int64_t(seen);
    sort_by_depth(frame, seen);

    // Each chunk of the depth order lists its pairs; counts by (chunk, tile) then give every pair its place.
    const int chunks = threads;
    const size_t tiles = size_t(frame.tiles_x) * frame.tiles_y;
    if (frame.chunk_pairs.size() < size_t(chunks)) frame.chunk_pairs.resize(chunks);
    uint32_t* counts = frame.chunk_counts.resize(chunks * tiles);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int chunk = 0; chunk < chunks; ++chunk) {
        std::vector<Pair>& pairs = frame.chunk_pairs[chunk];
        pairs.clear();
        TileWalk walk(frame, tile_mask, pairs);
        const size_t end = seen * (chunk + 1) / chunks;
        for (size_t i = seen * chunk / chunks; i < end; ++i) {
            const uint32_t soon = frame.order[std::min(i + kAhead, end - 1)];
            __builtin_prefetch(&frame.splats[soon], 1);
            __builtin_prefetch(&frame.footprints[soon]);
            ScreenSplat& s = frame.splats[frame.order[i]];
            s.slot = uint32_t(pairs.size());
            walk.visit(frame.order[i]);
            s.slot_count = uint32_t(pairs.size()) - s.slot;
        }
        uint32_t* own = counts + chunk * tiles;
        std::fill(own, own + tiles, 0u);
        for (const Pair& pair : pairs) ++own[pair.slot];
    }
    uint32_t total = 0;
    frame.tile_begin.resize(tiles + 1);
    for (size_t tile = 0; tile < tiles; ++tile) {
        frame.tile_begin[tile] = total;
        for (int chunk = 0; chunk < chunks; ++chunk) total += std::exchange(counts[chunk * tiles + tile], total);
    }
    frame.tile_begin[tiles] = total;
    frame.pair_count = total;
    frame.pairs.resize(total);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int chunk = 0; chunk < chunks; ++chunk) {
        uint32_t before = 0;
        for (int k = 0; k < chunk; ++k) before += uint32_t(frame.chunk_pairs[k].size());
        const size_t end = seen * (chunk + 1) / chunks;
        for (size_t i = seen * chunk / chunks; before && i < end; ++i) {
            __builtin_prefetch(&frame.splats[frame.order[std::min(i + kAhead, end - 1)]], 1);
            frame.splats[frame.order[i]].slot += before;
        }
        uint32_t* own = counts + chunk * tiles;
        const std::vector<Pair>& pairs = frame.chunk_pairs[chunk];
        for (size_t i = 0; i < pairs.size(); ++i)
            frame.pairs[own[pairs[i].slot]++] = {pairs[i].splat, before + uint32_t(i), pairs[i].blocks};
    }
}

}  // namespace splats
