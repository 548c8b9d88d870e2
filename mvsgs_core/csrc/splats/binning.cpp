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

// The pairs of one splat, in the order of tile rows and columns.
class TileWalk {
   public:
    TileWalk(Frame& frame, const bool* mask, std::vector<Pair>& pairs, std::vector<uint32_t>& tiles)
        : frame_(frame), mask_(mask), pairs_(pairs), tiles_(tiles), row_blocks_(frame.tiles_x, 0) {}

    void visit(uint32_t id) {
        const Camera& camera = frame_.camera;
        const ScreenSplat& s = frame_.splats[id];
        const Footprint& f = frame_.footprints[id];
        const float center_y = s.whole_y + s.part_y, center_x = s.whole_x + s.part_x;
        const float top = larger(std::ceil(center_y - f.half_height - kMargin), 0.0f);
        const float bottom = smaller(std::floor(center_y + f.half_height + kMargin), float(camera.height - 1));
        if (!(top <= bottom)) return;
        const int first_row = int(top) / 4, last_row = int(bottom) / 4;
        for (int row = first_row; row <= last_row; ++row) {
            const float low = larger(4.0f * row - center_y, -f.half_height);
            const float high = smaller(4.0f * row + 3.0f - center_y, f.half_height);
            const float right_y = smaller(larger(f.turn, low), high);
            const float left_y = smaller(larger(-f.turn, low), high);
            const float right = center_x + s.shear * right_y + half_span(f, right_y) + kMargin;
            const float left = center_x + s.shear * left_y - half_span(f, left_y) - kMargin;
            const float first = larger(std::ceil(left), 0.0f);
            const float last = smaller(std::floor(right), float(camera.width - 1));
            if (first <= last) mark(row & 3, int(first) / 4, int(last) / 4);
            if ((row & 3) == 3 || row == last_row) flush(id, row >> 2);
        }
    }

   private:
    static float half_span(const Footprint& f, float dy) {
        return std::sqrt(larger(f.reach - f.pitch_v_squared * dy * dy, 0.0f)) * f.inverse_pitch_u;
    }

    void mark(int block_row, int first, int last) {
        const int first_tile = first >> 2, last_tile = last >> 2;
        for (int tile = first_tile; tile <= last_tile; ++tile) {
            const int from = tile == first_tile ? first & 3 : 0, to = tile == last_tile ? last & 3 : 3;
            row_blocks_[tile] |= uint16_t(((2u << (to - from)) - 1u) << (4 * block_row + from));
        }
        first_ = std::min(first_, first_tile);
        last_ = std::max(last_, last_tile);
    }

    void flush(uint32_t id, int tile_row) {
        for (int x = first_; x <= last_; ++x) {
            const uint32_t tile = uint32_t(tile_row * frame_.tiles_x + x);
            if (row_blocks_[x] && (!mask_ || mask_[tile])) {
                pairs_.push_back({id, 0, row_blocks_[x]});
                tiles_.push_back(tile);
            }
            row_blocks_[x] = 0;
        }
        first_ = 1 << 30;
        last_ = -1;
    }

    Frame& frame_;
    const bool* mask_;
    std::vector<Pair>& pairs_;
    std::vector<uint32_t>& tiles_;
    std::vector<uint16_t> row_blocks_;
    int first_ = 1 << 30, last_ = -1;
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
    if (frame.chunk_pairs.size() < size_t(chunks)) {
        frame.chunk_pairs.resize(chunks);
        frame.chunk_tiles.resize(chunks);
    }
    uint32_t* counts = frame.chunk_counts.resize(chunks * tiles);
#pragma omp parallel for num_threads(threads) schedule(static, 1)
    for (int chunk = 0; chunk < chunks; ++chunk) {
        std::vector<Pair>& pairs = frame.chunk_pairs[chunk];
        std::vector<uint32_t>& pair_tiles = frame.chunk_tiles[chunk];
        pairs.clear();
        pair_tiles.clear();
        TileWalk walk(frame, tile_mask, pairs, pair_tiles);
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
        for (const uint32_t tile : pair_tiles) ++own[tile];
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
            frame.pairs[own[frame.chunk_tiles[chunk][i]]++] = {pairs[i].splat, before + uint32_t(i), pairs[i].blocks};
    }
}

}  // namespace splats
