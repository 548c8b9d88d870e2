#include "optimize.hpp"

#include <algorithm>
#include <cmath>

#include "cholesky.hpp"

namespace mvsgs {

static bool finite(const State& state) {
    auto all = [](const std::vector<double>& v) {
        return std::all_of(v.begin(), v.end(), [](double x) { return std::isfinite(x); });
    };
    return all(state.rotation) && all(state.translation) && all(state.inverse_depth) &&
           std::isfinite(state.focal_factor);
}

Report optimize(const Problem& problem, const OptimizeOptions& options, State& state, std::vector<double>& diagonal) {
    const BundleAdjuster adjuster(problem);
    NormalEquations normal;
    adjuster.linearize(state, normal);
    Report report;
    report.initial_cost = report.cost = normal.cost;
    double lm = options.lm;
    int rejected = 0;
    for (int n = 0; n < options.steps;) {
        std::vector<double> a(normal.reduced), dx(normal.rhs);
        for (int r = 0; r < normal.size; ++r) {
            double& d = a[static_cast<size_t>(r) * normal.size + r];
            d += options.ep + lm * std::max(d, 0.0);
        }
        report.smallest_pivot = cholesky_solve(a, dx, normal.size);
        State candidate = state;
        const bool solved = report.smallest_pivot > 0.0;
        if (solved) adjuster.retract(normal, dx, options.min_inverse_depth, candidate);
        const bool usable = solved && finite(candidate);
        double cost = report.cost;
        if (usable && options.adaptive) cost = adjuster.cost(candidate);
        if (!usable || (options.adaptive && !(cost <= report.cost))) {
            if (!options.adaptive || ++rejected > 6) {
                if (!solved) report.failure = "the normal equations are not positive definite";
                else if (!usable) report.failure = "a step was not finite";
                break;
            }
            lm = std::max(10.0 * lm, 1e-6);
            continue;
        }
        rejected = 0;
        if (options.adaptive) lm = std::max(lm / 5.0, 1e-9);
        const double gain = report.cost - cost;
        state = std::move(candidate);
        ++report.steps;
        ++n;
        const bool done = options.adaptive && gain <= options.tolerance * report.cost;
        report.cost = cost;
        if (done || (n == options.steps && options.adaptive)) break;
        adjuster.linearize(state, normal);
        report.cost = normal.cost;
    }
    diagonal.assign(state.inverse_depth.size(), 0.0);
    for (int k = 0; k < problem.keyframes; ++k) {
        const std::vector<double>& c = normal.sources[k].diagonal;
        for (size_t m = 0; m < c.size(); ++m) {
            const size_t at = static_cast<size_t>(k) * problem.cells + m;
            diagonal[at] = std::max(0.0, c[m] - problem.damping[at]);
        }
    }
    return report;
}

}  // namespace mvsgs
