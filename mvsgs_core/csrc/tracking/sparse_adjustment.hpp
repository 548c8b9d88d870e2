// Sparse bundle adjustment of photographs and points: what one step of Levenberg-Marquardt sums up (Triggs et al.
// 2000).
// Points are eliminated by the Schur complement; the lens, which all photographs share, has up to three columns.
#pragma once

#include <cstdint>
#include <vector>

namespace mvsgs {

constexpr int POSE = 6, POINT = 3, LENS = 3;  // unknowns; of the lens: log of the focal factor, k1, k2

struct Observations {
    const double* poses;   // (P, 4, 4) cam_from_world
    const double* points;  // (M, 3)
    const double* lenses;  // (P, 4) fx, fy, cx, cy
    double k1, k2;         // radial distortion
    const int64_t* photograph;  // (N)
    const int64_t* point;       // (N) ascending
    const double* pixels;       // (N, 2)
    int64_t count;
    double min_z;  // a depth that is not above has no residual
};

struct Linear {
    double residual[2], z;
    double pose[2][POSE], point[2][POINT], lens[2][LENS];  // of the projection, by a left twist of the pose, ...
};

// One observation; the derivatives only where they are wanted.
void linearize(const Observations& seen, int64_t n, bool derivatives, Linear& out);

struct Sizes {
    int64_t points;
    int poses;                // free ones
    std::vector<int> shared;  // columns of the lens that are free
    int others() const { return static_cast<int>(shared.size()) + 1; }  // and the gradient, last
};

// Weighed sums over observations; (F) free poses, L columns of the lens.
struct Normal {
    std::vector<double> point_pose;    // (N, 3, 6) of each observation
    std::vector<double> point_point;   // (M, 3, 3)
    std::vector<double> point_others;  // (M, 3, L + 1)
    std::vector<double> pose_pose;     // (F, 6, 6)
    std::vector<double> pose_others;   // (F, 6, L + 1)
    std::vector<double> others;        // (L, L + 1)
};

// column: (P) which free pose a photograph is, -1 for a fixed one. scale: pixels, of the Cauchy loss.
Normal normal_equations(const Observations& seen, const int64_t* column, const Sizes& sizes, double scale);

// What a step needs of the sums.
struct Sums {
    const double *point_pose, *point_point, *point_others, *pose_pose, *pose_others, *others;
    const int64_t* point;   // (N) of each observation
    const int64_t* column;  // (N) its free pose, or -1
    int64_t count;
    int64_t points;
    int poses, lens;
};

// The points' equations, damped, are solved and put into the others'. matrix (S, S) and rhs (S) with S = 6 F + L, both
// zero before; inverse (M, 3, 3), zero where the points are fixed.
void reduce(const Sums& sums, double damping, bool free_points, double* matrix, double* rhs, double* inverse);

// By how much the points move (M, 3) where the poses do by `twists` (F, 6) and the lens by `change` (L).
void shift_points(const Sums& sums, const double* inverse, const double* twists, const double* change, double* shift);

}  // namespace mvsgs
