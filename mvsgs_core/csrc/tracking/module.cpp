// Python bindings of the tracking kernels. Lists of points are checked here, all other shapes by the Python callers.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>

#include "bindings.hpp"
#include "bundle_adjustment.hpp"
#include "cholesky.hpp"
#include "hamming.hpp"
#include "lucas_kanade.hpp"
#include "nearest.hpp"
#include "optimize.hpp"
#include "sparse_module.hpp"

using namespace bindings;
using namespace mvsgs;

template <class T>
static bool is_pairs(const Array<T>& array) {
    return array.ndim() == 2 && array.shape(1) == 2;
}

static nb::dict bundle_adjust(Array<double> poses, Array<double> inverse_depth, Array<double> pixels,
                              Array<double> intrinsics, Array<int32_t> from, Array<int32_t> to, Array<double> target,
                              Array<double> information, Array<uint8_t> free_pose, Array<uint8_t> free_depth,
                              Array<double> damping, std::optional<Array<double>> prior,
                              std::optional<Array<double>> prior_weight,
                              bool free_focal, int robust, double robust_scale, double min_z,
                              double min_inverse_depth, int steps, bool adaptive, double lm, double ep,
                              double tolerance, int threads) {
    Problem p;
    p.keyframes = static_cast<int>(inverse_depth.shape(0));
    p.cells = static_cast<int>(inverse_depth.shape(1));
    p.edges = static_cast<int>(from.shape(0));
    p.channels = p.edges ? static_cast<int>(information.shape(1)) : 2;
    p.pixels = pixels.data();
    std::copy_n(intrinsics.data(), 4, p.intrinsics);
    p.from = from.data();
    p.to = to.data();
    p.target = target.data();
    p.information = information.data();
    p.free_pose = free_pose.data();
    p.free_depth = free_depth.data();
    p.damping = damping.data();
    p.prior = prior ? prior->data() : nullptr;
    p.prior_weight = prior_weight ? prior_weight->data() : nullptr;
    p.free_focal = free_focal;
    p.robust = static_cast<Robust>(robust);
    p.robust_scale = robust_scale;
    p.min_z = min_z;
    p.threads = std::max(1, threads);
    State state;
    for (int k = 0; k < p.keyframes; ++k) {
        const double* t = poses.data() + 16 * k;
        for (int r = 0; r < 3; ++r) {
            state.rotation.insert(state.rotation.end(), {t[4 * r], t[4 * r + 1], t[4 * r + 2]});
            state.translation.push_back(t[4 * r + 3]);
        }
    }
    state.inverse_depth.assign(inverse_depth.data(), inverse_depth.data() + inverse_depth.size());
    Report report;
    std::vector<double> diagonal;
    {
        nb::gil_scoped_release release;
        report = optimize(p, {steps, adaptive, lm, ep, tolerance, min_inverse_depth}, state, diagonal);
    }
    std::vector<double> matrices(static_cast<size_t>(16) * p.keyframes, 0.0);
    for (int k = 0; k < p.keyframes; ++k) {
        double* t = &matrices[16 * k];
        for (int r = 0; r < 3; ++r) {
            std::copy_n(&state.rotation[9 * k + 3 * r], 3, t + 4 * r);
            t[4 * r + 3] = state.translation[3 * k + r];
        }
        t[15] = 1.0;
    }
    const size_t keyframes = p.keyframes, cells = p.cells;
    nb::dict result;
    result["poses"] = to_numpy(std::move(matrices), {keyframes, 4, 4});
    result["inverse_depth"] = to_numpy(std::move(state.inverse_depth), {keyframes, cells});
    result["information"] = to_numpy(std::move(diagonal), {keyframes, cells});
    result["focal_factor"] = state.focal_factor;
    result["initial_cost"] = report.initial_cost;
    result["cost"] = report.cost;
    result["steps"] = report.steps;
    result["smallest_pivot"] = report.smallest_pivot;
    result["failure"] = report.failure;
    return result;
}

static Pyramid pyramid(const std::vector<Array<float>>& levels, int border) {
    Pyramid p{{}, border};
    for (const auto& level : levels) {
        const int h = static_cast<int>(level.shape(0)), w = static_cast<int>(level.shape(1));
        p.levels.push_back({level.data(), h - 2 * border, w - 2 * border, w});
    }
    return p;
}

