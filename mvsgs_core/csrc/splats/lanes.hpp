// Sixteen floats side by side in the compiler's own vector type: one AVX-512 register, two AVX2 or four SSE ones.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

#pragma GCC diagnostic ignored "-Wpsabi"  // every function here is inlined: no ABI is crossed

namespace splats {

constexpr int kLanes = 16;
typedef float Lanes __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));

#define SPLATS_INLINE static inline __attribute__((always_inline))
#define SPLATS_INLINE_MEMBER inline __attribute__((always_inline))

SPLATS_INLINE float smaller(float a, float b) { return a < b ? a : b; }  // one instruction; std::fmin is a call
SPLATS_INLINE float larger(float a, float b) { return a > b ? a : b; }
SPLATS_INLINE Lanes lanes(const float (&values)[kLanes]) {
    Lanes result;
    std::memcpy(&result, values, sizeof(result));
    return result;
}
SPLATS_INLINE Lanes all(float value) { return Lanes{} + value; }

// Masks live in their own registers on AVX-512 and in vectors elsewhere; there the compiler keeps them where they are.
#if defined(__AVX512F__)
using Mask = __mmask16;
constexpr Mask kAll = 0xffff;  // the unmasked intrinsics of GCC 12 warn about their own innards
SPLATS_INLINE Lanes minimum(Lanes a, Lanes b) { return (Lanes)_mm512_maskz_min_ps(kAll, (__m512)a, (__m512)b); }
SPLATS_INLINE Lanes maximum(Lanes a, Lanes b) { return (Lanes)_mm512_maskz_max_ps(kAll, (__m512)a, (__m512)b); }
SPLATS_INLINE Mask at_least(Lanes a, float b) { return _mm512_cmp_ps_mask((__m512)a, _mm512_set1_ps(b), _CMP_GE_OQ); }
SPLATS_INLINE Mask at_most(Lanes a, float b) { return _mm512_cmp_ps_mask((__m512)a, _mm512_set1_ps(b), _CMP_LE_OQ); }
SPLATS_INLINE Lanes where(Mask mask, Lanes a) { return (Lanes)_mm512_maskz_mov_ps(mask, (__m512)a); }  // 0 elsewhere
SPLATS_INLINE bool any(Mask mask) { return mask != 0; }
#else
using Mask = Ints;
SPLATS_INLINE Lanes minimum(Lanes a, Lanes b) { return a < b ? a : b; }
SPLATS_INLINE Lanes maximum(Lanes a, Lanes b) { return a > b ? a : b; }
SPLATS_INLINE Mask at_least(Lanes a, float b) { return a >= b; }
SPLATS_INLINE Mask at_most(Lanes a, float b) { return a <= b; }
SPLATS_INLINE Lanes where(Mask mask, Lanes a) { return (Lanes)(mask & (Ints)a); }  // 0 elsewhere
SPLATS_INLINE bool any(Mask mask) {
#if defined(__AVX2__)
    const __m256i* halves = reinterpret_cast<const __m256i*>(&mask);
    const __m256i both = _mm256_or_si256(halves[0], halves[1]);
    return !_mm256_testz_si256(both, both);
#else
    int32_t joined = 0;
    for (int i = 0; i < kLanes; ++i) joined |= mask[i];
    return joined != 0;
#endif
}
#endif

SPLATS_INLINE Lanes root(Lanes x) {
#if defined(__AVX512F__)
    return (Lanes)_mm512_maskz_sqrt_ps(kAll, (__m512)x);
#else
    for (int i = 0; i < kLanes; ++i) x[i] = std::sqrt(x[i]);
    return x;
#endif
}

// 1 / x of normal x, relative error 1e-7 or better.
SPLATS_INLINE Lanes reciprocal(Lanes x) {
#if defined(__AVX512F__)
    const Lanes r = (Lanes)_mm512_maskz_rcp14_ps(kAll, (__m512)x);
    return r * (2.0f - x * r);  // one step of Newton's
#else
    return 1.0f / x;
#endif
}

