// Sixteen floats as halves of halves, down to what one register holds: two parts with AVX2, four elsewhere. The
// compiler's own vectors of 64 bytes would do only where there are such registers: elsewhere GCC takes their
// comparisons, selections and conversions apart, lane by lane.
#pragma once

#include <algorithm>

#include "rasterizer/register_part.hpp"

#include "rasterizer/halves.hpp"

namespace splats {

#if defined(__AVX2__)
using Lanes = Halves<Part>;
using Ints = Halves<IntPart>;
#else
using Lanes = Halves<Halves<Part>>;
using Ints = Halves<Halves<IntPart>>;
#endif
using Mask = Ints;  // all bits of a lane, or none
// How many go in lockstep: fewer in the backward pass, which keeps more of each, and one where it is four registers.
#if defined(__AVX2__)
constexpr int kForward = 4, kBackward = 2;
#else
constexpr int kForward = 1, kBackward = 1;
#endif

SPLATS_INLINE Mask at_least(const Lanes& a, float b) { return a >= b; }
SPLATS_INLINE Lanes choose(const Mask& mask, const Lanes& a, const Lanes& b) {
    return as_floats(choose(mask, as_bits(a), as_bits(b)));
}
SPLATS_INLINE int count(const Mask& mask) {
    alignas(64) int32_t values[16];
    std::memcpy(values, &mask, sizeof(values));
    int total = 0;
    for (const int32_t value : values) total -= value;
    return total;
}
SPLATS_INLINE Mask at_most(const Lanes& a, float b) { return a <= b; }

// 2^x for -126 < x <= 0, relative error 8e-8 plus rounding; other lanes give garbage (the caller masks them).
// Minimax polynomial of degree 5 on [-1, 0].
template <class Wide>
SPLATS_INLINE Wide exp2_of_negative(const Wide& x) {
    const auto whole = toward_zero(x);
    const Wide f = x - to_floats(whole);
    Wide p = 9.387883376e-04f * f + 9.188611733e-03f;
    p = p * f + 5.527972258e-02f;
    p = p * f + 2.401721892e-01f;
    p = p * f + 6.931422526e-01f;
    p = p * f + 9.999999251e-01f;
    return as_floats(as_bits(p) + (whole << 23));
}

// 2^x with x limited to [-126, 126]. Minimax polynomial of degree 5 on [0, 1].
template <class Wide>
SPLATS_INLINE Wide exp2_limited(const Wide& exponent) {
    const Wide x = minimum(maximum(exponent, Wide{} - 126.0f), Wide{} + 126.0f);
    const auto whole = toward_zero(x + 128.0f) - 128;
    const Wide f = x - to_floats(whole);
    Wide p = 1.877576675e-03f * f + 8.989340090e-03f;
    p = p * f + 5.582631805e-02f;
    p = p * f + 2.401536170e-01f;
    p = p * f + 6.931530732e-01f;
    p = p * f + 9.999999251e-01f;
    return as_floats(as_bits(p) + (whole << 23));
}

// As for parts, in register_part.hpp.
template <int Bit, class Half>
SPLATS_INLINE void trade(Halves<Half>& a, Halves<Half>& b) {
    if constexpr (sizeof(Half) == Bit * sizeof(float)) {
        const Half moved = a.high;
        a.high = b.low;
        b.low = moved;
    } else {
        trade<Bit>(a.low, b.low);
        trade<Bit>(a.high, b.high);
    }
}

// Neighboring runs of `Width` lanes of `a` and of `b` are added; the runs of `a` and `b` then alternate.
template <int Width>
SPLATS_INLINE Lanes merge(Lanes a, Lanes b) {
    trade<Width>(a, b);
    return a + b;
}

// v[i], lane j <-> v[j], lane i.
template <int Bit = 8>
SPLATS_INLINE void transpose(Lanes (&v)[16]) {
    for (int i = 0; i < 16; ++i)
        if (!(i & Bit)) trade<Bit>(v[i], v[i | Bit]);
    if constexpr (Bit > 1) transpose<Bit / 2>(v);
}

// Sums over blocks: both halves go to one, for all sums of a splat do not fit into the registers otherwise.
using Total = decltype(Lanes::low);
SPLATS_INLINE void add(Total& total, const Lanes& a) { total += a.low + a.high; }
SPLATS_INLINE void add_product(Total& total, const Lanes& a, const Lanes& b) {
    total += a.low * b.low;
    total += a.high * b.high;
}
SPLATS_INLINE Lanes both(const Total& a, const Total& b) { return {a, b}; }

template <class Half>
SPLATS_INLINE float sum(const Halves<Half>& v) {
    return sum(v.low + v.high);
}
template <class Half>
SPLATS_INLINE float largest(const Halves<Half>& v) {
    return largest(maximum(v.low, v.high));
}

// v[k], lane i becomes values[i * Count + k]; and the way back.
template <int Count>
SPLATS_INLINE void deinterleave(const float* values, Lanes (&v)[Count]) {
    alignas(64) float lane[Count][16];
    for (int i = 0; i < 16; ++i)
        for (int k = 0; k < Count; ++k) lane[k][i] = values[i * Count + k];
    std::memcpy(v, lane, sizeof(lane));
}
template <int Count>
SPLATS_INLINE void interleave(const Lanes (&v)[Count], float* values) {
    alignas(64) float lane[Count][16];
    std::memcpy(lane, v, sizeof(lane));
    for (int i = 0; i < 16; ++i)
        for (int k = 0; k < Count; ++k) values[i * Count + k] = lane[k][i];
}

// Every lane of a run of four with the run's lane k.
template <int k, class Half>
SPLATS_INLINE Halves<Half> spread(const Halves<Half>& v) {
    return {spread<k>(v.low), spread<k>(v.high)};
}

#if defined(__AVX2__)
// Which bits of a byte are set, one after the other.
struct PlacesOfBits {
    uint8_t of[256][8] = {};
    constexpr PlacesOfBits() {
        for (int bits = 0; bits < 256; ++bits)
            for (int i = 0, found = 0; i < 8; ++i)
                if (bits >> i & 1) of[bits][found++] = uint8_t(i);
    }
};
static constexpr PlacesOfBits kPlaces;

SPLATS_INLINE __m256i places_of_bits(uint32_t bits) {
    return _mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i*)kPlaces.of[bits]));
}
// Those first that have a bit of `which`, a bit a lane.
SPLATS_INLINE __m256i first_of(IntPart values, uint32_t which) {
    return _mm256_permutevar8x32_epi32((__m256i)values, places_of_bits(which));
}
SPLATS_INLINE uint32_t append(IntPart blocks, IntPart tiles, uint16_t* blocks_list, uint32_t* tiles_list) {
    const uint32_t some = uint32_t(_mm256_movemask_ps((__m256)(blocks != 0)));
    const __m256i first = first_of(blocks, some);
    _mm_storeu_si128((__m128i*)blocks_list,
                     _mm_packus_epi32(_mm256_castsi256_si128(first), _mm256_extracti128_si256(first, 1)));
    _mm256_storeu_si256((__m256i*)tiles_list, first_of(tiles, some));
    return uint32_t(__builtin_popcount(some));
}
#else
SPLATS_INLINE uint32_t append(IntPart blocks, IntPart tiles, uint16_t* blocks_list, uint32_t* tiles_list) {
    uint32_t found = 0;
    for (int i = 0; i < kPart; ++i) {
        blocks_list[found] = uint16_t(blocks[i]);
        tiles_list[found] = uint32_t(tiles[i]);
        found += blocks[i] != 0;
    }
    return found;
}
#endif
// Appends the lanes with `blocks` to both lists, which have room for sixteen; returns how many these are.
template <class Half>
SPLATS_INLINE uint32_t append(const Halves<Half>& blocks, const Halves<Half>& tiles, uint16_t* blocks_list,
                              uint32_t* tiles_list) {
    const uint32_t found = append(blocks.low, tiles.low, blocks_list, tiles_list);
    return found + append(blocks.high, tiles.high, blocks_list + found, tiles_list + found);
}

