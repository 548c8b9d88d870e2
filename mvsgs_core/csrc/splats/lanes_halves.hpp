// Sixteen floats as halves of halves, down to what one register holds: two parts with AVX2, four elsewhere. The
// compiler's own vectors of 64 bytes would do only where there are such registers: elsewhere GCC takes their
// comparisons, selections and conversions apart, lane by lane.
#pragma once

#include "splats/register_part.hpp"

namespace splats {

template <class Half>
struct Halves {
    Half low, high;

    // For lanes known when compiled; others are read from memory, after store().
    SPLATS_INLINE_MEMBER auto operator[](int lane) const {
        constexpr int kCount = int(sizeof(Half) / sizeof(float));
        return lane < kCount ? low[lane] : high[lane - kCount];
    }
};
template <class Half>
SPLATS_INLINE Halves<Half> halves(Half low, Half high) {
    return {low, high};
}

#if defined(__AVX2__)
using Lanes = Halves<Part>;
using Ints = Halves<IntPart>;
#else
using Lanes = Halves<Halves<Part>>;
using Ints = Halves<Halves<IntPart>>;
#endif
using Mask = Ints;  // all bits of a lane, or none

#define SPLATS_OPERATOR(op)                                                                     \
    template <class Half>                                                                       \
    SPLATS_INLINE auto operator op(const Halves<Half>& a, const Halves<Half>& b) {              \
        return halves(a.low op b.low, a.high op b.high);                                        \
    }                                                                                           \
    template <class Half, class Scalar>                                                         \
        requires std::is_arithmetic_v<Scalar>                                                   \
    SPLATS_INLINE auto operator op(const Halves<Half>& a, Scalar b) {                           \
        return halves(a.low op b, a.high op b);                                                 \
    }                                                                                           \
    template <class Half, class Scalar>                                                         \
        requires std::is_arithmetic_v<Scalar>                                                   \
    SPLATS_INLINE auto operator op(Scalar a, const Halves<Half>& b) {                           \
        return halves(a op b.low, a op b.high);                                                 \
    }
SPLATS_OPERATOR(+)
SPLATS_OPERATOR(-)
SPLATS_OPERATOR(*)
SPLATS_OPERATOR(/)
SPLATS_OPERATOR(&)
SPLATS_OPERATOR(|)
SPLATS_OPERATOR(<<)
SPLATS_OPERATOR(>>)
SPLATS_OPERATOR(<)
SPLATS_OPERATOR(>)
SPLATS_OPERATOR(<=)
SPLATS_OPERATOR(>=)
#undef SPLATS_OPERATOR

template <class Half>
SPLATS_INLINE Halves<Half> operator-(const Halves<Half>& a) {
    return {-a.low, -a.high};
}
template <class Half, class Other>
SPLATS_INLINE Halves<Half>& operator+=(Halves<Half>& a, const Other& b) {
    return a = a + b;
}

#define SPLATS_ONE_BY_ONE(function)                                    \
    template <class Half>                                              \
    SPLATS_INLINE auto function(const Halves<Half>& a) {               \
        return halves(function(a.low), function(a.high));              \
    }
SPLATS_ONE_BY_ONE(as_bits)
SPLATS_ONE_BY_ONE(as_floats)
SPLATS_ONE_BY_ONE(to_floats)
SPLATS_ONE_BY_ONE(toward_zero)
SPLATS_ONE_BY_ONE(root)
#undef SPLATS_ONE_BY_ONE

template <class Half>
SPLATS_INLINE Halves<Half> minimum(const Halves<Half>& a, const Halves<Half>& b) {
    return {minimum(a.low, b.low), minimum(a.high, b.high)};
}
template <class Half>
SPLATS_INLINE Halves<Half> maximum(const Halves<Half>& a, const Halves<Half>& b) {
    return {maximum(a.low, b.low), maximum(a.high, b.high)};
}
template <class MaskHalf, class Half>
SPLATS_INLINE Halves<Half> where(const Halves<MaskHalf>& mask, const Halves<Half>& a) {  // 0 elsewhere
    return {where(mask.low, a.low), where(mask.high, a.high)};
}
template <class Half>
SPLATS_INLINE Halves<Half> choose(const Halves<Half>& mask, const Halves<Half>& a, const Halves<Half>& b) {
    return {choose(mask.low, a.low, b.low), choose(mask.high, a.high, b.high)};
}
template <class Half>
SPLATS_INLINE bool any(const Halves<Half>& mask) {
    return any(mask.low | mask.high);
}
SPLATS_INLINE Mask at_least(const Lanes& a, float b) { return a >= b; }
SPLATS_INLINE Mask at_most(const Lanes& a, float b) { return a <= b; }

SPLATS_INLINE Lanes reciprocal(const Lanes& x) { return 1.0f / x; }

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

}  // namespace splats
