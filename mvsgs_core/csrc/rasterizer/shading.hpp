// The colors of sixteen splats, one in each lane, as seen from the camera.
#pragma once

#include "rasterizer/harmonics.hpp"
#include "rasterizer/projection.hpp"

namespace splats {

struct Shading {
    Lanes direction[3];  // unit, from the camera to the splat, world
    Lanes inverse_distance;
    Lanes basis[16];
    Lanes raw[3];        // 1/2 + sum, before it is clamped at 0
};

SPLATS_INLINE void shade(const Parameters& p, int64_t first, int count, const Projection& r, Shading& s) {
    // by the largest component first: squares of very far offsets leave float32
    const Lanes(&o)[3] = r.offset;
    const Lanes far = maximum(maximum(maximum(o[0], -o[0]), maximum(o[1], -o[1])), maximum(o[2], -o[2]));
    const Lanes inverse_far = 1.0f / far;
    Lanes part[3];
    for (int k = 0; k < 3; ++k) part[k] = o[k] * inverse_far;
    const Lanes inverse = 1.0f / root(part[0] * part[0] + part[1] * part[1] + part[2] * part[2]);
    s.inverse_distance = inverse * inverse_far;
    for (int k = 0; k < 3; ++k) s.direction[k] = part[k] * inverse;
    harmonics(p.degree, s.direction[0], s.direction[1], s.direction[2], s.basis);
    const int used = (p.degree + 1) * (p.degree + 1), width = 3 * p.bases;
    for (int c = 0; c < 3; ++c) s.raw[c] = all(0.5f);
    if (p.bases == 1) {
        Lanes sh[3];
        load_rows(p.sh + 3 * first, count, sh);
        for (int c = 0; c < 3; ++c) s.raw[c] += s.basis[0] * sh[c];
        return;
    }
    for (int b = 0; b < used; ++b)
        for (int c = 0; c < 3; ++c) s.raw[c] += s.basis[b] * strided(p.sh + width * first + 3 * b + c, width, count);
}

}  // namespace splats
