// One directed edge of the graph: residuals, analytic Jacobians and their sums over the cells, eight cells at a time.
#pragma once

#include <cmath>

#include "bundle_adjustment.hpp"
#include "lanes.hpp"

namespace mvsgs {

struct Relative {
    double rotation[9], translation[3];  // T_ij = T_j T_i^-1
};

struct EdgeView {
    Relative relative;
    const double *pixels, *target, *information, *inverse_depth;
    int channels, cells;
};

struct EdgeSums {
    double hessian[21] = {};  // upper triangle, by rows, for the pose of `to`
    double gradient[6] = {};
    double focal_pose[6] = {};
    double focal_hessian = 0.0, focal_gradient = 0.0, cost = 0.0;
};

struct EdgeOutput {
    double* coupling;  // (7, M) overwritten: inverse depth against the pose of `to`, and the focal length; or null
    double *diagonal, *gradient;  // (M) added to, or null
};

inline Relative relative_pose(const double* ri, const double* ti, const double* rj, const double* tj) {
    Relative p;
    for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) {
            p.rotation[3 * r + c] = rj[3 * r] * ri[3 * c] + rj[3 * r + 1] * ri[3 * c + 1] + rj[3 * r + 2] * ri[3 * c + 2];
        }
    }
    for (int r = 0; r < 3; ++r) {
        const double* row = p.rotation + 3 * r;
        p.translation[r] = tj[r] - (row[0] * ti[0] + row[1] * ti[1] + row[2] * ti[2]);
    }
    return p;
}

// T <- Exp(xi) T with xi = (translation, rotation).
inline void left_update(const double* xi, double* rotation, double* translation) {
    const double x = xi[3], y = xi[4], z = xi[5];
    const double t2 = x * x + y * y + z * z, t = std::sqrt(t2);
    const bool small = t < 1e-4;
    const double a = small ? 1.0 - t2 / 6.0 : std::sin(t) / t;
    const double b = small ? 0.5 - t2 / 24.0 : (1.0 - std::cos(t)) / t2;
    const double c = small ? 1.0 / 6.0 - t2 / 120.0 : (t - std::sin(t)) / (t2 * t);
    const double k[9] = {0, -z, y, z, 0, -x, -y, x, 0};
    double k2[9], r[9], v[9], old[9], t_old[3];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            k2[3 * i + j] = k[3 * i] * k[j] + k[3 * i + 1] * k[3 + j] + k[3 * i + 2] * k[6 + j];
            const double eye = i == j ? 1.0 : 0.0;
            r[3 * i + j] = eye + a * k[3 * i + j] + b * k2[3 * i + j];
            v[3 * i + j] = eye + b * k[3 * i + j] + c * k2[3 * i + j];
            old[3 * i + j] = rotation[3 * i + j];
        }
        t_old[i] = translation[i];
    }
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            rotation[3 * i + j] = r[3 * i] * old[j] + r[3 * i + 1] * old[3 + j] + r[3 * i + 2] * old[6 + j];
        }
        translation[i] = r[3 * i] * t_old[0] + r[3 * i + 1] * t_old[1] + r[3 * i + 2] * t_old[2] + v[3 * i] * xi[0] +
                         v[3 * i + 1] * xi[1] + v[3 * i + 2] * xi[2];
    }
}

// What eight cells of an edge give: projection, residual and 2x2 weight.
struct Lanes {
    vd x, y, q, a, b, d, ru, rv, wxx, wxy, wyy, s2;
};

inline Lanes project_lanes(const EdgeView& e, const double* k, double min_z, int m, int n) {
    const double* r = e.relative.rotation;
    const double* t = e.relative.translation;
    const size_t cells = e.cells;
    Lanes l;
    l.x = (load(e.pixels + m, n) - splat(k[2])) / splat(k[0]);
    l.y = (load(e.pixels + cells + m, n) - splat(k[3])) / splat(k[1]);
    l.d = load(e.inverse_depth + m, n);
    const vd p0 = r[0] * l.x + r[1] * l.y + r[2] + l.d * t[0];
    const vd p1 = r[3] * l.x + r[4] * l.y + r[5] + l.d * t[1];
    const vd p2 = r[6] * l.x + r[7] * l.y + r[8] + l.d * t[2];
    const vl in_front = p2 >= splat(min_z);
    l.q = splat(1.0) / (in_front ? p2 : splat(1.0));
    l.a = p0 * l.q;
    l.b = p1 * l.q;
    const vd zero{};
    l.wxx = load(e.information + m, n);
    l.wyy = load(e.information + (e.channels - 1) * cells + m, n);
    l.wxy = e.channels == 3 ? load(e.information + cells + m, n) : zero;
    const vl counts = in_front & (l.wxx + l.wyy > zero);
    l.wxx = counts ? l.wxx : zero;
    l.wxy = counts ? l.wxy : zero;
    l.wyy = counts ? l.wyy : zero;
    l.ru = counts ? load(e.target + m, n) - (k[0] * l.a + k[2]) : zero;
    l.rv = counts ? load(e.target + cells + m, n) - (k[1] * l.b + k[3]) : zero;
    l.s2 = l.wxx * l.ru * l.ru + 2.0 * l.wxy * l.ru * l.rv + l.wyy * l.rv * l.rv;
    return l;
}

