// The per-edge sums moved to the poses' equations, and the Schur complement over one keyframe's inverse depths.
#pragma once

#include <cmath>
#include <vector>

#include "edge_kernel.hpp"
#include "lanes.hpp"

namespace mvsgs {

// adjoint (6, 6) of a relative pose for twists (translation, rotation): [R, [t]x R; 0, R].
inline void adjoint(const Relative& p, double* a) {
    for (int k = 0; k < 36; ++k) a[k] = 0.0;
    const double* r = p.rotation;
    const double* t = p.translation;
    for (int c = 0; c < 3; ++c) {
        for (int k = 0; k < 3; ++k) a[6 * k + c] = a[6 * (k + 3) + c + 3] = r[3 * k + c];
        a[c + 3] = t[1] * r[6 + c] - t[2] * r[3 + c];
        a[6 + c + 3] = t[2] * r[c] - t[0] * r[6 + c];
        a[12 + c + 3] = t[0] * r[3 + c] - t[1] * r[c];
    }
}

// J_i = -J_j Ad(T_ij): one set of sums (for `to`) gives the blocks of both ends. Adds to the lower triangle.
inline void add_edge(const Relative& relative, const EdgeSums& sums, int row_i, int row_j, int row_f, int rows,
                     double* local, double* rhs) {
    double full[36], ad[36], ga[36], gag[36];
    for (int r = 0, n = 0; r < 6; ++r) {
        for (int c = r; c < 6; ++c, ++n) full[6 * r + c] = full[6 * c + r] = sums.hessian[n];
    }
    adjoint(relative, ad);
    for (int r = 0; r < 6; ++r) {  // Ad^T A
        for (int c = 0; c < 6; ++c) {
            double s = 0.0;
            for (int k = 0; k < 6; ++k) s += ad[6 * k + r] * full[6 * k + c];
            ga[6 * r + c] = s;
        }
    }
    for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 6; ++c) {
            double s = 0.0;
            for (int k = 0; k < 6; ++k) s += ga[6 * r + k] * ad[6 * k + c];
            gag[6 * r + c] = s;
        }
    }
    auto at = [&](int r, int c) -> double& { return local[static_cast<size_t>(r) * rows + c]; };
    for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 6; ++c) {
            if (row_j >= 0) at(row_j + r, row_j + c) += full[6 * r + c];
            if (row_i >= 0) at(row_i + r, row_i + c) += gag[6 * r + c];
            if (row_i < 0 || row_j < 0) continue;
            if (row_i > row_j) {
                at(row_i + r, row_j + c) -= ga[6 * r + c];
            } else {
                at(row_j + r, row_i + c) -= ga[6 * c + r];
            }
        }
    }
    for (int r = 0; r < 6; ++r) {
        if (row_j >= 0) rhs[row_j + r] += sums.gradient[r];
        if (row_j >= 0 && row_f >= 0) at(row_f, row_j + r) += sums.focal_pose[r];
        if (row_i < 0) continue;
        double g = 0.0, f = 0.0;
        for (int k = 0; k < 6; ++k) {
            g += ad[6 * k + r] * sums.gradient[k];
            f += ad[6 * k + r] * sums.focal_pose[k];
        }
        rhs[row_i + r] -= g;
        if (row_f >= 0) at(row_f, row_i + r) -= f;
    }
    if (row_f >= 0) {
        at(row_f, row_f) += sums.focal_hessian;
        rhs[row_f] += sums.focal_gradient;
    }
}

// edge (7, M): six rows for the pose of `to`, one for the focal length; coupling (rows, M).
inline void add_coupling(const Relative& relative, const double* edge, int row_i, int row_j, int row_f, int m,
                         double* coupling) {
    double ad[36];
    adjoint(relative, ad);
    if (row_j >= 0) {
        for (int c = 0; c < 6 * m; ++c) coupling[static_cast<size_t>(row_j) * m + c] += edge[c];
    }
    if (row_i >= 0) {
        for (int r = 0; r < 6; ++r) {
            double* out = coupling + static_cast<size_t>(row_i + r) * m;
            for (int k = 0; k < 6; ++k) {
                const double a = ad[6 * k + r];
                if (a == 0.0) continue;
                const double* in = edge + static_cast<size_t>(k) * m;
                for (int c = 0; c < m; ++c) out[c] -= a * in[c];
            }
        }
    }
    if (row_f >= 0) {
        for (int c = 0; c < m; ++c) coupling[static_cast<size_t>(row_f) * m + c] += edge[static_cast<size_t>(6) * m + c];
    }
}

// local -= E C^-1 E^T (lower triangle and a little above), rhs -= E C^-1 w.
inline void subtract_schur(const double* coupling, const double* diagonal, const double* gradient, int rows, int m,
                           double* local, double* rhs) {
    const int padded = (m + kLanes - 1) / kLanes * kLanes;
    const int blocks = (rows + 3) / 4;
    std::vector<double> scaled(static_cast<size_t>(4) * blocks * padded, 0.0), root(m);
    for (int c = 0; c < m; ++c) root[c] = diagonal[c] > 0.0 ? 1.0 / std::sqrt(diagonal[c]) : 0.0;
    for (int r = 0; r < rows; ++r) {
        const double* in = coupling + static_cast<size_t>(r) * m;
        double* out = &scaled[static_cast<size_t>(r) * padded];
        double dot = 0.0;
        for (int c = 0; c < m; ++c) {
            out[c] = in[c] * root[c];
            dot += out[c] * root[c] * gradient[c];
        }
        rhs[r] -= dot;
    }
    for (int a = 0; a < blocks; ++a) {
        for (int b = 0; b <= a; ++b) {
            vd acc[4][4] = {};
            const double* left = &scaled[static_cast<size_t>(4) * a * padded];
            const double* right = &scaled[static_cast<size_t>(4) * b * padded];
            for (int c = 0; c < padded; c += kLanes) {
                vd l[4], r[4];
                for (int k = 0; k < 4; ++k) {
                    l[k] = load(left + static_cast<size_t>(k) * padded + c);
                    r[k] = load(right + static_cast<size_t>(k) * padded + c);
                }
                for (int p = 0; p < 4; ++p) {
                    for (int q = 0; q < 4; ++q) acc[p][q] += l[p] * r[q];
                }
            }
            for (int p = 0; p < 4 && 4 * a + p < rows; ++p) {
                for (int q = 0; q < 4 && 4 * b + q < rows; ++q) {
                    local[static_cast<size_t>(4 * a + p) * rows + 4 * b + q] -= sum(acc[p][q]);
                }
            }
        }
    }
}

}  // namespace mvsgs
