// Sixteen floats side by side, one block of pixels: one AVX-512 register, two AVX2 or four SSE ones.
#pragma once

#include <cstring>
#include <type_traits>

#pragma GCC diagnostic ignored "-Wpsabi"  // every function here is inlined: no ABI is crossed

#if defined(__AVX512F__)
#include "rasterizer/lanes_whole.hpp"
#else
#include "rasterizer/lanes_halves.hpp"
#endif

namespace splats {

constexpr int kLanes = 16;

SPLATS_INLINE float smaller(float a, float b) { return a < b ? a : b; }  // one instruction; std::fmin is a call
SPLATS_INLINE float larger(float a, float b) { return a > b ? a : b; }
SPLATS_INLINE Lanes lanes(const float (&values)[kLanes]) {
    Lanes result;
    std::memcpy(&result, values, sizeof(result));
    return result;
}
template <class Vector, class Scalar>
SPLATS_INLINE void store(const Vector& vector, Scalar (&values)[kLanes]) {
    static_assert(sizeof(vector) == sizeof(values));
    std::memcpy(values, &vector, sizeof(values));
}
SPLATS_INLINE Lanes all(float value) { return Lanes{} + value; }

// Lane i is values[i * stride]; the last of `count` again where there are no more.
SPLATS_INLINE Lanes strided(const float* values, int64_t stride, int count) {
    alignas(64) float lane[kLanes];
    if (count == kLanes) {
        for (int i = 0; i < kLanes; ++i) lane[i] = values[i * stride];
    } else {
        for (int i = 0; i < kLanes; ++i) lane[i] = values[(i < count ? i : count - 1) * stride];
    }
    return lanes(lane);
}
// v[k], lane i is values[i * Count + k], as above.
template <int Count>
SPLATS_INLINE void load_rows(const float* values, int count, Lanes (&v)[Count]) {
    if (count == kLanes) return deinterleave(values, v);
    for (int k = 0; k < Count; ++k) v[k] = strided(values + k, Count, count);
}
// values[i * Count + k] becomes lane i of v[k], for `count` lanes.
template <int Count>
SPLATS_INLINE void store_rows(const Lanes (&v)[Count], float* values, int count) {
    if (count == kLanes) return interleave(v, values);
    alignas(64) float lane[Count][kLanes];
    std::memcpy(lane, v, sizeof(lane));
    for (int i = 0; i < count; ++i)
        for (int k = 0; k < Count; ++k) values[i * Count + k] = lane[k][i];
}
SPLATS_INLINE Ints smaller(const Ints& a, const Ints& b) { return choose(a < b, a, b); }
SPLATS_INLINE Ints larger(const Ints& a, const Ints& b) { return choose(a < b, b, a); }

// `Count` lanes that go in lockstep: 1, 2, 4, ...
template <int Count>
struct GroupOf {
    using Type = Halves<typename GroupOf<Count / 2>::Type>;
};
template <>
struct GroupOf<1> {
    using Type = Lanes;
};
template <int Count>
using Group = typename GroupOf<Count>::Type;
// The lanes that `of` gives for 0, 1, ... as one group.
template <int Count, class Of>
SPLATS_INLINE Group<Count> group(Of of, int first = 0) {
    if constexpr (Count == 1)
        return of(first);
    else
        return halves(group<Count / 2>(of, first), group<Count / 2>(of, first + Count / 2));
}
template <int Count>
SPLATS_INLINE void store(const Group<Count>& group, Lanes* first) {
    if constexpr (Count == 1) {
        *first = group;
    } else {
        store<Count / 2>(group.low, first);
        store<Count / 2>(group.high, first + Count / 2);
    }
}

// log2(x) of positive normal x: mantissa in [sqrt(1/2), sqrt(2)), log2(1 + f) = f P(f), P of degree 6 with a
// relative error of 1e-6: enough for an exponent, where it changes alpha by less than 1e-6.
template <class Wide>
SPLATS_INLINE Wide log2_of_positive(const Wide& x) {
    const auto bits = as_bits(x);
    const auto exponent = (bits - 0x3f3504f3) >> 23;
    const Wide f = as_floats(bits - (exponent << 23)) - 1.0f;
    Wide p = 1.716245617e-01f * f - 2.693202167e-01f;
    p = p * f + 2.956995207e-01f;
    p = p * f - 3.593716436e-01f;
    p = p * f + 4.806267683e-01f;
    p = p * f - 7.213635760e-01f;
    p = p * f + 1.442696447e+00f;
    return p * f + to_floats(exponent);
}

// e^x, relative error 2e-7 + 1e-7 |x|, limited to the powers of two from -126 to 127. Minimax polynomial of degree 5.
SPLATS_INLINE Lanes exponential(const Lanes& x) {
    const Lanes limited = minimum(maximum(x, all(-87.3f)), all(88.0f));
    const Ints whole = toward_zero(limited * 1.4426950408889634f + 128.5f) - 128;
    const Lanes f = limited * 1.4426950408889634f - to_floats(whole);
    Lanes p = 1.327647199e-03f * f + 9.675541334e-03f;
    p = p * f + 5.550713273e-02f;
    p = p * f + 2.402211972e-01f;
    p = p * f + 6.931469671e-01f;
    p = p * f + 1.000000072f;
    return as_floats(as_bits(p) + (whole << 23));
}

// The sums over the lanes of sixteen totals, in one vector: lane kSumLane[i] holds the sum of v[i].
SPLATS_INLINE Lanes sums(const Total (&v)[16]) {
    const Lanes a0 = both(v[0], v[1]), a1 = both(v[2], v[3]), a2 = both(v[4], v[5]);
    const Lanes a3 = both(v[6], v[7]), a4 = both(v[8], v[9]), a5 = both(v[10], v[11]);
    const Lanes a6 = both(v[12], v[13]), a7 = both(v[14], v[15]);
    const Lanes b0 = merge<4>(a0, a1), b1 = merge<4>(a2, a3), b2 = merge<4>(a4, a5), b3 = merge<4>(a6, a7);
    return merge<1>(merge<2>(b0, b1), merge<2>(b2, b3));
}
// Vector i = (8-bit, 4-bit, 2-bit, 1-bit merges): bit 0 of i chose the half of 8 lanes, bit 3 the single lane.
constexpr int kSumLane[16] = {0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15};

}  // namespace splats
