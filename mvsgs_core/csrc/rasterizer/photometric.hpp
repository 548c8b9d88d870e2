// L1 + SSIM between two images with the gradient of their sum.
#pragma once

#include <cstdint>

namespace splats {

struct Photometric {
    double l1 = 0.0;    // mean of (l1_weight + pixel_weight) |image - target|
    double ssim = 0.0;  // mean over pixels and channels
};

// image, target, gradient: (H, W, 3); pixel_weight: (H, W) or null. gradient is that of l1 - ssim_weight * ssim by image,
// and may take its place.
Photometric photometric(const float* image, const float* target, const float* pixel_weight, int height, int width,
                        float l1_weight, float ssim_weight, float* gradient, int threads);

// What a camera makes of the map's colors: image = factor (A color + b).
struct Formation {
    const float* exposure;   // (3, 4) [A | b], or null: the identity
    const float* factor;     // (H, W) of vignetting, or null: 1
    const uint8_t* valid;    // (H, W), 0 where a pixel is left out; or null
    bool clipped;            // the photograph ends at black and white, where the image does not
};

// The same of a photograph (H, W, 3) against the image that the formation makes of color (H, W, 3); without pixel
// weights. A pixel that is left out, and one that is cut off with the image beyond, is as the image. gradient: by color.
Photometric photograph_loss(const float* color, const uint8_t* photograph, const Formation& formation, int height,
                            int width, float l1_weight, float ssim_weight, float* gradient, int threads);

}  // namespace splats
