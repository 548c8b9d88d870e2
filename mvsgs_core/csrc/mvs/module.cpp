// Python bindings of the stereo kernels. Shapes are checked here, once; the interpreter's lock is released inside.
#include "stereo.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <omp.h>

#include <optional>
#include <stdexcept>
#include <string>

#define MVSGS_EXPAND(name, m) NB_MODULE(name, m)

namespace nb = nanobind;

namespace {

using Image = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Stack = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Tiles = nb::ndarray<const std::uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Warps = nb::ndarray<const float, nb::shape<-1, 12>, nb::c_contig, nb::device::cpu>;

int thread_count(int threads) { return threads > 0 ? threads : omp_get_max_threads(); }

void require(bool condition, const char* what) {
    if (!condition) throw std::invalid_argument(what);
}

void same_size(const Image& a, const Image& b) {
    require(a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1), "maps of the reference must have its size");
}

void require_tiles(const std::optional<Tiles>& needed, std::size_t h, std::size_t d, std::size_t w) {
    require(!needed || (needed->shape(0) == (h + stereo::kTileRows - 1) / stereo::kTileRows && needed->shape(1) == d &&
                        needed->shape(2) == (w + stereo::kTileColumns - 1) / stereo::kTileColumns),
            "needed must be (tile rows, D, tile columns)");
}

template <typename T, std::size_t N>
nb::ndarray<nb::numpy, T> allocate(const std::size_t (&shape)[N]) {
    std::size_t size = 1;
    for (std::size_t n : shape) size *= n;
    T* data = new T[size];
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::ndarray<nb::numpy, T>(data, N, shape, owner);
}

nb::ndarray<nb::numpy, float> cost_volume(Image reference, Stack neighbors, Warps warps, Image first, Image step,
                                          int hypotheses, int radius, int best, float noise,
                                          float contrast, float level, float level_range, int threads,
                                          std::optional<Tiles> needed) {
    same_size(reference, first);
    same_size(reference, step);
    require(neighbors.shape(0) == warps.shape(0) && neighbors.shape(0) > 0, "one warp per neighbor, at least one");
    require(neighbors.shape(1) >= 2 && neighbors.shape(2) >= 2, "neighbor images need at least 2x2 pixels");
    require(hypotheses >= 1 && radius >= 0 && radius <= 16 && best >= 1, "bad hypotheses, radius or best");
    require(level >= 0 && level <= 1 && level_range > 0, "bad level");
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = static_cast<std::size_t>(hypotheses);
    require_tiles(needed, h, d, w);
    auto cost = allocate<float>({h, d, w});
    const stereo::CostOptions options{hypotheses, radius, best, noise, contrast, level,
                                      level_range, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::cost_volume(reference.data(), static_cast<int>(h), static_cast<int>(w), neighbors.data(),
                            reinterpret_cast<const stereo::Warp*>(warps.data()), static_cast<int>(neighbors.shape(0)),
                            static_cast<int>(neighbors.shape(1)), static_cast<int>(neighbors.shape(2)), first.data(),
                            step.data(), needed ? needed->data() : nullptr, options, cost.data());
    }
    return cost;
}

nb::ndarray<nb::numpy, float> surface_costs(Image reference, Stack neighbors, Warps warps, Stack surfaces, int radius,
                                            int best, float noise, float contrast, float level, float level_range,
                                            int threads, std::optional<Tiles> needed) {
    require(surfaces.shape(1) == reference.shape(0) && surfaces.shape(2) == reference.shape(1),
            "surfaces must be (D, H, W)");
    require(neighbors.shape(0) == warps.shape(0) && neighbors.shape(0) > 0, "one warp per neighbor, at least one");
    require(neighbors.shape(1) >= 2 && neighbors.shape(2) >= 2, "neighbor images need at least 2x2 pixels");
    require(surfaces.shape(0) >= 1 && radius >= 0 && radius <= 16 && best >= 1, "bad surfaces, radius or best");
    require(level >= 0 && level <= 1 && level_range > 0, "bad level");
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = surfaces.shape(0);
    require_tiles(needed, h, d, w);
    auto cost = allocate<float>({h, d, w});
    const stereo::CostOptions options{static_cast<int>(d), radius, best, noise, contrast, level,
                                      level_range, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::surface_costs(reference.data(), static_cast<int>(h), static_cast<int>(w), neighbors.data(),
                              reinterpret_cast<const stereo::Warp*>(warps.data()), static_cast<int>(neighbors.shape(0)),
                              static_cast<int>(neighbors.shape(1)), static_cast<int>(neighbors.shape(2)),
                              surfaces.data(), needed ? needed->data() : nullptr, options, cost.data());
    }
    return cost;
}

