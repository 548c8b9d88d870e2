// Multi-view stereo on the CPU. Its twin in PyTorch is mvsgs_core/mvs/torch_backend.py; tests hold both together.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "mvs/warp.hpp"

namespace mvs {

constexpr int kTileRows = 8, kTileColumns = 16;  // of a tile that can be left out of a sweep, pixels

// A reference (H, W) and the neighbors (N, h, w) that it is matched with, float gray levels.
struct Images {
    const float* reference;
    int height, width;
    const float* neighbors;
    const Warp* warps;  // from the reference into each neighbor
    int views, neighbor_height, neighbor_width;

    const float* neighbor(int n) const { return neighbors + static_cast<std::size_t>(n) * neighbor_height * neighbor_width; }
};

struct CostOptions {
    std::string name;        // of a matching cost, see matching_cost.hpp
    int radius;              // window is (2 radius + 1)^2 pixels
    int top_k;               // views, of the best, whose cost is averaged
    float noise;             // variance added to both windows: what has less contrast than this does not correlate
    float contrast;          // gray levels: a window's pixel that differs this much from its center counts 1 / e
    float intensity_weight;  // part of the cost that is the difference of both windows' means
    float intensity_range;   // gray levels: that difference costs 1 from here on
    int threads;
};

// cost (H, D, W) in [0, 1]: mean over the best views, 1 where a view does not see the hypothesis.
// Hypothesis k of a pixel is first + k step: the window follows the surface first + k step, so it is as slanted as that.
// needed (tile rows, D, tile columns), or null for all: elsewhere nothing is computed and the cost is 1.
// Raises std::invalid_argument for a cost that there is not.
void cost_volume(const Images& images, const float* first, const float* step, int hypotheses,
                 const std::uint8_t* needed, const CostOptions& options, float* cost);

// cost (H, D, W) as above, of D surfaces (D, H, W): each pixel's window follows the surface around it.
void surface_costs(const Images& images, const float* surfaces, int count, const std::uint8_t* needed,
                   const CostOptions& options, float* cost);

// correlation (N, H, W): ZNCC of each view at one inverse depth per pixel; -2 where the view does not see it.
void view_correlation(const Images& images, const float* inverse_depth, const CostOptions& options,
                      float* correlation);

struct SmoothOptions {
    float p1;           // penalty for a change by one hypothesis
    float p2;           // penalty for any larger change
    float edge;         // gray levels: a step of this size in the image halves the penalties
    float break_steps;  // a jump of `first` by more hypotheses than this ends the smoothing
    float temperature;  // of the softmax over mean path costs
    int paths;          // 4 or 8
    int threads;
};

// index (H, W): the best hypothesis, between whole ones by a parabola; probability (H, W): softmax mass within one of it;
// margin (H, W): cost of the best hypothesis elsewhere minus the best cost; best (H, W): index of the best.
void semi_global(const float* cost, int height, int hypotheses, int width, const float* reference, const float* first,
                 const float* step, const SmoothOptions& options, float* index, float* probability, float* margin,
                 std::int32_t* best);

struct ChooseOptions {
    float p1;     // penalty per inverse depth between neighboring pixels
    float p2;     // the most that they pay
    float edge;   // gray levels: a step of this size in the image halves the penalties
    float apart;  // inverse depth: a surface farther than this from another is not the same
    int threads;
};

// best (H, W): which of the surfaces (D, H, W) with costs (H, D, W) each pixel lies on; gap (H, W): how much worse the
// best surface is, in mean path cost, that is not the same, at most 1.
void choose_surface(const float* cost, const float* surfaces, int count, int height, int width, const float* reference,
                    const ChooseOptions& options, std::int32_t* best, float* gap);

}  // namespace mvs
