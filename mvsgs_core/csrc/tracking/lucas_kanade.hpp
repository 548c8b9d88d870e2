// Pyramidal Lucas-Kanade, inverse compositional (Baker & Matthews 2004), with an unknown gain and offset of brightness.
#pragma once

#include <vector>

namespace mvsgs {

struct Level {
    const float* data;  // padded image, row-major
    int height, width;  // without the border
    int stride;
};

struct Pyramid {
    std::vector<Level> levels;  // level l is 2^l times smaller; pixel x there is pixel 2^l x in level 0
    int border;
};

struct TrackOptions {
    int start_level, iterations;
    float window_sigma;    // pixels, Gaussian weight of the 16x16 window
    float min_eigenvalue;  // gray levels^2 per pixel^2: less texture than this can't be tracked
};

struct Tracked {
    float u, v;
    float correlation;  // zero-mean normalized, of the two windows
    bool found;
};

// One point of `a` found in `b`, starting from the guess.
Tracked track_point(const Pyramid& a, const Pyramid& b, float u, float v, float guess_u, float guess_v,
                    const TrackOptions& options);

}  // namespace mvsgs
