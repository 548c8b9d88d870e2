// What observations refer to is checked here; what the sums are of, their maker knows.
#include "sparse_module.hpp"

#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "bindings.hpp"
#include "sparse_adjustment.hpp"

using namespace bindings;
using namespace mvsgs;

static Observations observations(Array<double> poses, Array<double> points, Array<double> lenses, double k1, double k2,
                                 Array<int64_t> photograph, Array<int64_t> point, Array<double> pixels, double min_z) {
    const int64_t count = photograph.shape(0), photographs = poses.shape(0), known = points.shape(0);
    require(static_cast<int64_t>(point.size()) == count && static_cast<int64_t>(pixels.size()) == 2 * count &&
                static_cast<int64_t>(poses.size()) == 16 * photographs &&
                static_cast<int64_t>(points.size()) == 3 * known &&
                static_cast<int64_t>(lenses.size()) == 4 * photographs,
            "sparse adjustment: observations, poses, points and lenses do not belong together");
    for (int64_t n = 0; n < count; ++n)
        require(photograph.data()[n] >= 0 && photograph.data()[n] < photographs && point.data()[n] >= 0 &&
                    point.data()[n] < known && (n == 0 || point.data()[n - 1] <= point.data()[n]),
                "sparse adjustment: observations must be of photographs and points that are there, sorted by point");
    return {poses.data(), points.data(), lenses.data(), k1, k2, photograph.data(), point.data(), pixels.data(),
            count, min_z};
}

// Residuals (N, 2) and depths (N).
static nb::tuple sparse_residuals(Array<double> poses, Array<double> points, Array<double> lenses, double k1, double k2,
                                  Array<int64_t> photograph, Array<int64_t> point, Array<double> pixels, double min_z) {
    const Observations seen = observations(poses, points, lenses, k1, k2, photograph, point, pixels, min_z);
    const size_t count = seen.count;
    auto residual = allocate<double>({count, 2});
    auto depth = allocate<double>({count});
    {
        nb::gil_scoped_release release;
        Linear at;
        for (size_t n = 0; n < count; ++n) {
            linearize(seen, n, false, at);
            std::copy_n(at.residual, 2, residual.data() + 2 * n);
            depth.data()[n] = at.z;
        }
    }
    return nb::make_tuple(residual, depth);
}

// Derivatives of the projection: (N, 2, 6), (N, 2, 3) and (N, 2, 3).
static nb::tuple sparse_derivatives(Array<double> poses, Array<double> points, Array<double> lenses, double k1,
                                    double k2, Array<int64_t> photograph, Array<int64_t> point, Array<double> pixels,
                                    double min_z) {
    const Observations seen = observations(poses, points, lenses, k1, k2, photograph, point, pixels, min_z);
    const size_t count = seen.count;
    auto of_pose = allocate<double>({count, 2, POSE}), of_point = allocate<double>({count, 2, POINT});
    auto of_lens = allocate<double>({count, 2, LENS});
    for (size_t n = 0; n < count; ++n) {
        Linear at;
        linearize(seen, n, true, at);
        std::copy_n(&at.pose[0][0], 2 * POSE, of_pose.data() + 2 * POSE * n);
        std::copy_n(&at.point[0][0], 2 * POINT, of_point.data() + 2 * POINT * n);
        std::copy_n(&at.lens[0][0], 2 * LENS, of_lens.data() + 2 * LENS * n);
    }
    return nb::make_tuple(of_pose, of_point, of_lens);
}

static nb::dict sparse_normal(Array<double> poses, Array<double> points, Array<double> lenses, double k1, double k2,
                              Array<int64_t> photograph, Array<int64_t> point, Array<double> pixels, double min_z,
                              Array<int64_t> column, int free_poses, const std::vector<int>& shared, double scale) {
    const Observations seen = observations(poses, points, lenses, k1, k2, photograph, point, pixels, min_z);
    require(column.shape(0) == poses.shape(0), "sparse_normal: a column of each photograph");
    for (size_t n = 0; n < column.size(); ++n)
        require(column.data()[n] < free_poses, "sparse_normal: no such free pose");
    const Sizes sizes{static_cast<int64_t>(points.shape(0)), free_poses, shared};
    Normal sums;
    {
        nb::gil_scoped_release release;
        sums = normal_equations(seen, column.data(), sizes, scale);
    }
    const size_t count = seen.count, known = sizes.points, poses_there = free_poses, width = sizes.others();
    nb::dict result;
    result["point_pose"] = to_numpy(std::move(sums.point_pose), {count, POINT, POSE});
    result["point_point"] = to_numpy(std::move(sums.point_point), {known, POINT, POINT});
    result["point_others"] = to_numpy(std::move(sums.point_others), {known, POINT, width});
    result["pose_pose"] = to_numpy(std::move(sums.pose_pose), {poses_there, POSE, POSE});
    result["pose_others"] = to_numpy(std::move(sums.pose_others), {poses_there, POSE, width});
    result["others"] = to_numpy(std::move(sums.others), {width - 1, width});
    return result;
}

