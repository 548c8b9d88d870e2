// Multi-view stereo and depth fusion on the CPU. Twins in PyTorch: mvsgs_core/mvs/torch_backend.py and
// mvsgs_core/fusion/torch_backend.py; tests hold both together.
#pragma once

#include <cstdint>
#include <vector>

namespace stereo {

// Pinhole warp of a reference pixel with inverse depth w: (X, Y, Z) = m (u, v, 1) + w b, pixel = (X / Z, Y / Z).
// With Z scaled by 1 / w it is also the depth in the neighbor: z' = Z / w.
struct Warp {
    float m[9];
    float b[3];
};

constexpr int kTileRows = 8, kTileColumns = 16;  // of a tile that can be left out of a sweep, pixels

struct CostOptions {
    int hypotheses;   // D
    int radius;       // window is (2 radius + 1)^2 pixels
    int best;         // number of views, of the best, whose cost is averaged
    float noise;      // variance added to both windows: what has less contrast than this does not correlate
    float contrast;   // gray levels: a window's pixel that differs this much from its center counts 1 / e
    float level;        // share of the cost that is the difference of both windows' means, the rest is 1 - ZNCC
    float level_range;  // gray levels: that difference costs 1 from here on
    int threads;
};

// cost (H, D, W) in [0, 1]: 1 - ZNCC, with a share of the difference of gray level, mean over the best views, 1 where a
// view does not see the hypothesis.
// Hypothesis k of a pixel is first + k step: the window follows the surface first + k step, so it is as slanted as that.
// needed (tile rows, D, tile columns), or null for all: elsewhere nothing is computed and the cost is 1.
void cost_volume(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views,
                 int neighbor_height, int neighbor_width, const float* first, const float* step,
                 const std::uint8_t* needed, const CostOptions& options, float* cost);

// cost (H, D, W) as above, of D surfaces (D, H, W): each pixel's window follows the surface around it.
void surface_costs(const float* reference, int height, int width, const float* neighbors, const Warp* warps, int views,
                   int neighbor_height, int neighbor_width, const float* surfaces, const std::uint8_t* needed,
                   const CostOptions& options, float* cost);

// correlation (N, H, W): ZNCC of each view at one inverse depth per pixel; -2 where the view does not see it.
void view_correlation(const float* reference, int height, int width, const float* neighbors, const Warp* warps,
                      int views, int neighbor_height, int neighbor_width, const float* inverse_depth,
                      const CostOptions& options, float* correlation);

struct SmoothOptions {
    float p1;    // penalty for a change by one hypothesis
    float p2;    // penalty for any larger change
    float edge;          // gray levels: a step of this size in the image halves the penalties
    float break_steps;   // a jump of `first` by more hypotheses than this ends the smoothing
    float temperature;   // of the softmax over mean path costs
    int paths;           // 4 or 8
    int threads;
};

// index (H, W): the best hypothesis, between whole ones by a parabola; probability (H, W): softmax mass within one of it;
// margin (H, W): cost of the best hypothesis elsewhere minus the best cost; best (H, W): index of the best.
void semi_global(const float* cost, int height, int hypotheses, int width, const float* reference, const float* first,
                 const float* step, const SmoothOptions& options, float* index, float* probability, float* margin,
                 std::int32_t* best);

struct ChooseOptions {
    float p1;  // penalty per inverse depth between neighboring pixels
    float p2;  // the most that they pay
    float edge;        // gray levels: a step of this size in the image halves the penalties
    float apart;       // inverse depth: a surface farther than this from another is not the same
    int threads;
};

// best (H, W): which of the surfaces (D, H, W) with costs (H, D, W) each pixel lies on; gap (H, W): how much worse the
// best surface is, in mean path cost, that is not the same, at most 1.
void choose_surface(const float* cost, const float* surfaces, int count, int height, int width, const float* reference,
                    const ChooseOptions& options, std::int32_t* best, float* gap);

struct ConsistencyOptions {
    float relative;    // largest difference of depth, relative to the larger one
    float pixels;      // round trip: largest distance to where it started
    bool round_trip;
    int threads;
};

// views (H, W): the number of neighbors whose depth agrees with the reference's.
// One way: the reference's point, projected, against the depth found there. Round trip: that depth, projected back.
void consistent_views(const float* depth, int height, int width, const float* neighbor_depths, const Warp* warps,
                      const Warp* back, int views, int neighbor_height, int neighbor_width,
                      const ConsistencyOptions& options, std::uint8_t* count);

// splatted (H, W): depth in the reference of a neighbor's pixels, the nearest one where several fall; 0 where none.
void splat_depth(const float* neighbor_depth, const float* neighbor_confidence, int neighbor_height,
                 int neighbor_width, const Warp& back, float min_neighbor_confidence, int height, int width, float* splatted);

struct FuseOptions {
    float sigma;       // relative depth: width of the support
    float violation;   // weight of free-space violations against support
    float min_neighbor_confidence;  // a neighbor's pixel below takes no part
    int threads;
};

// Per pixel, of the reference's own depth and those splatted from neighbors the one with the best score
// support - violation, refined to the weighted mean of what supports it.
void fuse_depth(const float* depth, const float* confidence, int height, int width, const float* neighbor_depths,
                const float* neighbor_confidences, const float* splatted, const Warp* warps, int views,
                int neighbor_height, int neighbor_width, const FuseOptions& options, float* fused, float* support,
                float* violation, float* own);

}  // namespace stereo
