// Cholesky factorization of a dense symmetric matrix with a row envelope: keyframe graphs are nearly banded.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

namespace mvsgs {

// Solves A x = b in place of b; `a` (n, n) row-major, lower triangle, is overwritten by its factor.
// Returns the smallest pivot relative to its diagonal entry: near 0 means ill-conditioned, and a value <= 0
// that the matrix is not positive definite (b is then meaningless).
inline double cholesky_solve(std::vector<double>& a, std::vector<double>& b, int n) {
    std::vector<int> first(n, 0);
    double smallest = 1.0;
    for (int i = 0; i < n; ++i) {
        double* row = &a[static_cast<size_t>(i) * n];
        int start = 0;
        while (start < i && row[start] == 0.0) ++start;
        first[i] = start;
        for (int j = start; j <= i; ++j) {
            const double* other = &a[static_cast<size_t>(j) * n];
            double dot = 0.0;
            for (int k = std::max(start, first[j]); k < j; ++k) dot += row[k] * other[k];
            if (j < i) {
                row[j] = (row[j] - dot) / other[j];
                continue;
            }
            const double diagonal = row[i], pivot = diagonal - dot;
            const double relative = diagonal > 0.0 ? pivot / diagonal : -1.0;
            if (!(relative > 1e-14)) return std::isfinite(relative) ? std::min(relative, 0.0) : -1.0;
            smallest = std::min(smallest, relative);
            row[i] = std::sqrt(pivot);
        }
    }
    for (int i = 0; i < n; ++i) {
        const double* row = &a[static_cast<size_t>(i) * n];
        double dot = 0.0;
        for (int k = first[i]; k < i; ++k) dot += row[k] * b[k];
        b[i] = (b[i] - dot) / row[i];
    }
    for (int i = n - 1; i >= 0; --i) {
        const double* row = &a[static_cast<size_t>(i) * n];
        b[i] /= row[i];
        for (int k = first[i]; k < i; ++k) b[k] -= row[k] * b[i];
    }
    return smallest;
}

}  // namespace mvsgs
