#include "bundle_adjustment.hpp"

#include <omp.h>

#include <algorithm>
#include <cmath>

#include "caught.hpp"
#include "edge_kernel.hpp"
#include "schur.hpp"

namespace mvsgs {

BundleAdjuster::BundleAdjuster(const Problem& problem) : problem_(problem) {
    variable_.assign(problem.keyframes, -1);
    out_.resize(problem.keyframes);
    std::vector<char> used(problem.keyframes, 0);
    for (int e = 0; e < problem.edges; ++e) {
        out_[problem.from[e]].push_back(e);
        used[problem.from[e]] = used[problem.to[e]] = 1;
    }
    // A pose without an edge has nothing to hold it: it keeps its place, as a fixed one.
    for (int k = 0; k < problem.keyframes; ++k) {
        if (problem.free_pose[k] && used[k]) variable_[k] = free_poses_++;
    }
}

BundleAdjuster::Camera BundleAdjuster::camera(const State& state) const {
    const double f = state.focal_factor;
    return {problem_.intrinsics[0] * f, problem_.intrinsics[1] * f, problem_.intrinsics[2], problem_.intrinsics[3]};
}

static EdgeView edge_view(const Problem& p, const State& s, int e) {
    const int i = p.from[e], j = p.to[e];
    const size_t m = p.cells;
    EdgeView view;
    view.relative = relative_pose(&s.rotation[9 * i], &s.translation[3 * i], &s.rotation[9 * j], &s.translation[3 * j]);
    view.pixels = p.pixels + 2 * m * i;
    view.target = p.target + 2 * m * e;
    view.information = p.information + m * p.channels * e;
    view.channels = p.channels;
    view.inverse_depth = &s.inverse_depth[m * i];
    view.cells = p.cells;
    return view;
}

double BundleAdjuster::cost(const State& state) const {
    const Camera c = camera(state);
    const double k[4] = {c.fx, c.fy, c.cx, c.cy};
    std::vector<double> costs(problem_.edges);
#pragma omp parallel for schedule(static) num_threads(problem_.threads) if (problem_.threads > 1)
    for (int e = 0; e < problem_.edges; ++e) {
        costs[e] = edge_cost(edge_view(problem_, state, e), k, problem_.robust, problem_.robust_scale, problem_.min_z);
    }
    double total = 0.0;
    for (double value : costs) total += value;
    if (problem_.prior) {
        for (size_t n = 0; n < state.inverse_depth.size(); ++n) {
            const double d = state.inverse_depth[n] - problem_.prior[n];
            total += problem_.prior_weight[n] * d * d;
        }
    }
    return total;
}

void BundleAdjuster::linearize_source(const State& state, int keyframe, SourceBlock& block,
                                      std::vector<double>& local, std::vector<double>& rhs, double& cost) const {
    const int m = problem_.cells;
    const Camera c = camera(state);
    const double intrinsics[4] = {c.fx, c.fy, c.cx, c.cy};
    block.variables.clear();
    if (variable_[keyframe] >= 0) block.variables.push_back(variable_[keyframe]);
    for (int e : out_[keyframe]) {
        if (variable_[problem_.to[e]] >= 0) block.variables.push_back(variable_[problem_.to[e]]);
    }
    std::sort(block.variables.begin(), block.variables.end());
    block.variables.erase(std::unique(block.variables.begin(), block.variables.end()), block.variables.end());
    const int poses = static_cast<int>(block.variables.size());
    const int rows = 6 * poses + (problem_.free_focal ? 1 : 0);
    auto row_of = [&](int k) {
        if (variable_[k] < 0) return -1;
        auto it = std::lower_bound(block.variables.begin(), block.variables.end(), variable_[k]);
        return 6 * static_cast<int>(it - block.variables.begin());
    };
    const bool depths = problem_.free_depth[keyframe];
    local.assign(static_cast<size_t>(rows) * rows, 0.0);
    rhs.assign(rows, 0.0);
    cost = 0.0;
    block.coupling.assign(depths ? static_cast<size_t>(rows) * m : 0, 0.0);
    block.diagonal.assign(depths ? m : 0, 0.0);
    block.gradient.assign(depths ? m : 0, 0.0);
    std::vector<double> edge_coupling(depths ? static_cast<size_t>(7) * m : 0);
    const int row_i = row_of(keyframe), row_f = problem_.free_focal ? rows - 1 : -1;
    for (int e : out_[keyframe]) {
        EdgeSums sums;
        EdgeOutput output{depths ? edge_coupling.data() : nullptr, depths ? block.diagonal.data() : nullptr,
                          depths ? block.gradient.data() : nullptr};
        const EdgeView view = edge_view(problem_, state, e);
        if (problem_.free_focal) {
            linearize_edge<true>(view, intrinsics, problem_.robust, problem_.robust_scale, problem_.min_z, output, sums);
        } else {
            linearize_edge<false>(view, intrinsics, problem_.robust, problem_.robust_scale, problem_.min_z, output, sums);
        }
        cost += sums.cost;
        add_edge(view.relative, sums, row_i, row_of(problem_.to[e]), row_f, rows, local.data(), rhs.data());
        if (depths) {
            add_coupling(view.relative, edge_coupling.data(), row_i, row_of(problem_.to[e]), row_f, m,
                         block.coupling.data());
        }
    }
    if (!depths) return;
    const size_t offset = static_cast<size_t>(keyframe) * m;
    for (int n = 0; n < m; ++n) {
        block.diagonal[n] += problem_.damping[offset + n];
        if (problem_.prior) {
            block.diagonal[n] += problem_.prior_weight[offset + n];
            block.gradient[n] -= problem_.prior_weight[offset + n] *
                                 (state.inverse_depth[offset + n] - problem_.prior[offset + n]);
        }
    }
    subtract_schur(block.coupling.data(), block.diagonal.data(), block.gradient.data(), rows, m, local.data(),
                   rhs.data());
}

void BundleAdjuster::linearize(const State& state, NormalEquations& normal) const {
    const int n = 6 * free_poses_ + (problem_.free_focal ? 1 : 0);
    normal.size = n;
    normal.reduced.assign(static_cast<size_t>(n) * n, 0.0);
    normal.rhs.assign(n, 0.0);
    normal.sources.resize(problem_.keyframes);
    normal.cost = 0.0;
    Caught caught;
    // "ordered": sums are taken in one order whatever the number of threads, so that results repeat.
#pragma omp parallel for ordered schedule(static, 1) num_threads(problem_.threads) if (problem_.threads > 1)
    for (int k = 0; k < problem_.keyframes; ++k) {
        std::vector<double> local, rhs;
        double cost = 0.0;
        bool linearized = false;
        SourceBlock& block = normal.sources[k];
        if (!out_[k].empty()) {
            caught([&] {
                linearize_source(state, k, block, local, rhs, cost);
                linearized = true;
            });
        } else {
            block = SourceBlock();
        }
#pragma omp ordered
        if (linearized) {
            normal.cost += cost;
            const int rows = static_cast<int>(rhs.size());
            auto global = [&](int r) {
                const int pose = r / 6;
                return pose < static_cast<int>(block.variables.size()) ? 6 * block.variables[pose] + r % 6 : n - 1;
            };
            for (int r = 0; r < rows; ++r) {
                const int gr = global(r);
                normal.rhs[gr] += rhs[r];
                for (int q = 0; q <= r; ++q) {
                    normal.reduced[static_cast<size_t>(gr) * n + global(q)] += local[static_cast<size_t>(r) * rows + q];
                }
            }
        }
    }
    caught.rethrow();
    if (problem_.prior) {
        for (size_t c = 0; c < state.inverse_depth.size(); ++c) {
            const double d = state.inverse_depth[c] - problem_.prior[c];
            normal.cost += problem_.prior_weight[c] * d * d;
        }
    }
}

void BundleAdjuster::retract(const NormalEquations& normal, const std::vector<double>& dx, double min_inverse_depth,
                             State& state) const {
    const int m = problem_.cells;
    for (int k = 0; k < problem_.keyframes; ++k) {
        const SourceBlock& block = normal.sources[k];
        if (block.diagonal.empty()) continue;
        std::vector<double> step(block.gradient);
        const int poses = static_cast<int>(block.variables.size());
        const int rows = 6 * poses + (problem_.free_focal ? 1 : 0);
        for (int r = 0; r < rows; ++r) {
            const double x = r < 6 * poses ? dx[6 * block.variables[r / 6] + r % 6] : dx.back();
            const double* e = &block.coupling[static_cast<size_t>(r) * m];
            for (int c = 0; c < m; ++c) step[c] -= e[c] * x;
        }
        double* d = &state.inverse_depth[static_cast<size_t>(k) * m];
        for (int c = 0; c < m; ++c) {
            if (block.diagonal[c] > 0.0) d[c] = std::max(d[c] + step[c] / block.diagonal[c], min_inverse_depth);
        }
    }
    for (int k = 0; k < problem_.keyframes; ++k) {
        if (variable_[k] >= 0) left_update(&dx[6 * variable_[k]], &state.rotation[9 * k], &state.translation[3 * k]);
    }
    if (problem_.free_focal) state.focal_factor *= std::exp(dx.back());
}

}  // namespace mvsgs