// The robust cost of lanes of squared whitened residuals. Logarithms are taken of products, 16 factors at a time.
class RobustCost {
  public:
    RobustCost(Robust kind, double scale) : kind_(kind), k2_(scale * scale) {}

    // Adds to the cost; returns the weight of iteratively reweighted least squares.
    vd add(vd s2) {
        const vd one = splat(1.0);
        if (kind_ == Robust::kCauchy) {
            const vd g = one + s2 / k2_;
            const vd limit = splat(1e15);
            product_ *= g < limit ? g : limit;
            if (++factors_ == 16) flush();
            return one / g;
        }
        total_ += s2;
        return one;
    }

    double total() {
        flush();
        return sum(total_);
    }

  private:
    void flush() {
        if (!factors_) return;
        for (int k = 0; k < kLanes; ++k) total_[k] += k2_ * std::log(product_[k]);
        product_ = splat(1.0);
        factors_ = 0;
    }

    Robust kind_;
    double k2_;
    vd total_{}, product_ = splat(1.0);
    int factors_ = 0;
};

inline double edge_cost(const EdgeView& e, const double* k, Robust robust, double scale, double min_z) {
    RobustCost cost(robust, scale);
    for (int m = 0; m < e.cells; m += kLanes) {
        cost.add(project_lanes(e, k, min_z, m, std::min(kLanes, e.cells - m)).s2);
    }
    return cost.total();
}

template <bool kFocal>
void linearize_edge(const EdgeView& e, const double* k, Robust robust, double scale, double min_z,
                    const EdgeOutput& out, EdgeSums& sums) {
    RobustCost cost(robust, scale);
    vd hessian[21] = {}, gradient[6] = {}, focal_pose[6] = {}, focal_hessian{}, focal_gradient{};
    const double* r = e.relative.rotation;
    const double* t = e.relative.translation;
    const size_t cells = e.cells;
    for (int m = 0; m < e.cells; m += kLanes) {
        const int n = std::min(kLanes, e.cells - m);
        const Lanes l = project_lanes(e, k, min_z, m, n);
        const vd w = cost.add(l.s2);
        const vd wxx = l.wxx * w, wxy = l.wxy * w, wyy = l.wyy * w;
        const vd zero{}, one = splat(1.0), dq = l.d * l.q, ab = l.a * l.b;
        const vd ju[6] = {k[0] * dq, zero, -k[0] * l.a * dq, -k[0] * ab, k[0] * (one + l.a * l.a), -k[0] * l.b};
        const vd jv[6] = {zero, k[1] * dq, -k[1] * l.b * dq, -k[1] * (one + l.b * l.b), k[1] * ab, k[1] * l.a};
        vd pu[6], pv[6];
        for (int c = 0; c < 6; ++c) {
            pu[c] = wxx * ju[c] + wxy * jv[c];
            pv[c] = wxy * ju[c] + wyy * jv[c];
        }
        for (int p = 0, h = 0; p < 6; ++p) {
            gradient[p] += pu[p] * l.ru + pv[p] * l.rv;
            for (int c = p; c < 6; ++c, ++h) hessian[h] += ju[p] * pu[c] + jv[p] * pv[c];
        }
        // The focal length (its logarithm) moves the ray in `from` and the projection in `to`.
        vd fu{}, fv{};
        if constexpr (kFocal) {
            const vd y0 = -(r[0] * l.x + r[1] * l.y), y1 = -(r[3] * l.x + r[4] * l.y), y2 = -(r[6] * l.x + r[7] * l.y);
            fu = k[0] * (l.a + l.q * (y0 - l.a * y2));
            fv = k[1] * (l.b + l.q * (y1 - l.b * y2));
            for (int c = 0; c < 6; ++c) focal_pose[c] += pu[c] * fu + pv[c] * fv;
            focal_hessian += wxx * fu * fu + 2.0 * wxy * fu * fv + wyy * fv * fv;
            focal_gradient += fu * (wxx * l.ru + wxy * l.rv) + fv * (wxy * l.ru + wyy * l.rv);
        }
        if (!out.diagonal) continue;
        const vd du = k[0] * l.q * (t[0] - l.a * t[2]), dv = k[1] * l.q * (t[1] - l.b * t[2]);
        const vd wu = wxx * du + wxy * dv, wv = wxy * du + wyy * dv;
        store(out.diagonal + m, load(out.diagonal + m, n) + du * wu + dv * wv, n);
        store(out.gradient + m, load(out.gradient + m, n) + wu * l.ru + wv * l.rv, n);
        for (int c = 0; c < 6; ++c) store(out.coupling + c * cells + m, pu[c] * du + pv[c] * dv, n);
        if constexpr (kFocal) store(out.coupling + 6 * cells + m, fu * wu + fv * wv, n);
    }
    for (int h = 0; h < 21; ++h) sums.hessian[h] = sum(hessian[h]);
    for (int c = 0; c < 6; ++c) {
        sums.gradient[c] = sum(gradient[c]);
        sums.focal_pose[c] = sum(focal_pose[c]);
    }
    sums.focal_hessian = sum(focal_hessian);
    sums.focal_gradient = sum(focal_gradient);
    sums.cost = cost.total();
}

}  // namespace mvsgs