nb::tuple choose_surface(Stack cost, Stack surfaces, Image reference, float p1, float p2, float edge,
                         float apart, int threads) {
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = surfaces.shape(0);
    require(surfaces.shape(1) == h && surfaces.shape(2) == w && d >= 1, "surfaces must be (D, H, W)");
    require(cost.shape(0) == h && cost.shape(1) == d && cost.shape(2) == w, "cost must be (H, D, W)");
    require(edge > 0, "edge must be positive");
    auto best = allocate<std::int32_t>({h, w});
    auto gap = allocate<float>({h, w});
    const stereo::ChooseOptions options{p1, p2, edge, apart, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::choose_surface(cost.data(), surfaces.data(), static_cast<int>(d), static_cast<int>(h),
                               static_cast<int>(w), reference.data(), options, best.data(), gap.data());
    }
    return nb::make_tuple(best, gap);
}

nb::ndarray<nb::numpy, float> view_correlation(Image reference, Stack neighbors, Warps warps, Image inverse_depth,
                                               int radius, float noise, float contrast, int threads) {
    same_size(reference, inverse_depth);
    require(neighbors.shape(0) == warps.shape(0) && neighbors.shape(0) > 0, "one warp per neighbor, at least one");
    require(neighbors.shape(1) >= 2 && neighbors.shape(2) >= 2, "neighbor images need at least 2x2 pixels");
    require(radius >= 0 && radius <= 16, "bad radius");
    const std::size_t h = reference.shape(0), w = reference.shape(1), n = neighbors.shape(0);
    auto correlation = allocate<float>({n, h, w});
    const stereo::CostOptions options{1, radius, 1, noise, contrast, 0.0f, 1.0f, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::view_correlation(reference.data(), static_cast<int>(h), static_cast<int>(w), neighbors.data(),
                                 reinterpret_cast<const stereo::Warp*>(warps.data()), static_cast<int>(n),
                                 static_cast<int>(neighbors.shape(1)), static_cast<int>(neighbors.shape(2)),
                                 inverse_depth.data(), options, correlation.data());
    }
    return correlation;
}

nb::tuple semi_global(Stack cost, Image reference, Image first, Image step, float p1, float p2,
                      float edge, float break_steps, float temperature, int paths, int threads) {
    same_size(reference, first);
    same_size(reference, step);
    require(cost.shape(0) == reference.shape(0) && cost.shape(2) == reference.shape(1), "cost must be (H, D, W)");
    require(paths == 4 || paths == 8, "paths must be 4 or 8");
    require(edge > 0 && temperature > 0, "edge and temperature must be positive");
    const std::size_t h = cost.shape(0), d = cost.shape(1), w = cost.shape(2);
    auto index = allocate<float>({h, w});
    auto probability = allocate<float>({h, w});
    auto margin = allocate<float>({h, w});
    auto best = allocate<std::int32_t>({h, w});
    const stereo::SmoothOptions options{p1, p2, edge, break_steps, temperature, paths,
                                        thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::semi_global(cost.data(), static_cast<int>(h), static_cast<int>(d), static_cast<int>(w),
                            reference.data(), first.data(), step.data(), options, index.data(), probability.data(),
                            margin.data(), best.data());
    }
    return nb::make_tuple(index, probability, margin, best);
}

nb::ndarray<nb::numpy, std::uint8_t> consistent_views(Image depth, Stack neighbor_depths, Warps warps, Warps back,
                                                      float relative, float pixels, bool round_trip, int threads) {
    require(neighbor_depths.shape(0) == warps.shape(0) && warps.shape(0) == back.shape(0), "one warp per neighbor");
    auto count = allocate<std::uint8_t>({depth.shape(0), depth.shape(1)});
    const stereo::ConsistencyOptions options{relative, pixels, round_trip, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::consistent_views(
            depth.data(), static_cast<int>(depth.shape(0)), static_cast<int>(depth.shape(1)), neighbor_depths.data(),
            reinterpret_cast<const stereo::Warp*>(warps.data()), reinterpret_cast<const stereo::Warp*>(back.data()),
            static_cast<int>(warps.shape(0)), static_cast<int>(neighbor_depths.shape(1)),
            static_cast<int>(neighbor_depths.shape(2)), options, count.data());
    }
    return count;
}