// (N, 4) float32: u, v, forward-backward distance (infinite where lost), correlation.
static Result<float> lucas_kanade(const std::vector<Array<float>>& a, const std::vector<Array<float>>& b,
                                  Array<float> points, Array<float> guess, int border, int start_level, int iterations,
                                  float window_sigma, float min_eigenvalue, int threads) {
    require(is_pairs(points) && is_pairs(guess) && guess.shape(0) == points.shape(0),
            "lucas_kanade: points and guess must be (N, 2), of one length");
    const Pyramid pa = pyramid(a, border), pb = pyramid(b, border);
    const int levels = static_cast<int>(std::min(pa.levels.size(), pb.levels.size()));
    const TrackOptions options{std::min(start_level, levels - 1), iterations, window_sigma, min_eigenvalue};
    const int n = static_cast<int>(points.shape(0));
    std::vector<float> out(static_cast<size_t>(4) * n);
    {
        nb::gil_scoped_release release;
#pragma omp parallel for schedule(static) num_threads(threads) if (threads > 1)
        for (int k = 0; k < n; ++k) {
            const float u = points.data()[2 * k], v = points.data()[2 * k + 1];
            const float gu = guess.data()[2 * k], gv = guess.data()[2 * k + 1];
            const Tracked there = track_point(pa, pb, u, v, gu, gv, options);
            float distance = INFINITY;
            if (there.found) {
                // Back from as wrong a guess as the way out had: starting at the answer would prove nothing.
                const Tracked back =
                    track_point(pb, pa, there.u, there.v, there.u + (u - gu), there.v + (v - gv), options);
                if (back.found) distance = std::hypot(back.u - u, back.v - v);
            }
            const float row[4] = {there.u, there.v, distance, there.correlation};
            std::copy_n(row, 4, &out[static_cast<size_t>(4) * k]);
        }
    }
    return to_numpy(std::move(out), {static_cast<size_t>(n), 4});
}

static Result<double> median_of_nearest(Array<double> points, Array<double> values, Array<double> queries, int count,
                                        double radius) {
    require(is_pairs(points) && is_pairs(queries) && values.ndim() == 1 && values.shape(0) == points.shape(0),
            "median_of_nearest: points must be (N, 2), values (N,) and queries (M, 2)");
    const int n = static_cast<int>(points.shape(0)), m = static_cast<int>(queries.shape(0));
    std::vector<double> out;
    {
        nb::gil_scoped_release release;
        out = nearest_medians(points.data(), values.data(), n, queries.data(), m, count, radius);
    }
    return to_numpy(std::move(out), {static_cast<size_t>(m)});
}

// (P, 2) rows of two lists of binary descriptors that match.
static Result<int64_t> match_binary(Array<uint8_t> a, Array<uint8_t> b, int limit, double ratio) {
    for (const auto& descriptors : {a, b})
        require(descriptors.ndim() == 2 && descriptors.shape(1) == DESCRIPTOR_BYTES,
                "match_binary: descriptors must be (N, 32)");
    const int n = static_cast<int>(a.shape(0)), m = static_cast<int>(b.shape(0));
    std::vector<int64_t> out;
    {
        nb::gil_scoped_release release;
        out = mutual_matches(a.data(), n, b.data(), m, limit, ratio);
    }
    const size_t pairs = out.size() / 2;
    return to_numpy(std::move(out), {pairs, 2});
}

// Solution (N) of A x = b and the smallest relative pivot: a serial solve, which a busy machine does not slow down.
static nb::tuple solve_positive_definite(Array<double> a, Array<double> b) {
    std::vector<double> matrix(a.data(), a.data() + a.size()), x(b.data(), b.data() + b.size());
    double pivot;
    {
        nb::gil_scoped_release release;
        pivot = cholesky_solve(matrix, x, static_cast<int>(x.size()));
    }
    const size_t n = x.size();
    return nb::make_tuple(to_numpy(std::move(x), {n}), pivot);
}

NB_MODULE(MVSGS_MODULE, m) {
    m.def("bundle_adjust", &bundle_adjust, nb::arg("poses"), nb::arg("inverse_depth"), nb::arg("pixels"),
          nb::arg("intrinsics"), nb::arg("source"), nb::arg("to"), nb::arg("target"), nb::arg("information"),
          nb::arg("free_pose"), nb::arg("free_depth"), nb::arg("damping"), nb::arg("prior").none(),
          nb::arg("prior_weight").none(), nb::arg("free_focal"), nb::arg("robust"), nb::arg("robust_scale"),
          nb::arg("min_z"), nb::arg("min_inverse_depth"), nb::arg("steps"), nb::arg("adaptive"), nb::arg("lm"),
          nb::arg("ep"), nb::arg("tolerance"), nb::arg("threads"));
    m.def("lucas_kanade", &lucas_kanade, nb::arg("a"), nb::arg("b"), nb::arg("points"), nb::arg("guess"),
          nb::arg("border"), nb::arg("start_level"), nb::arg("iterations"), nb::arg("window_sigma"),
          nb::arg("min_eigenvalue"), nb::arg("threads"));
    define_sparse_adjustment(m);
    m.def("solve_positive_definite", &solve_positive_definite, nb::arg("a"), nb::arg("b"));
    m.def("match_binary", &match_binary, nb::arg("a"), nb::arg("b"), nb::arg("limit"), nb::arg("ratio"));
    m.def("median_of_nearest", &median_of_nearest, nb::arg("points"), nb::arg("values"), nb::arg("queries"),
          nb::arg("count"), nb::arg("radius"));
}
