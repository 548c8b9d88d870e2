// Dense bundle adjustment: poses and per-cell inverse depths of a keyframe graph (DROID-SLAM, Teed & Deng 2021).
#pragma once

#include <cstdint>
#include <vector>

namespace mvsgs {

enum class Robust : int { kNone = 0, kCauchy = 1 };

// All arrays row-major; K keyframes, M cells a keyframe, E directed edges.
struct Problem {
    int keyframes, cells, edges, channels;  // channels of the information: 2 = diagonal, 3 = xx, xy, yy
    const double* pixels;                   // (K, 2, M)
    double intrinsics[4];
    const int32_t *from, *to;       // (E)
    const double* target;           // (E, 2, M) pixels in `to`
    const double* information;      // (E, channels, M) pixels^-2
    const uint8_t *free_pose, *free_depth;  // (K)
    const double* damping;          // (K, M) added to the inverse depths' diagonal
    const double *prior, *prior_weight;  // (K, M) or null
    bool free_focal;
    Robust robust;
    double robust_scale;  // of the whitened residual
    double min_z;         // a point whose scaled depth in `to` is below this has no weight
    int threads;
};

struct State {
    std::vector<double> rotation;     // (K, 9) camera from world
    std::vector<double> translation;  // (K, 3)
    std::vector<double> inverse_depth;  // (K, M)
    double focal_factor = 1.0;
};

// The normal equations of one source keyframe: its inverse depths (diagonal) against the poses that see them.
struct SourceBlock {
    std::vector<int> variables;  // free pose numbers, ascending
    std::vector<double> coupling;  // E: (6 * variables + focal, M)
    std::vector<double> diagonal, gradient;  // C and w: (M)
};

struct NormalEquations {
    int size = 0;
    std::vector<double> reduced;  // Schur complement, (size, size), lower triangle
    std::vector<double> rhs;
    std::vector<SourceBlock> sources;  // (K)
    double cost = 0.0;
};

class BundleAdjuster {
  public:
    explicit BundleAdjuster(const Problem& problem);

    double cost(const State& state) const;
    void linearize(const State& state, NormalEquations& normal) const;
    // Moves `state` along dx = (poses, focal) and the inverse depths that follow from it.
    void retract(const NormalEquations& normal, const std::vector<double>& dx, double min_inverse_depth,
                 State& state) const;
    const std::vector<int>& out_edges(int keyframe) const { return out_[keyframe]; }

  private:
    struct Camera {
        double fx, fy, cx, cy;
    };
    Camera camera(const State& state) const;
    void linearize_source(const State& state, int keyframe, SourceBlock& block, std::vector<double>& local,
                          std::vector<double>& rhs, double& cost) const;

    const Problem& problem_;
    std::vector<int> variable_;  // (K) number among the free poses, -1 where fixed
    int free_poses_ = 0;
    std::vector<std::vector<int>> out_;  // edges by source keyframe
};

}  // namespace mvsgs