nb::ndarray<nb::numpy, float> splat_depths(Stack neighbor_depths, Stack neighbor_confidences, Warps back,
                                           float min_neighbor_confidence, int height, int width, int threads) {
    require(neighbor_depths.shape(0) == back.shape(0), "one warp per neighbor");
    require(neighbor_confidences.size() == neighbor_depths.size(), "one confidence per depth");
    require(height > 0 && width > 0, "the reference needs a size");
    const std::size_t n = back.shape(0), h = static_cast<std::size_t>(height), w = static_cast<std::size_t>(width);
    auto splatted = allocate<float>({n, h, w});
    const int nh = static_cast<int>(neighbor_depths.shape(1)), nw = static_cast<int>(neighbor_depths.shape(2));
    const auto* warps = reinterpret_cast<const stereo::Warp*>(back.data());
    {
        nb::gil_scoped_release release;
        const int views = static_cast<int>(n), team = thread_count(threads);
        const std::size_t stride = static_cast<std::size_t>(nh) * nw;
#pragma omp parallel for schedule(static, 1) num_threads(team)
        for (int i = 0; i < views; ++i)
            stereo::splat_depth(neighbor_depths.data() + i * stride, neighbor_confidences.data() + i * stride, nh, nw,
                                warps[i], min_neighbor_confidence, height, width, splatted.data() + i * h * w);
    }
    return splatted;
}

nb::tuple fuse_depth(Image depth, Image confidence, Stack neighbor_depths, Stack neighbor_confidences, Stack splatted,
                     Warps warps, float sigma, float violation_weight, float min_neighbor_confidence, int threads) {
    same_size(depth, confidence);
    require(neighbor_depths.shape(0) == warps.shape(0) && splatted.shape(0) == warps.shape(0), "one warp per neighbor");
    require(neighbor_confidences.size() == neighbor_depths.size(), "one confidence per depth");
    const std::size_t h = depth.shape(0), w = depth.shape(1);
    require(splatted.shape(1) == h && splatted.shape(2) == w, "splatted depths must have the reference's size");
    auto fused = allocate<float>({h, w});
    auto support = allocate<float>({h, w});
    auto violation = allocate<float>({h, w});
    auto own = allocate<float>({h, w});
    const stereo::FuseOptions options{sigma, violation_weight, min_neighbor_confidence, thread_count(threads)};
    {
        nb::gil_scoped_release release;
        stereo::fuse_depth(depth.data(), confidence.data(), static_cast<int>(h), static_cast<int>(w),
                           neighbor_depths.data(), neighbor_confidences.data(), splatted.data(),
                           reinterpret_cast<const stereo::Warp*>(warps.data()), static_cast<int>(warps.shape(0)),
                           static_cast<int>(neighbor_depths.shape(1)), static_cast<int>(neighbor_depths.shape(2)),
                           options, fused.data(), support.data(), violation.data(), own.data());
    }
    return nb::make_tuple(fused, support, violation, own);
}

}  // namespace

MVSGS_EXPAND(MVSGS_MODULE, m) {
    using namespace nb::literals;
    m.def("cost_volume", &cost_volume, "reference"_a, "neighbors"_a, "warps"_a, "first"_a, "step"_a, "hypotheses"_a,
          "radius"_a, "best"_a, "noise"_a, "contrast"_a, "level"_a = 0.0f, "level_range"_a = 1.0f, "threads"_a = 0,
          "needed"_a = nb::none());
    m.attr("TILE") = nb::make_tuple(stereo::kTileRows, stereo::kTileColumns);
    m.def("view_correlation", &view_correlation, "reference"_a, "neighbors"_a, "warps"_a, "inverse_depth"_a,
          "radius"_a, "noise"_a, "contrast"_a, "threads"_a = 0);
    m.def("surface_costs", &surface_costs, "reference"_a, "neighbors"_a, "warps"_a, "surfaces"_a, "radius"_a, "best"_a,
          "noise"_a, "contrast"_a, "level"_a = 0.0f, "level_range"_a = 1.0f, "threads"_a = 0,
          "needed"_a = nb::none());
    m.def("choose_surface", &choose_surface, "cost"_a, "surfaces"_a, "reference"_a, "p1"_a, "p2"_a,
          "edge"_a, "apart"_a, "threads"_a = 0);
    m.def("semi_global", &semi_global, "cost"_a, "reference"_a, "first"_a, "step"_a, "p1"_a, "p2"_a,
          "edge"_a, "break_steps"_a, "temperature"_a, "paths"_a, "threads"_a = 0);
    m.def("consistent_views", &consistent_views, "depth"_a, "neighbor_depths"_a, "warps"_a, "back"_a, "relative"_a,
          "pixels"_a, "round_trip"_a, "threads"_a = 0);
    m.def("splat_depths", &splat_depths, "neighbor_depths"_a, "neighbor_confidences"_a, "back"_a,
          "min_neighbor_confidence"_a, "height"_a, "width"_a, "threads"_a = 0);
    m.def("fuse_depth", &fuse_depth, "depth"_a, "confidence"_a, "neighbor_depths"_a, "neighbor_confidences"_a,
          "splatted"_a, "warps"_a, "sigma"_a, "violation_weight"_a, "min_neighbor_confidence"_a, "threads"_a = 0);
}
