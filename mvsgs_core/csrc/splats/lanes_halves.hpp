// Sixteen floats as halves of halves, down to what one register holds: two parts with AVX2, four elsewhere. The
// compiler's own vectors of 64 bytes would do only where there are such registers: elsewhere GCC takes their
// comparisons, selections and conversions apart, lane by lane.
#pragma once

#include "splats/register_part.hpp"

#include "splats/halves.hpp"

namespace splats {

#if defined(__AVX2__)
using Lanes = Halves<Part>;
using Ints = Halves<IntPart>;
#else
using Lanes = Halves<Halves<Part>>;
using Ints = Halves<Halves<IntPart>>;
#endif
using Mask = Ints;  // all bits of a lane, or none
using Group = Lanes;  // how many go in lockstep: the halves are chains enough

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
SPLATS_INLINE Lanes exp2_of_negative(const Lanes& x) {
    const Ints whole = toward_zero(x);
    const Lanes f = x - to_floats(whole);
    Lanes p = 9.387883376e-04f * f + 9.188611733e-03f;
    p = p * f + 5.527972258e-02f;
    p = p * f + 2.401721892e-01f;
    p = p * f + 6.931422526e-01f;
    p = p * f + 9.999999251e-01f;
    return as_floats(as_bits(p) + (whole << 23));
}

// 2^x with x limited to [-126, 126]. Minimax polynomial of degree 5 on [0, 1].
SPLATS_INLINE Lanes exp2_limited(Lanes x) {
    x = minimum(maximum(x, Lanes{} - 126.0f), Lanes{} + 126.0f);
    const Ints whole = toward_zero(x + 128.0f) - 128;
    const Lanes f = x - to_floats(whole);
    Lanes p = 1.877576675e-03f * f + 8.989340090e-03f;
    p = p * f + 5.582631805e-02f;
    p = p * f + 2.401536170e-01f;
    p = p * f + 6.931530732e-01f;
    p = p * f + 9.999999251e-01f;
    return as_floats(as_bits(p) + (whole << 23));
}

// Neighboring runs of `Width` lanes of `a` and of `b` are added; the runs of `a` and `b` then alternate.
template <int Width, class Half>
SPLATS_INLINE Halves<Half> merge(const Halves<Half>& a, const Halves<Half>& b) {
    if constexpr (sizeof(Half) == Width * sizeof(float))
        return {a.low + a.high, b.low + b.high};
    else
        return {merge<Width>(a.low, b.low), merge<Width>(a.high, b.high)};
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

// v[i], lane j <-> v[j], lane i.
SPLATS_INLINE void transpose(Lanes (&v)[16]) {
    alignas(64) float values[16][16], turned_values[16][16];
    std::memcpy(values, v, sizeof(values));
    for (int i = 0; i < 16; ++i)
        for (int j = 0; j < 16; ++j) turned_values[j][i] = values[i][j];
    std::memcpy(v, turned_values, sizeof(values));
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

// Appends the lanes with `blocks` to both lists, which have room for sixteen; returns how many these are.
SPLATS_INLINE uint32_t append(const Ints& blocks, const Ints& tiles, uint16_t* blocks_list, uint32_t* tiles_list) {
    alignas(64) uint32_t some[16], at[16];
    std::memcpy(some, &blocks, sizeof(some));
    std::memcpy(at, &tiles, sizeof(at));
    uint32_t found = 0;
    for (int i = 0; i < 16; ++i) {
        blocks_list[found] = uint16_t(some[i]);
        tiles_list[found] = at[i];
        found += some[i] != 0;
    }
    return found;
}

// Appends to `list` the numbers i < count of the masks that have `bit`; returns how many. Both end in room for sixteen.
SPLATS_INLINE uint32_t list_with_bit(const uint16_t* masks, uint32_t count, int bit, uint32_t* list) {
    uint32_t found = 0;
    for (uint32_t i = 0; i < count; ++i) {
        list[found] = i;
        found += masks[i] >> bit & 1;
    }
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
