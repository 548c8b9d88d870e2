// Two vectors side by side, operation by operation. Halves of halves are lanes where no register holds sixteen; where one
// does, several lanes go in lockstep, for one chain of dependent operations leaves most of a core's units idle.
#pragma once

#include <type_traits>

#include "rasterizer/inlining.hpp"

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
SPLATS_ONE_BY_ONE(reciprocal)
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
// value where x >= limit, 0 elsewhere
template <class Half>
SPLATS_INLINE Halves<Half> where_at_least(const Halves<Half>& x, float limit, const Halves<Half>& value) {
    return {where_at_least(x.low, limit, value.low), where_at_least(x.high, limit, value.high)};
}
template <class Half>
SPLATS_INLINE bool any(const Halves<Half>& mask) {
    return any(mask.low | mask.high);
}

}  // namespace splats
