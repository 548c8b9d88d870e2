// The widest vector of floats in one register without AVX-512: eight with AVX2, four elsewhere.
#pragma once

#if defined(__AVX2__) || defined(__SSE2__)
#include <immintrin.h>
#else
#include <cmath>
#endif

#include <cstdint>

#include "rasterizer/inlining.hpp"

namespace splats {

#if defined(__AVX2__)
constexpr int kPart = 8;
#else
constexpr int kPart = 4;
#endif
typedef float Part __attribute__((vector_size(4 * kPart)));
typedef int32_t IntPart __attribute__((vector_size(4 * kPart)));

SPLATS_INLINE IntPart as_bits(Part a) { return (IntPart)a; }
SPLATS_INLINE Part as_floats(IntPart a) { return (Part)a; }
SPLATS_INLINE Part to_floats(IntPart a) { return __builtin_convertvector(a, Part); }
SPLATS_INLINE IntPart toward_zero(Part a) { return __builtin_convertvector(a, IntPart); }
SPLATS_INLINE Part where(IntPart mask, Part a) { return (Part)(mask & (IntPart)a); }
SPLATS_INLINE Part where_at_least(Part x, float limit, Part value) { return where(x >= limit, value); }
SPLATS_INLINE Part reciprocal(Part x) { return 1.0f / x; }
SPLATS_INLINE IntPart choose(IntPart mask, IntPart a, IntPart b) { return (mask & a) | (~mask & b); }

#if defined(__AVX2__)
SPLATS_INLINE Part minimum(Part a, Part b) { return (Part)_mm256_min_ps((__m256)a, (__m256)b); }
SPLATS_INLINE Part maximum(Part a, Part b) { return (Part)_mm256_max_ps((__m256)a, (__m256)b); }
SPLATS_INLINE Part root(Part x) { return (Part)_mm256_sqrt_ps((__m256)x); }
SPLATS_INLINE bool any(IntPart mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
#elif defined(__SSE2__)
SPLATS_INLINE Part minimum(Part a, Part b) { return (Part)_mm_min_ps((__m128)a, (__m128)b); }
SPLATS_INLINE Part maximum(Part a, Part b) { return (Part)_mm_max_ps((__m128)a, (__m128)b); }
SPLATS_INLINE Part root(Part x) { return (Part)_mm_sqrt_ps((__m128)x); }
SPLATS_INLINE bool any(IntPart mask) { return _mm_movemask_ps((__m128)mask) != 0; }
#else
SPLATS_INLINE Part minimum(Part a, Part b) { return a < b ? a : b; }
SPLATS_INLINE Part maximum(Part a, Part b) { return a > b ? a : b; }
SPLATS_INLINE Part root(Part x) {
    for (int i = 0; i < kPart; ++i) x[i] = std::sqrt(x[i]);
    return x;
}
SPLATS_INLINE bool any(IntPart mask) { return (mask[0] | mask[1] | mask[2] | mask[3]) != 0; }
#endif

// trade: halves of runs of 2 `Bit` lanes trade places, the later one of `a` for the earlier one of `b`.
// turned: every lane with the one `Width` lanes on.
#if defined(__AVX2__)
template <int Bit>
SPLATS_INLINE void trade(Part& a, Part& b) {
    const Part from = a;
    if constexpr (Bit == 4) {
        a = __builtin_shufflevector(from, b, 0, 1, 2, 3, 8, 9, 10, 11);
        b = __builtin_shufflevector(from, b, 4, 5, 6, 7, 12, 13, 14, 15);
    } else if constexpr (Bit == 2) {
        a = __builtin_shufflevector(from, b, 0, 1, 8, 9, 4, 5, 12, 13);
        b = __builtin_shufflevector(from, b, 2, 3, 10, 11, 6, 7, 14, 15);
    } else {
        a = __builtin_shufflevector(from, b, 0, 8, 2, 10, 4, 12, 6, 14);
        b = __builtin_shufflevector(from, b, 1, 9, 3, 11, 5, 13, 7, 15);
    }
}
template <int Width>
SPLATS_INLINE Part turned(Part v) {
    if constexpr (Width == 4)
        return __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3);
    else if constexpr (Width == 2)
        return __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5);
    else
        return __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6);
}
#else
template <int Bit>
SPLATS_INLINE void trade(Part& a, Part& b) {
    const Part from = a;
    if constexpr (Bit == 2) {
        a = __builtin_shufflevector(from, b, 0, 1, 4, 5);
        b = __builtin_shufflevector(from, b, 2, 3, 6, 7);
    } else {
        a = __builtin_shufflevector(from, b, 0, 4, 2, 6);
        b = __builtin_shufflevector(from, b, 1, 5, 3, 7);
    }
}
template <int Width>
SPLATS_INLINE Part turned(Part v) {
    if constexpr (Width == 2)
        return __builtin_shufflevector(v, v, 2, 3, 0, 1);
    else
        return __builtin_shufflevector(v, v, 1, 0, 3, 2);
}
#endif

// Every lane of a run of four with the run's lane k.
template <int k>
SPLATS_INLINE IntPart spread(IntPart v) {
#if defined(__AVX2__)
    return __builtin_shufflevector(v, v, k, k, k, k, 4 + k, 4 + k, 4 + k, 4 + k);
#else
    return __builtin_shufflevector(v, v, k, k, k, k);
#endif
}

SPLATS_INLINE float sum(Part v) {
    if constexpr (kPart == 8) v += turned<4>(v);
    v += turned<2>(v);
    return (v + turned<1>(v))[0];
}
SPLATS_INLINE float largest(Part v) {
    if constexpr (kPart == 8) v = maximum(v, turned<4>(v));
    v = maximum(v, turned<2>(v));
    return maximum(v, turned<1>(v))[0];
}

}  // namespace splats
