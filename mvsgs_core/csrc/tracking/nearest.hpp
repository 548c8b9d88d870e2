// For each query point, the median value of its nearest neighbors: coarse depth carried to a new keyframe.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace mvsgs {

// points (n, 2), values (n), queries (m, 2). NaN where no point lies within `radius`; what is NaN is no point or value.
inline std::vector<double> nearest_medians(const double* points, const double* values, int n, const double* queries,
                                           int m, int count, double radius) {
    std::vector<double> out(m, std::numeric_limits<double>::quiet_NaN());
    std::vector<double> distance(n);
    std::vector<std::pair<double, double>> best;
    for (int q = 0; q < m; ++q) {
        const double u = queries[2 * q], v = queries[2 * q + 1];
        for (int k = 0; k < n; ++k) {
            const double dx = points[2 * k] - u, dy = points[2 * k + 1] - v;
            distance[k] = dx * dx + dy * dy;
        }
        best.clear();
        double limit = radius * radius;
        for (int k = 0; k < n; ++k) {
            if (!(distance[k] <= limit) || std::isnan(values[k])) continue;
            auto at = std::upper_bound(best.begin(), best.end(), std::make_pair(distance[k], values[k]));
            best.insert(at, {distance[k], values[k]});
            if (static_cast<int>(best.size()) > count) best.pop_back();
            if (static_cast<int>(best.size()) == count) limit = best.back().first;
        }
        if (best.empty()) continue;
        std::vector<double> v_sorted;
        for (const auto& b : best) v_sorted.push_back(b.second);
        std::sort(v_sorted.begin(), v_sorted.end());
        out[q] = v_sorted[v_sorted.size() / 2];
    }
    return out;
}

}  // namespace mvsgs
