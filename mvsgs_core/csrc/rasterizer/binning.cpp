// From the map to lists of splats by tile, front to back: the pairs of splats and tiles in the order of the splats, one
// stable depth sort of the splats, then a counting distribution to the tiles. The lists do not depend on the number of
// threads.
#include <omp.h>

#include <atomic>
#include <cstring>
#include <stdexcept>
#include <string>

#include "caught.hpp"
#include "rasterizer/shading.hpp"
#include "rasterizer/tile_walk.hpp"

namespace splats {
namespace {

constexpr size_t kAhead = 12;  // splats fetched early: the depth order jumps through memory

// Counts the pairs of all chunks: what takes them together then finds that there are few enough.
class PairBudget {
   public:
    explicit PairBudget(uint32_t max_pairs) : max_pairs_(max_pairs) {}
    void take(uint32_t pairs) {
        if (taken_.fetch_add(pairs, std::memory_order_relaxed) + pairs >= max_pairs_)
            throw std::invalid_argument("a view has " + std::to_string(max_pairs_) +
                                        " pairs of splats and tiles or more: take fewer or smaller splats, or a "
                                        "smaller image");
    }

   private:
    const uint64_t max_pairs_;
    std::atomic<uint64_t> taken_{0};
};

// Splats on the image and their footprints; depth is 0 where nothing is seen.
SPLATS_INLINE void place(const Camera& camera, const Parameters& p, int64_t first, int count, ProjectedSplat* out,
                         Footprints& f, int64_t& refused) {
    Projection r;
    project(camera, p, first, count, r);
    refused += r.refused;
    const Lanes log2_opacity = log2_of_positive(maximum(r.sigmoid * r.compensation, all(1e-30f)));
    const Lanes twice_log = 2.0f * 0.6931471805599453f * maximum(log2_opacity - kLog2MinAlpha, Lanes{});
    Lanes reach = twice_log;
    if (p.exact) {
        const Lanes power = 2.0f * log2_of_positive(maximum(twice_log, all(1e-30f))) / r.beta;
        reach = minimum(exponential(0.6931471805599453f * power), all(kMaxReach));
    }
    const Lanes half_width = root(reach * r.xx), half_height = root(reach * r.yy);
    const Lanes u = r.whole_u + r.part_u, v = r.whole_v + r.part_v;
    const Lanes left = u - half_width, right = u + half_width, top = v - half_height, bottom = v + half_height;
    const Mask seen = r.seen & at_least(right, 0.0f) & at_most(left, float(camera.width - 1)) & at_least(bottom, 0.0f) &
                      at_most(top, float(camera.height - 1));
    const Lanes inverse_yy = 1.0f / r.yy, pitch_v = root(inverse_yy), pitch_u = root(r.yy / r.determinant);
    const Lanes shear = r.xy * inverse_yy;
    store(u, f.center_x);
    store(v, f.center_y);
    store(shear, f.shear);
    store(half_height, f.half_height);
    store(r.xy * root(reach / r.xx), f.turn);
    store(1.0f / pitch_u, f.inverse_pitch_u);
    store(inverse_yy, f.pitch_v_squared);
    store(reach, f.reach);
    store(maximum(left - kMargin, Lanes{}), f.left);
    store(minimum(right + kMargin, all(float(camera.width - 1))), f.right);
    store(maximum(top - kMargin, Lanes{}), f.top);
    store(minimum(bottom + kMargin, all(float(camera.height - 1))), f.bottom);

    Shading shading;
    shade(p, first, count, r, shading);
    const float unit = p.exact ? 1.0f : kSqrtHalfLog2e;
    Lanes rows[16] = {r.whole_u, r.whole_v, r.part_u, r.part_v, unit * pitch_u, shear, unit * pitch_v, log2_opacity,
                      maximum(shading.raw[0], Lanes{}), maximum(shading.raw[1], Lanes{}),
                      maximum(shading.raw[2], Lanes{}), where(seen, r.z), 0.5f * r.beta,
                      where(seen, maximum(half_width, half_height)), Lanes{}, Lanes{}};
    transpose(rows);
    if (count == kLanes)
        std::memcpy(out, rows, sizeof(rows));  // of a size known: no call
    else
        std::memcpy(out, rows, size_t(count) * sizeof(ProjectedSplat));
}

// Projects one chunk of splats, finds their tiles; spans count from the chunk's first pair.
void fill_chunk(Frame& frame, const Parameters& p, size_t chunk, float* radii, int64_t& refused) {
    PairList& pairs = frame.chunk_pairs[chunk];
    pairs.count = 0;
    TileWalk walk(frame, pairs);
    const size_t end = std::min(size_t(p.count), (chunk + 1) * kChunk);
    for (size_t first = chunk * kChunk; first < end; first += kLanes) {
        const int count = int(std::min(size_t(kLanes), end - first));
        ProjectedSplat* splats = frame.splats.data() + first;
        Footprints footprints;
        place(frame.camera, p, int64_t(first), count, splats, footprints, refused);
        for (int i = 0; i < count; ++i) {
            const uint32_t before = pairs.count;
            if (splats[i].radius > 0.0f) walk.visit(footprints, i);
            frame.spans[first + i] = {before, pairs.count - before};
            radii[first + i] = splats[i].radius;
            // positive: bits sort as the values do
            frame.depth_keys[first + i] = std::bit_cast<uint32_t>(splats[i].depth);
        }
    }
}

// Moves the depth keys of the splats seen to the front, with their indices beside them; returns how many.
size_t gather_seen(Frame& frame, size_t count) {
    uint32_t *keys = frame.depth_keys.data(), *order = frame.order.resize(count);
    size_t seen = 0;
    for (size_t i = 0; i < count; ++i) {
        const uint32_t key = keys[i];
        keys[seen] = key;
        order[seen] = uint32_t(i);
        seen += key != 0;
    }
    return seen;
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

// Lets spans count from the first pair of all, and puts the chunks' lists into one.
void join_chunks(Frame& frame, size_t count, size_t chunks, int threads) {
    std::vector<uint32_t> begin(chunks + 1, 0);
    for (size_t chunk = 0; chunk < chunks; ++chunk) begin[chunk + 1] = begin[chunk] + frame.chunk_pairs[chunk].count;
    frame.pair_count = begin[chunks];
    frame.listed_tiles.resize(begin[chunks]);
    frame.listed_blocks.resize(begin[chunks]);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (size_t chunk = 0; chunk < chunks; ++chunk) {
        const PairList& pairs = frame.chunk_pairs[chunk];
        for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i)
            frame.spans[i].first += begin[chunk];
        if (!pairs.count) continue;
        std::memcpy(frame.listed_tiles.data() + begin[chunk], pairs.tiles.data(), pairs.count * sizeof(uint32_t));
        std::memcpy(frame.listed_blocks.data() + begin[chunk], pairs.blocks.data(), pairs.count * sizeof(uint16_t));
    }
}

// Every thread takes a part of the depth order; counts by (part, tile) give every pair its place.
void distribute(Frame& frame, size_t seen, int parts) {
    const size_t tiles = size_t(frame.tiles_x) * frame.tiles_y;
    uint32_t* counts = frame.chunk_counts.resize(parts * tiles);
    const auto visit = [&](int part, auto each) {
        const size_t end = seen * (part + 1) / parts;
        for (size_t i = seen * part / parts; i < end; ++i) {
            __builtin_prefetch(frame.spans.data() + frame.order[std::min(i + 2 * kAhead, end - 1)]);
            const SlotSpan soon = frame.spans[frame.order[std::min(i + kAhead, end - 1)]];
            __builtin_prefetch(frame.listed_tiles.data() + soon.first);
            __builtin_prefetch(frame.listed_blocks.data() + soon.first);
            const uint32_t id = frame.order[i];
            const SlotSpan span = frame.spans[id];
            for (uint32_t slot = span.first; slot < span.first + span.count; ++slot) each(id, slot);
        }
    };
#pragma omp parallel for num_threads(parts) schedule(static, 1)
    for (int part = 0; part < parts; ++part) {
        uint32_t* own = counts + part * tiles;
        std::fill(own, own + tiles, 0u);
        const auto add = [&](uint32_t slot) { ++own[frame.listed_tiles[slot]]; };
        if (parts == 1)  // in whatever order
            for (uint32_t slot = 0; slot < uint32_t(frame.pair_count); ++slot) add(slot);
        else
            visit(part, [&](uint32_t, uint32_t slot) { add(slot); });
    }
    uint32_t total = 0;
    frame.tile_begin.resize(tiles + 1);
    for (size_t tile = 0; tile < tiles; ++tile) {
        frame.tile_begin[tile] = total;
        for (int part = 0; part < parts; ++part) total += std::exchange(counts[part * tiles + tile], total);
    }
    frame.tile_begin[tiles] = total;
    frame.pairs.resize(total);
#pragma omp parallel for num_threads(parts) schedule(static, 1)
    for (int part = 0; part < parts; ++part) {
        uint32_t* own = counts + part * tiles;
        visit(part, [&](uint32_t id, uint32_t slot) {
            frame.pairs[own[frame.listed_tiles[slot]]++] = {id, slot, frame.listed_blocks[slot]};
        });
    }
}

}  // namespace

void bin(Frame& frame, const Parameters& parameters, uint32_t max_pairs, float* radii, int threads) {
    const size_t count = size_t(parameters.count), chunks = (count + kChunk - 1) / kChunk;
    frame.splats.resize(count);
    frame.spans.resize(count);
    frame.depth_keys.resize(count);
    if (frame.chunk_pairs.size() < chunks) frame.chunk_pairs.resize(chunks);
    int64_t refused = 0;
    PairBudget budget(max_pairs);
    Caught caught;  // pairs take what memory the view asks for
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) reduction(+ : refused)
    for (size_t chunk = 0; chunk < chunks; ++chunk)
        caught([&] {
            budget.take(0);  // no more memory for a view that has too many
            fill_chunk(frame, parameters, chunk, radii, refused);
            budget.take(frame.chunk_pairs[chunk].count);
        });
    caught.rethrow();
    frame.refused = refused;
    join_chunks(frame, count, chunks, threads);
    const size_t seen = gather_seen(frame, count);
    frame.visible_count = int64_t(seen);
    sort_by_depth(frame, seen);
    distribute(frame, seen, threads);
}

}  // namespace splats
