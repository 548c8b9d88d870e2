// L1 + SSIM between two images with the gradient of their sum.
#pragma once

namespace splats {

struct Photometric {
    double l1 = 0.0;    // mean of (l1_weight + pixel_weight) |image - target|
    double ssim = 0.0;  // mean over pixels and channels
};

// image, target, gradient: (H, W, 3); pixel_weight: (H, W) or null. gradient is that of l1 - ssim_weight * ssim by image.
Photometric photometric(const float* image, const float* target, const float* pixel_weight, int height, int width,
                        float l1_weight, float ssim_weight, float* gradient, int threads);

}  // namespace splats
