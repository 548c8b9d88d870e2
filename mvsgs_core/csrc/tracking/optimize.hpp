// The steps of bundle adjustment: plain Gauss-Newton, or Levenberg-Marquardt that only accepts what helps.
#pragma once

#include <string>
#include <vector>

#include "bundle_adjustment.hpp"

namespace mvsgs {

struct OptimizeOptions {
    int steps;
    bool adaptive;     // Levenberg-Marquardt: a step that raises the cost is taken back, with more damping
    double lm, ep;     // diagonal += ep + lm * diagonal, after the Schur complement as in DROID-SLAM
    double tolerance;  // adaptive: stop where the cost falls by less than this share
    double min_inverse_depth;
};

struct Report {
    double initial_cost = 0.0, cost = 0.0;
    double smallest_pivot = 1.0;  // of the last solve, relative to its diagonal
    int steps = 0;                // accepted
    std::string failure;          // empty, or why it stopped without a usable step
};

// `diagonal` receives the information (K, M) of each inverse depth at the last linearization, without damping.
Report optimize(const Problem& problem, const OptimizeOptions& options, State& state, std::vector<double>& diagonal);

}  // namespace mvsgs
