// Vectors as wide as the instruction set has them, by the compiler's own vector type.
#pragma once

#include <cstdint>
#include <cstring>

namespace mvs {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
typedef float Lanes __attribute__((vector_size(4 * kLanes)));

inline Lanes load(const float* values) {
    Lanes result;
    std::memcpy(&result, values, sizeof(result));
    return result;
}
inline void store(float* values, const Lanes& lanes) { std::memcpy(values, &lanes, sizeof(lanes)); }
// By value: the standard library's take references, which keeps GCC from vectorizing some loops around them.
inline float smaller(float a, float b) { return a < b ? a : b; }
inline float larger(float a, float b) { return a > b ? a : b; }
inline Lanes smaller(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes larger(Lanes a, Lanes b) { return a > b ? a : b; }
inline Lanes magnitude(Lanes a) {
    typedef std::int32_t Bits __attribute__((vector_size(sizeof(Lanes))));
    return (Lanes)((Bits)a & 0x7fffffff);
}

}  // namespace mvs