static Sums sums_of(Array<double> point_pose, Array<double> point_point, Array<double> point_others,
                    Array<double> pose_pose, Array<double> pose_others, Array<double> others, Array<int64_t> point,
                    Array<int64_t> column) {
    return {point_pose.data(), point_point.data(), point_others.data(), pose_pose.data(), pose_others.data(),
            others.data(), point.data(), column.data(), static_cast<int64_t>(point.shape(0)),
            static_cast<int64_t>(point_point.shape(0)), static_cast<int>(pose_pose.shape(0)),
            static_cast<int>(others.shape(0))};
}

// Matrix (S, S) and right side (S) of the poses and the lens, and the points' inverse blocks (M, 3, 3).
static nb::tuple sparse_reduce(Array<double> point_pose, Array<double> point_point, Array<double> point_others,
                               Array<double> pose_pose, Array<double> pose_others, Array<double> others,
                               Array<int64_t> point, Array<int64_t> column, double damping, bool free_points) {
    const Sums sums = sums_of(point_pose, point_point, point_others, pose_pose, pose_others, others, point, column);
    const size_t size = static_cast<size_t>(POSE) * sums.poses + sums.lens, known = sums.points;
    std::vector<double> matrix(size * size, 0.0), rhs(size, 0.0), inverse(known * POINT * POINT, 0.0);
    {
        nb::gil_scoped_release release;
        reduce(sums, damping, free_points, matrix.data(), rhs.data(), inverse.data());
    }
    return nb::make_tuple(to_numpy(std::move(matrix), {size, size}), to_numpy(std::move(rhs), {size}),
                          to_numpy(std::move(inverse), {known, POINT, POINT}));
}

static Result<double> sparse_shift(Array<double> point_pose, Array<double> point_point, Array<double> point_others,
                                   Array<double> pose_pose, Array<double> pose_others, Array<double> others,
                                   Array<int64_t> point, Array<int64_t> column, Array<double> inverse,
                                   Array<double> twists, Array<double> change) {
    const Sums sums = sums_of(point_pose, point_point, point_others, pose_pose, pose_others, others, point, column);
    require(static_cast<int>(twists.shape(0)) == sums.poses && static_cast<int>(change.size()) == sums.lens,
            "sparse_shift: a twist of each free pose, and a change of each of the lens");
    auto shift = allocate<double>({static_cast<size_t>(sums.points), POINT});
    nb::gil_scoped_release release;
    shift_points(sums, inverse.data(), twists.data(), change.data(), shift.data());
    return shift;
}

void define_sparse_adjustment(nb::module_& m) {
    m.def("sparse_residuals", &sparse_residuals, nb::arg("poses"), nb::arg("points"), nb::arg("lenses"), nb::arg("k1"),
          nb::arg("k2"), nb::arg("photograph"), nb::arg("point"), nb::arg("pixels"), nb::arg("min_z"));
    m.def("sparse_derivatives", &sparse_derivatives, nb::arg("poses"), nb::arg("points"), nb::arg("lenses"),
          nb::arg("k1"), nb::arg("k2"), nb::arg("photograph"), nb::arg("point"), nb::arg("pixels"), nb::arg("min_z"));
    m.def("sparse_normal", &sparse_normal, nb::arg("poses"), nb::arg("points"), nb::arg("lenses"), nb::arg("k1"),
          nb::arg("k2"), nb::arg("photograph"), nb::arg("point"), nb::arg("pixels"), nb::arg("min_z"),
          nb::arg("column"), nb::arg("free_poses"), nb::arg("shared"), nb::arg("scale"));
    m.def("sparse_reduce", &sparse_reduce, nb::arg("point_pose"), nb::arg("point_point"), nb::arg("point_others"),
          nb::arg("pose_pose"), nb::arg("pose_others"), nb::arg("others"), nb::arg("point"), nb::arg("column"),
          nb::arg("damping"), nb::arg("free_points"));
    m.def("sparse_shift", &sparse_shift, nb::arg("point_pose"), nb::arg("point_point"), nb::arg("point_others"),
          nb::arg("pose_pose"), nb::arg("pose_others"), nb::arg("others"), nb::arg("point"), nb::arg("column"),
          nb::arg("inverse"), nb::arg("twists"), nb::arg("change"));
}
