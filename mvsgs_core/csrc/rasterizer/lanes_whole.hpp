// Sixteen floats in one AVX-512 register.
#pragma once

#include <immintrin.h>

#include <algorithm>
#include <cstdint>

#include "rasterizer/inlining.hpp"

namespace splats {

typedef float Lanes __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));
using Mask = __mmask16;
constexpr Mask kAll = 0xffff;  // the unmasked intrinsics of GCC 12 warn about their own innards
constexpr int kNearest = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

SPLATS_INLINE Ints as_bits(Lanes a) { return (Ints)a; }
SPLATS_INLINE Lanes as_floats(Ints a) { return (Lanes)a; }
SPLATS_INLINE Lanes to_floats(Ints a) { return __builtin_convertvector(a, Lanes); }
SPLATS_INLINE Ints toward_zero(Lanes a) { return __builtin_convertvector(a, Ints); }

SPLATS_INLINE Lanes minimum(Lanes a, Lanes b) { return (Lanes)_mm512_maskz_min_ps(kAll, (__m512)a, (__m512)b); }
SPLATS_INLINE Lanes maximum(Lanes a, Lanes b) { return (Lanes)_mm512_maskz_max_ps(kAll, (__m512)a, (__m512)b); }
SPLATS_INLINE Lanes root(Lanes x) { return (Lanes)_mm512_maskz_sqrt_ps(kAll, (__m512)x); }
SPLATS_INLINE Mask at_least(Lanes a, float b) { return _mm512_cmp_ps_mask((__m512)a, _mm512_set1_ps(b), _CMP_GE_OQ); }
SPLATS_INLINE Mask at_most(Lanes a, float b) { return _mm512_cmp_ps_mask((__m512)a, _mm512_set1_ps(b), _CMP_LE_OQ); }
SPLATS_INLINE Lanes where(Mask mask, Lanes a) { return (Lanes)_mm512_maskz_mov_ps(mask, (__m512)a); }  // 0 elsewhere
SPLATS_INLINE Lanes where_at_least(Lanes x, float limit, Lanes value) { return where(at_least(x, limit), value); }
SPLATS_INLINE Ints choose(Ints mask, Ints a, Ints b) { return mask ? a : b; }
SPLATS_INLINE Lanes choose(Mask mask, Lanes a, Lanes b) { return (Lanes)_mm512_mask_mov_ps((__m512)b, mask, (__m512)a); }
SPLATS_INLINE bool any(Mask mask) { return mask != 0; }
SPLATS_INLINE int count(Mask mask) { return __builtin_popcount(mask); }

// 1 / x of normal x, relative error 1e-7 or better.
SPLATS_INLINE Lanes reciprocal(Lanes x) {
    const Lanes r = (Lanes)_mm512_maskz_rcp14_ps(kAll, (__m512)x);
    return r * (2.0f - x * r);  // one step of Newton's
}

SPLATS_INLINE Lanes nearest(Lanes x) { return (Lanes)_mm512_maskz_roundscale_ps(kAll, (__m512)x, kNearest); }
SPLATS_INLINE Lanes times_power(Lanes x, Lanes power) {  // of two
    return (Lanes)_mm512_maskz_scalef_ps(kAll, (__m512)x, (__m512)power);
}

}  // namespace splats

#include "rasterizer/halves.hpp"

