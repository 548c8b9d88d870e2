// The color of a splat seen from the camera.
#pragma once

#include "splats/harmonics.hpp"
#include "splats/projection.hpp"

namespace splats {

struct Shading {
    float direction[3];       // unit, from the camera to the splat, world
    float inverse_distance;
    float basis[16];
    float raw[3];             // 1/2 + sum, before it is clamped at 0
};

SPLATS_INLINE void shade(const Parameters& p, int64_t i, const Projection& r, Shading& s) {
    const double squared = r.offset[0] * r.offset[0] + r.offset[1] * r.offset[1] + r.offset[2] * r.offset[2];
    const double inverse = 1.0 / std::sqrt(squared);
    s.inverse_distance = float(inverse);
    for (int k = 0; k < 3; ++k) s.direction[k] = float(r.offset[k] * inverse);
    harmonics(p.degree, s.direction[0], s.direction[1], s.direction[2], s.basis);
    const int used = (p.degree + 1) * (p.degree + 1);
    const float* sh = p.sh + 3 * p.bases * i;
    float red = 0.5f, green = 0.5f, blue = 0.5f;
    for (int b = 0; b < used; ++b) {
        red += s.basis[b] * sh[3 * b];
        green += s.basis[b] * sh[3 * b + 1];
        blue += s.basis[b] * sh[3 * b + 2];
    }
    s.raw[0] = red;
    s.raw[1] = green;
    s.raw[2] = blue;
}

}  // namespace splats