#if defined(__AVX512F__)
// 2^x for x <= 0, relative error 8e-8 plus rounding, by a minimax polynomial of degree 5 on [-1/2, 1/2].
SPLATS_INLINE Lanes exp2_of_negative(Lanes x) {
    const Lanes whole = (Lanes)_mm512_maskz_roundscale_ps(kAll, (__m512)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const Lanes f = x - whole;
    Lanes p = 1.327647199e-03f * f + 9.675541334e-03f;
    p = p * f + 5.550713273e-02f;
    p = p * f + 2.402211972e-01f;
    p = p * f + 6.931469671e-01f;
    p = p * f + 1.000000072f;
    return (Lanes)_mm512_maskz_scalef_ps(kAll, (__m512)p, (__m512)whole);
}
// 2^x with x limited to 126 from above, relative error 3e-6, by a polynomial of degree 4: for an exponent, as above.
SPLATS_INLINE Lanes exp2_limited(Lanes x) {
    x = minimum(x, all(126.0f));
    const Lanes whole = (Lanes)_mm512_maskz_roundscale_ps(kAll, (__m512)x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const Lanes f = x - whole;
    Lanes p = 9.570101911e-03f * f + 5.591786032e-02f;
    p = p * f + 2.402474483e-01f;
    p = p * f + 6.931218147e-01f;
    p = p * f + 9.999992614e-01f;
    return (Lanes)_mm512_maskz_scalef_ps(kAll, (__m512)p, (__m512)whole);
}
#else
// 2^x for -126 < x <= 0, relative error 8e-8 plus rounding; other lanes give garbage (the caller masks them).
// Minimax polynomial of degree 5 on [-1, 0].
SPLATS_INLINE Lanes exp2_of_negative(Lanes x) {
    const Ints whole = __builtin_convertvector(x, Ints);  // toward zero
    const Lanes f = x - __builtin_convertvector(whole, Lanes);
    Lanes p = 9.387883376e-04f * f + 9.188611733e-03f;
    p = p * f + 5.527972258e-02f;
    p = p * f + 2.401721892e-01f;
    p = p * f + 6.931422526e-01f;
    p = p * f + 9.999999251e-01f;
    return (Lanes)((Ints)p + (whole << 23));
}

// 2^x with x limited to [-126, 126]. Minimax polynomial of degree 5 on [0, 1].
SPLATS_INLINE Lanes exp2_limited(Lanes x) {
    x = minimum(maximum(x, all(-126.0f)), all(126.0f));
    const Ints whole = __builtin_convertvector(x + 128.0f, Ints) - 128;
    const Lanes f = x - __builtin_convertvector(whole, Lanes);
    Lanes p = 1.877576675e-03f * f + 8.989340090e-03f;
    p = p * f + 5.582631805e-02f;
    p = p * f + 2.401536170e-01f;
    p = p * f + 6.931530732e-01f;
    p = p * f + 9.999999251e-01f;
    return (Lanes)((Ints)p + (whole << 23));
}
#endif

// log2(x) of positive normal x: mantissa in [sqrt(1/2), sqrt(2)), log2(1 + f) = f P(f), P of degree 6 with a
// relative error of 1e-6: enough for an exponent, where it changes alpha by less than 1e-6.
SPLATS_INLINE Lanes log2_of_positive(Lanes x) {
    const Ints bits = (Ints)x;
    const Ints exponent = (bits - 0x3f3504f3) >> 23;
    const Lanes f = (Lanes)(bits - (exponent << 23)) - 1.0f;
    Lanes p = 1.716245617e-01f * f - 2.693202167e-01f;
    p = p * f + 2.956995207e-01f;
    p = p * f - 3.593716436e-01f;
    p = p * f + 4.806267683e-01f;
    p = p * f - 7.213635760e-01f;
    p = p * f + 1.442696447e+00f;
    return p * f + __builtin_convertvector(exponent, Lanes);
}

// One step of the sums below: halves of width 8, 4, 2, 1 of `a` and `b` are added crosswise.
SPLATS_INLINE Lanes merge8(Lanes a, Lanes b) {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
           __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}
SPLATS_INLINE Lanes merge4(Lanes a, Lanes b) {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
           __builtin_shufflevector(a, b, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
}
SPLATS_INLINE Lanes merge2(Lanes a, Lanes b) {
    return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
           __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}
SPLATS_INLINE Lanes merge1(Lanes a, Lanes b) {
    return __builtin_shufflevector(a, b, 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30) +
           __builtin_shufflevector(a, b, 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
}

// The sums over the lanes of sixteen vectors, in one vector: lane kSumLane[i] holds the sum of v[i].
SPLATS_INLINE Lanes sums(const Lanes (&v)[16]) {
    const Lanes a0 = merge8(v[0], v[1]), a1 = merge8(v[2], v[3]), a2 = merge8(v[4], v[5]), a3 = merge8(v[6], v[7]);
    const Lanes a4 = merge8(v[8], v[9]), a5 = merge8(v[10], v[11]), a6 = merge8(v[12], v[13]);
    const Lanes a7 = merge8(v[14], v[15]);
    const Lanes b0 = merge4(a0, a1), b1 = merge4(a2, a3), b2 = merge4(a4, a5), b3 = merge4(a6, a7);
    return merge1(merge2(b0, b1), merge2(b2, b3));
}
// Vector i = (8-bit, 4-bit, 2-bit, 1-bit merges): bit 0 of i chose the half of 8 lanes, bit 3 the single lane.
constexpr int kSumLane[16] = {0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15};

// Every lane with the one 8, 4, 2 or 1 lanes on, so that four steps join them all.
SPLATS_INLINE Lanes turned8(Lanes v) {
    return __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
}
SPLATS_INLINE Lanes turned4(Lanes v) {
    return __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11);
}
SPLATS_INLINE Lanes turned2(Lanes v) {
    return __builtin_shufflevector(v, v, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
}
SPLATS_INLINE Lanes turned1(Lanes v) {
    return __builtin_shufflevector(v, v, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
}
SPLATS_INLINE float sum(Lanes v) {
    v += turned8(v);
    v += turned4(v);
    v += turned2(v);
    return (v + turned1(v))[0];
}
SPLATS_INLINE float largest(Lanes v) {
    v = maximum(v, turned8(v));
    v = maximum(v, turned4(v));
    v = maximum(v, turned2(v));
    return maximum(v, turned1(v))[0];
}

}  // namespace splats