// Appends to `list` the numbers i < count of the masks that have `bit`; returns how many. Both end in room for sixteen.
SPLATS_INLINE uint32_t list_with_bit(const uint16_t* masks, uint32_t count, int bit, uint32_t* list) {
    uint32_t found = 0;
#if defined(__AVX2__)
    const __m128i to_sign = _mm_cvtsi32_si128(15 - bit);
    for (uint32_t i = 0; i < count; i += 8) {
        const __m128i signs = _mm_sll_epi16(_mm_loadu_si128((const __m128i*)(masks + i)), to_sign);
        const uint32_t has = uint32_t(_mm_movemask_epi8(_mm_packs_epi16(signs, _mm_setzero_si128()))) &
                             ((1u << std::min(count - i, 8u)) - 1u);
        const __m256i numbers = _mm256_add_epi32(places_of_bits(has), _mm256_set1_epi32(int(i)));
        _mm256_storeu_si256((__m256i*)(list + found), numbers);
        found += uint32_t(__builtin_popcount(has));
    }
#else
    for (uint32_t i = 0; i < count; ++i) {
        list[found] = i;
        found += masks[i] >> bit & 1;
    }
#endif
    return found;
}

// Colors of a 4x4 block, rows of which lie `stride` floats apart.
SPLATS_INLINE void gather_color(const float* first, size_t stride, Lanes (&rgb)[3]) {
    alignas(64) float values[3][16];
    for (int dy = 0; dy < 4; ++dy)
        for (int i = 0; i < 12; ++i) values[i % 3][4 * dy + i / 3] = first[dy * stride + i];
    for (int c = 0; c < 3; ++c) std::memcpy(&rgb[c], values[c], sizeof(Lanes));
}
SPLATS_INLINE void scatter_color(const Lanes (&rgb)[3], float* first, size_t stride) {
    alignas(64) float values[3][16];
    for (int c = 0; c < 3; ++c) std::memcpy(values[c], &rgb[c], sizeof(Lanes));
    for (int dy = 0; dy < 4; ++dy)
        for (int i = 0; i < 12; ++i) first[dy * stride + i] = values[i % 3][4 * dy + i / 3];
}

}  // namespace splats