namespace splats {

constexpr int kForward = 4, kBackward = 4;  // how many go in lockstep

template <class Half>
SPLATS_INLINE Halves<Half> nearest(const Halves<Half>& x) {
    return {nearest(x.low), nearest(x.high)};
}
template <class Half>
SPLATS_INLINE Halves<Half> times_power(const Halves<Half>& x, const Halves<Half>& power) {
    return {times_power(x.low, power.low), times_power(x.high, power.high)};
}

// 2^x for x <= 0, relative error 8e-8 plus rounding, by a minimax polynomial of degree 5 on [-1/2, 1/2].
template <class Wide>
SPLATS_INLINE Wide exp2_of_negative(const Wide& x) {
    const Wide whole = nearest(x);
    const Wide f = x - whole;
    Wide p = 1.327647199e-03f * f + 9.675541334e-03f;
    p = p * f + 5.550713273e-02f;
    p = p * f + 2.402211972e-01f;
    p = p * f + 6.931469671e-01f;
    p = p * f + 1.000000072f;
    return times_power(p, whole);
}

// 2^x with x limited to 126 from above, relative error 3e-6, by a polynomial of degree 4: for an exponent, as above.
template <class Wide>
SPLATS_INLINE Wide exp2_limited(const Wide& exponent) {
    const Wide x = minimum(exponent, Wide{} + 126.0f);
    const Wide whole = nearest(x);
    const Wide f = x - whole;
    Wide p = 9.570101911e-03f * f + 5.591786032e-02f;
    p = p * f + 2.402474483e-01f;
    p = p * f + 6.931218147e-01f;
    p = p * f + 9.999992614e-01f;
    return times_power(p, whole);
}

// Neighboring runs of `Width` lanes of `a` and of `b` are added; the runs of `a` and `b` then alternate.
template <int Width>
SPLATS_INLINE Lanes merge(Lanes a, Lanes b) {
    if constexpr (Width == 8)
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
               __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    else if constexpr (Width == 4)
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
               __builtin_shufflevector(a, b, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    else if constexpr (Width == 2)
        return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
               __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    else
        return __builtin_shufflevector(a, b, 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30) +
               __builtin_shufflevector(a, b, 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
}

// Sums over blocks: lane by lane, one register each.
using Total = Lanes;
SPLATS_INLINE void add(Total& total, Lanes a) { total += a; }
SPLATS_INLINE void add_product(Total& total, Lanes a, Lanes b) { total += a * b; }
SPLATS_INLINE Lanes both(Total a, Total b) { return merge<8>(a, b); }

// Every lane with the one `Width` lanes on.
template <int Width>
SPLATS_INLINE Lanes turned(Lanes v) {
    if constexpr (Width == 8)
        return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
    else if constexpr (Width == 4)
        return __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11);
    else if constexpr (Width == 2)
        return __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    else
        return __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
}
SPLATS_INLINE float sum(Lanes v) {
    v += turned<8>(v);
    v += turned<4>(v);
    v += turned<2>(v);
    return (v + turned<1>(v))[0];
}
SPLATS_INLINE float largest(Lanes v) {
    v = maximum(v, turned<8>(v));
    v = maximum(v, turned<4>(v));
    v = maximum(v, turned<2>(v));
    return maximum(v, turned<1>(v))[0];
}

// v[i] and v[j] with bit `Bit` of i clear and of j set: halves of runs of 2 `Bit` lanes trade places.
template <int Bit>
SPLATS_INLINE void trade(Lanes& a, Lanes& b) {
#define SPLATS_FROM(i) (i & Bit ? 16 + (i ^ Bit) : i)
#define SPLATS_TO(i) (i & Bit ? 16 + i : (i ^ Bit))
#define SPLATS_EACH(f) f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7), f(8), f(9), f(10), f(11), f(12), f(13), f(14), f(15)
    const Lanes low = __builtin_shufflevector(a, b, SPLATS_EACH(SPLATS_FROM));
    b = __builtin_shufflevector(a, b, SPLATS_EACH(SPLATS_TO));
    a = low;
#undef SPLATS_EACH
#undef SPLATS_TO
#undef SPLATS_FROM
}
template <int Bit>
SPLATS_INLINE void trade_all(Lanes (&v)[16]) {
    for (int i = 0; i < 16; ++i)
        if (!(i & Bit)) trade<Bit>(v[i], v[i | Bit]);
}
// v[i], lane j <-> v[j], lane i.
SPLATS_INLINE void transpose(Lanes (&v)[16]) {
    trade_all<8>(v);
    trade_all<4>(v);
    trade_all<2>(v);
    trade_all<1>(v);
}

// Numbers 0 to 15 of one vector and 16 to 31 of a second, for each lane one.
struct Picks {
    alignas(64) int32_t at[16];
};
template <class Of>
constexpr Picks picks(Of of) {
    Picks result{};
    for (int i = 0; i < 16; ++i) result.at[i] = of(i);
    return result;
}
SPLATS_INLINE Lanes pick(const Lanes& a, const Picks& from, const Lanes& b) {
    return (Lanes)_mm512_permutex2var_ps((__m512)a, _mm512_load_si512(from.at), (__m512)b);
}

// v[k], lane i becomes values[i * Count + k], vector after vector.
template <int Count, int K, int J = 1>
SPLATS_INLINE Lanes deinterleaved(const Lanes& before, const float* values) {
    static constexpr Picks kPicks = picks([](int i) {
        const int from = (Count * i + K) / 16, place = (Count * i + K) % 16;
        return from == J ? 16 + place : J == 1 ? place : i;
    });
    const Lanes both = pick(before, kPicks, (Lanes)_mm512_loadu_ps(values + 16 * J));
    if constexpr (J + 1 < Count)
        return deinterleaved<Count, K, J + 1>(both, values);
    else
        return both;
}
template <int Count, int K = 0>
SPLATS_INLINE void deinterleave(const float* values, Lanes (&v)[Count]) {
    v[K] = deinterleaved<Count, K>((Lanes)_mm512_loadu_ps(values), values);
    if constexpr (K + 1 < Count) deinterleave<Count, K + 1>(values, v);
}

// The way back.
template <int Count, int M, int J = 1>
SPLATS_INLINE Lanes interleaved(const Lanes& before, const Lanes (&v)[Count]) {
    static constexpr Picks kPicks = picks([](int i) {
        const int from = (16 * M + i) % Count, place = (16 * M + i) / Count;
        return from == J ? 16 + place : J == 1 ? place : i;
    });
    const Lanes both = pick(before, kPicks, v[J]);
    if constexpr (J + 1 < Count)
        return interleaved<Count, M, J + 1>(both, v);
    else
        return both;
}
template <int Count, int M = 0>
SPLATS_INLINE void interleave(const Lanes (&v)[Count], float* values) {
    _mm512_storeu_ps(values + 16 * M, (__m512)interleaved<Count, M>(v[0], v));
    if constexpr (M + 1 < Count) interleave<Count, M + 1>(v, values);
}

// Every lane of a run of four with the run's lane k.
template <int k>
SPLATS_INLINE Ints spread(Ints v) {
    return __builtin_shufflevector(v, v, k, k, k, k, 4 + k, 4 + k, 4 + k, 4 + k, 8 + k, 8 + k, 8 + k, 8 + k, 12 + k,
                                   12 + k, 12 + k, 12 + k);
}

// Appends the lanes with `blocks` to both lists, which have room for sixteen; returns how many these are.
SPLATS_INLINE uint32_t append(Ints blocks, Ints tiles, uint16_t* blocks_list, uint32_t* tiles_list) {
    const Mask some = _mm512_test_epi32_mask((__m512i)blocks, (__m512i)blocks);
    const __m512i packed = _mm512_maskz_compress_epi32(some, (__m512i)blocks);
    _mm256_storeu_si256((__m256i*)blocks_list, _mm512_maskz_cvtepi32_epi16(kAll, packed));
    _mm512_storeu_si512(tiles_list, _mm512_maskz_compress_epi32(some, (__m512i)tiles));
    return uint32_t(__builtin_popcount(some));
}

// Appends to `list` the numbers i < count of the masks that have `bit`; returns how many. Both end in room for sixteen.
SPLATS_INLINE uint32_t list_with_bit(const uint16_t* masks, uint32_t count, int bit, uint32_t* list) {
    const __m512i wanted = _mm512_set1_epi32(1 << bit);
    Ints numbers = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    uint32_t found = 0;
    for (uint32_t i = 0; i < count; i += 16, numbers += 16) {
        const __m512i some = _mm512_maskz_cvtepu16_epi32(kAll, _mm256_loadu_si256((const __m256i*)(masks + i)));
        const Mask has = _mm512_test_epi32_mask(some, wanted) & Mask((1u << std::min(count - i, 16u)) - 1u);
        _mm512_storeu_si512(list + found, _mm512_maskz_compress_epi32(has, (__m512i)numbers));
        found += uint32_t(__builtin_popcount(has));
    }
    return found;
}

// Colors of a 4x4 block, rows of which lie `stride` floats apart.
SPLATS_INLINE void gather_color(const float* first, size_t stride, Lanes (&rgb)[3]) {
    constexpr Mask kRow = 0x0fff;  // four pixels
    const Lanes a = (Lanes)_mm512_maskz_loadu_ps(kRow, first), b = (Lanes)_mm512_maskz_loadu_ps(kRow, first + stride);
    const Lanes c = (Lanes)_mm512_maskz_loadu_ps(kRow, first + 2 * stride);
    const Lanes d = (Lanes)_mm512_maskz_loadu_ps(kRow, first + 3 * stride);
    const Lanes ab[3] = {__builtin_shufflevector(a, b, 0, 3, 6, 9, 16, 19, 22, 25, 0, 0, 0, 0, 0, 0, 0, 0),
                         __builtin_shufflevector(a, b, 1, 4, 7, 10, 17, 20, 23, 26, 0, 0, 0, 0, 0, 0, 0, 0),
                         __builtin_shufflevector(a, b, 2, 5, 8, 11, 18, 21, 24, 27, 0, 0, 0, 0, 0, 0, 0, 0)};
    const Lanes cd[3] = {__builtin_shufflevector(c, d, 0, 3, 6, 9, 16, 19, 22, 25, 0, 0, 0, 0, 0, 0, 0, 0),
                         __builtin_shufflevector(c, d, 1, 4, 7, 10, 17, 20, 23, 26, 0, 0, 0, 0, 0, 0, 0, 0),
                         __builtin_shufflevector(c, d, 2, 5, 8, 11, 18, 21, 24, 27, 0, 0, 0, 0, 0, 0, 0, 0)};
    for (int k = 0; k < 3; ++k)
        rgb[k] = __builtin_shufflevector(ab[k], cd[k], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
}

template <int Row>
SPLATS_INLINE void scatter_row(const Lanes (&rgb)[3], float* first) {
    constexpr int i = 4 * Row;
    const Lanes two = __builtin_shufflevector(rgb[0], rgb[1], i, 16 + i, 0, i + 1, 17 + i, 0, i + 2, 18 + i, 0, i + 3,
                                              19 + i, 0, 0, 0, 0, 0);
    const Lanes all = __builtin_shufflevector(two, rgb[2], 0, 1, 16 + i, 3, 4, 17 + i, 6, 7, 18 + i, 9, 10, 19 + i, 0, 0,
                                              0, 0);
    _mm512_mask_storeu_ps(first, 0x0fff, (__m512)all);
}
SPLATS_INLINE void scatter_color(const Lanes (&rgb)[3], float* first, size_t stride) {
    scatter_row<0>(rgb, first);
    scatter_row<1>(rgb, first + stride);
    scatter_row<2>(rgb, first + 2 * stride);
    scatter_row<3>(rgb, first + 3 * stride);
}

}  // namespace splats
