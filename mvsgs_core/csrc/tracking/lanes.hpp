// Eight doubles or sixteen floats at a time, by the compiler's vector extension: one source for every instruction set.
#pragma once

#include <cstring>

// Vectors wider than the instruction set's registers are passed in memory: only inline functions here, so it's no ABI.
#pragma GCC diagnostic ignored "-Wpsabi"

namespace mvsgs {

constexpr int kLanes = 8;
typedef double vd __attribute__((vector_size(64)));
typedef long long vl __attribute__((vector_size(64)));
typedef float vf __attribute__((vector_size(64)));

inline vd splat(double x) { return vd{x, x, x, x, x, x, x, x}; }

inline vd load(const double* p, int n = kLanes) {
    vd v{};
    if (n == kLanes) {
        std::memcpy(&v, p, sizeof(vd));
    } else {
        for (int k = 0; k < n; ++k) v[k] = p[k];
    }
    return v;
}

inline void store(double* p, vd v, int n = kLanes) {
    if (n == kLanes) {
        std::memcpy(p, &v, sizeof(vd));
    } else {
        for (int k = 0; k < n; ++k) p[k] = v[k];
    }
}

inline double sum(vd v) { return ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7])); }

inline vf load_f(const float* p) {
    vf v;
    std::memcpy(&v, p, sizeof(vf));
    return v;
}

inline float sum(vf v) {
    float s = 0.0f;
    for (int k = 0; k < 8; ++k) s += v[k] + v[k + 8];
    return s;
}

}  // namespace mvsgs
