// Fusion of depth maps on the CPU. Its twin in PyTorch is mvsgs_core/fusion/torch_backend.py; tests hold both together.
#pragma once

#include <cstdint>

#include "mvs/warp.hpp"

namespace fusion {

using mvs::Warp;

// A depth map (H, W), 0 where unknown, and those of its neighbors (N, h, w).
struct DepthMaps {
    const float* depth;
    int height, width;
    const float* neighbors;
    const Warp* warps;  // from the reference into each neighbor
    int views, neighbor_height, neighbor_width;
};

// moved (H, W): pixels that the neighbors together, by the root of the sum of squares, move a point for a relative
// change of its inverse depth; only those in whose image it falls count; 0 where depth is unknown.
void parallax(const DepthMaps& maps, int threads, float* moved);

// views (H, W): the number of neighbors whose depth agrees with the reference's, within `relative` (H, W) of the larger.
// The reference's point, projected, against the depth found there.
void consistent_views(const DepthMaps& maps, const float* relative, int threads, std::uint8_t* count);

// splatted (H, W): depth in the reference of a neighbor's pixels, the nearest one where several fall; 0 where none.
void splat_depth(const float* neighbor_depth, const float* neighbor_confidence, int neighbor_height,
                 int neighbor_width, const Warp& back, float min_neighbor_confidence, int height, int width,
                 float* splatted);

struct FuseOptions {
    float violation;                // weight of free-space violations against support
    float min_neighbor_confidence;  // a neighbor's pixel below takes no part
    int threads;
};

// Per pixel, of the reference's own depth and those splatted (N, H, W) from neighbors the one with the best score
// support - violation, refined to the weighted mean of what supports it; with confidences (H, W) and (N, h, w), and
// the width of the support `sigma` (H, W), relative to depth.
void fuse_depth(const DepthMaps& maps, const float* confidence, const float* neighbor_confidences,
                const float* splatted, const float* sigma, const FuseOptions& options, float* fused, float* support,
                float* violation, float* own);

}  // namespace fusion
