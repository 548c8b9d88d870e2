#include "sparse_adjustment.hpp"

#include <algorithm>
#include <cmath>

namespace mvsgs {

void linearize(const Observations& seen, int64_t n, bool derivatives, Linear& out) {
    const double* t = seen.poses + 16 * seen.photograph[n];
    const double* x = seen.points + 3 * seen.point[n];
    const double* lens = seen.lenses + 4 * seen.photograph[n];
    double at[3];
    for (int r = 0; r < 3; ++r) at[r] = t[4 * r] * x[0] + t[4 * r + 1] * x[1] + t[4 * r + 2] * x[2] + t[4 * r + 3];
    const bool front = at[2] > seen.min_z;
    out.z = at[2];
    const double q = 1.0 / at[2], a = at[0] * q, b = at[1] * q;
    const double fx = lens[0], fy = lens[1], r2 = a * a + b * b;
    const double bend = 1.0 + r2 * (seen.k1 + r2 * seen.k2);
    out.residual[0] = front ? seen.pixels[2 * n] - (fx * bend * a + lens[2]) : 0.0;
    out.residual[1] = front ? seen.pixels[2 * n + 1] - (fy * bend * b + lens[3]) : 0.0;
    if (!derivatives) return;
    const double slope = 2.0 * (seen.k1 + 2.0 * r2 * seen.k2);  // of bend by r2, doubled
    const double bent[2][2] = {{fx * (bend + slope * a * a), fx * slope * a * b},
                               {fy * slope * a * b, fy * (bend + slope * b * b)}};
    const double image[2] = {fx * a, fy * b};
    for (int k = 0; k < 2; ++k) {
        const double u = bent[k][0] * q, v = bent[k][1] * q, w = -(u * a + v * b);
        const double by[3] = {u, v, w};  // by the point before the camera
        const double turn[3] = {at[1] * w - at[2] * v, at[2] * u - at[0] * w, at[0] * v - at[1] * u};
        std::copy_n(by, 3, out.pose[k]);
        std::copy_n(turn, 3, out.pose[k] + 3);
        for (int c = 0; c < 3; ++c) out.point[k][c] = u * t[c] + v * t[4 + c] + w * t[8 + c];
        out.lens[k][0] = image[k] * bend;
        out.lens[k][1] = image[k] * r2;
        out.lens[k][2] = image[k] * r2 * r2;
    }
}

Normal normal_equations(const Observations& seen, const int64_t* column, const Sizes& sizes, double scale) {
    const int lens = static_cast<int>(sizes.shared.size()), width = sizes.others();
    Normal sums;
    sums.point_pose.resize(static_cast<size_t>(seen.count) * POINT * POSE);
    sums.point_point.assign(static_cast<size_t>(sizes.points) * POINT * POINT, 0.0);
    sums.point_others.assign(static_cast<size_t>(sizes.points) * POINT * width, 0.0);
    sums.pose_pose.assign(static_cast<size_t>(sizes.poses) * POSE * POSE, 0.0);
    sums.pose_others.assign(static_cast<size_t>(sizes.poses) * POSE * width, 0.0);
    sums.others.assign(static_cast<size_t>(lens) * width, 0.0);
    for (int64_t n = 0; n < seen.count; ++n) {
        Linear at;
        linearize(seen, n, true, at);
        const double squared = at.residual[0] * at.residual[0] + at.residual[1] * at.residual[1];
        const double weight = 1.0 / (1.0 + squared / (scale * scale));
        double others[2][LENS + 1];
        for (int k = 0; k < 2; ++k) {
            for (int j = 0; j < lens; ++j) others[k][j] = weight * at.lens[k][sizes.shared[j]];
            others[k][lens] = weight * at.residual[k];
        }
        double* v = &sums.point_point[seen.point[n] * POINT * POINT];
        double* of_point = &sums.point_others[seen.point[n] * POINT * width];
        double* w = &sums.point_pose[n * POINT * POSE];
        for (int i = 0; i < POINT; ++i) {
            const double first = weight * at.point[0][i], second = weight * at.point[1][i];
            for (int j = 0; j < POSE; ++j) w[POSE * i + j] = first * at.pose[0][j] + second * at.pose[1][j];
            for (int j = 0; j < POINT; ++j) v[POINT * i + j] += first * at.point[0][j] + second * at.point[1][j];
            for (int j = 0; j < width; ++j)
                of_point[width * i + j] += at.point[0][i] * others[0][j] + at.point[1][i] * others[1][j];
        }
        for (int i = 0; i < lens; ++i)
            for (int j = 0; j < width; ++j)
                for (int k = 0; k < 2; ++k)
                    sums.others[width * i + j] += at.lens[k][sizes.shared[i]] * others[k][j];
        const int64_t pose = column[seen.photograph[n]];
        if (pose < 0) continue;
        double* u = &sums.pose_pose[pose * POSE * POSE];
        double* of_pose = &sums.pose_others[pose * POSE * width];
        for (int i = 0; i < POSE; ++i) {
            const double first = weight * at.pose[0][i], second = weight * at.pose[1][i];
            for (int j = 0; j < POSE; ++j) u[POSE * i + j] += first * at.pose[0][j] + second * at.pose[1][j];
            for (int j = 0; j < width; ++j)
                of_pose[width * i + j] += at.pose[0][i] * others[0][j] + at.pose[1][i] * others[1][j];
        }
    }
    return sums;
}

// Of a symmetric matrix, by cofactors.
static void invert(const double* m, double* out) {
    const double c00 = m[4] * m[8] - m[5] * m[5], c01 = m[2] * m[5] - m[1] * m[8], c02 = m[1] * m[5] - m[2] * m[4];
    const double scale = 1.0 / (m[0] * c00 + m[1] * c01 + m[2] * c02);
    out[0] = c00 * scale;
    out[1] = out[3] = c01 * scale;
    out[2] = out[6] = c02 * scale;
    out[4] = (m[0] * m[8] - m[2] * m[2]) * scale;
    out[5] = out[7] = (m[1] * m[2] - m[0] * m[5]) * scale;
    out[8] = (m[0] * m[4] - m[1] * m[1]) * scale;
}

void reduce(const Sums& sums, double damping, bool free_points, double* matrix, double* rhs, double* inverse) {
    const int lens = sums.lens, width = lens + 1;
    const int64_t size = static_cast<int64_t>(POSE) * sums.poses + lens, at = size - lens;
    for (int f = 0; f < sums.poses; ++f)
        for (int i = 0; i < POSE; ++i) {
            const int64_t row = static_cast<int64_t>(POSE) * f + i;
            const double* others = sums.pose_others + row * width;
            std::copy_n(sums.pose_pose + row * POSE, POSE, matrix + row * size + POSE * f);
            std::copy_n(others, lens, matrix + row * size + at);
            rhs[row] = others[lens];
        }
    for (int i = 0; i < lens; ++i) {
        std::copy_n(sums.others + i * width, lens, matrix + (at + i) * size + at);
        rhs[at + i] = sums.others[i * width + lens];
    }
    std::vector<double> coupled;  // (n, 3, 6) of the observations of one point in free poses
    std::vector<int64_t> of;      // (n) these poses
    for (int64_t begin = 0, end; begin < sums.count && free_points; begin = end) {
        const int64_t point = sums.point[begin];
        for (end = begin; end < sums.count && sums.point[end] == point;) ++end;
        double damped[POINT * POINT];
        std::copy_n(sums.point_point + point * POINT * POINT, POINT * POINT, damped);
        for (int i = 0; i < POINT; ++i) damped[4 * i] += damping * damped[4 * i] + 1e-12;
        double* v = inverse + point * POINT * POINT;
        invert(damped, v);
        coupled.clear();
        of.clear();
        for (int64_t n = begin; n < end; ++n) {
            if (sums.column[n] < 0) continue;
            of.push_back(sums.column[n]);
            const double* w = sums.point_pose + n * POINT * POSE;
            for (int i = 0; i < POINT; ++i)
                for (int j = 0; j < POSE; ++j)
                    coupled.push_back(v[3 * i] * w[j] + v[3 * i + 1] * w[POSE + j] + v[3 * i + 2] * w[2 * POSE + j]);
        }
        const double* others = sums.point_others + point * POINT * width;
        size_t first = 0;
        for (int64_t n = begin; n < end; ++n) {
            if (sums.column[n] < 0) continue;
            const double* w = sums.point_pose + n * POINT * POSE;
            const int64_t row = POSE * of[first];
            for (size_t second = 0; second < of.size(); ++second) {
                const int64_t column = POSE * of[second];
                if (column < row) continue;  // the upper half alone, of which a pose's own block is whole
                const double* c = &coupled[second * POINT * POSE];
                for (int i = 0; i < POSE; ++i) {
                    double* out = matrix + (row + i) * size + column;
                    const double x = w[i], y = w[POSE + i], z = w[2 * POSE + i];
                    for (int j = 0; j < POSE; ++j) out[j] -= x * c[j] + y * c[POSE + j] + z * c[2 * POSE + j];
                }
            }
            const double* c = &coupled[first * POINT * POSE];
            for (int i = 0; i < POSE; ++i) {
                double* out = matrix + (row + i) * size + at;
                for (int j = 0; j < width; ++j) {
                    double through = 0.0;
                    for (int k = 0; k < POINT; ++k) through += c[POSE * k + i] * others[width * k + j];
                    (j < lens ? out[j] : rhs[row + i]) -= through;
                }
            }
            ++first;
        }
        for (int j = 0; j < width; ++j) {
            double solved[POINT];
            for (int k = 0; k < POINT; ++k) {
                solved[k] = 0.0;
                for (int l = 0; l < POINT; ++l) solved[k] += v[3 * k + l] * others[width * l + j];
            }
            for (int i = 0; i < lens; ++i)
                for (int k = 0; k < POINT; ++k)
                    (j < lens ? matrix[(at + i) * size + at + j] : rhs[at + i]) -= others[width * k + i] * solved[k];
        }
    }
    for (int64_t row = 0; row < size; ++row)
        for (int64_t column = 0; column < row; ++column) matrix[row * size + column] = matrix[column * size + row];
}

void shift_points(const Sums& sums, const double* inverse, const double* twists, const double* change, double* shift) {
    const int lens = sums.lens, width = lens + 1;
    std::vector<double> pull(static_cast<size_t>(sums.points) * POINT);
    for (int64_t row = 0; row < POINT * sums.points; ++row) {
        pull[row] = sums.point_others[row * width + lens];
        for (int j = 0; j < lens; ++j) pull[row] -= sums.point_others[row * width + j] * change[j];
    }
    for (int64_t n = 0; n < sums.count; ++n) {
        if (sums.column[n] < 0) continue;
        const double* w = sums.point_pose + n * POINT * POSE;
        const double* twist = twists + POSE * sums.column[n];
        for (int i = 0; i < POINT; ++i)
            for (int j = 0; j < POSE; ++j) pull[POINT * sums.point[n] + i] -= w[POSE * i + j] * twist[j];
    }
    for (int64_t m = 0; m < sums.points; ++m)
        for (int i = 0; i < POINT; ++i) {
            const double *row = inverse + (POINT * m + i) * POINT, *p = &pull[POINT * m];
            shift[POINT * m + i] = row[0] * p[0] + row[1] * p[1] + row[2] * p[2];
        }
}

}  // namespace mvsgs
