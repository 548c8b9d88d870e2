#pragma once

#include <bit>
#include <cstdint>

namespace mvs {

// e^x of x <= 0, to 1e-6 of itself; the library's function keeps loops around it from being vectorized.
inline float exponential(float x) {
    const float scaled = x * 1.442695041f, power = scaled > -126.0f ? scaled : -126.0f;  // of NaN: 0
    const std::int32_t whole = static_cast<std::int32_t>(power - 0.5f);
    const float f = power - static_cast<float>(whole);
    float p = 1.540353e-4f;
    p = p * f + 1.3333558e-3f;
    p = p * f + 9.6181291e-3f;
    p = p * f + 5.5504109e-2f;
    p = p * f + 2.4022651e-1f;
    p = p * f + 6.9314718e-1f;
    p = p * f + 1.0f;
    return p * std::bit_cast<float>((whole + 127) << 23);
}

}  // namespace mvs
