// Python bindings of the stereo kernels. Shapes are checked here, once; the interpreter's lock is released inside.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <optional>
#include <string>

#include "mvs/arguments.hpp"
#include "mvs/mvs.hpp"

namespace {

using namespace bindings;
using Tiles = Array<std::uint8_t, nb::ndim<3>>;

mvs::Images images_of(const Image& reference, const Stack& neighbors, const Warps& warps) {
    require(neighbors.shape(0) == warps.shape(0) && neighbors.shape(0) > 0, "one warp per neighbor, at least one");
    require(neighbors.shape(1) >= 2 && neighbors.shape(2) >= 2, "neighbor images need at least 2x2 pixels");
    return {reference.data(),     extent(reference, 0), extent(reference, 1), neighbors.data(), data_of(warps),
            extent(neighbors, 0), extent(neighbors, 1), extent(neighbors, 2)};
}

void require_tiles(const std::optional<Tiles>& needed, std::size_t h, std::size_t d, std::size_t w) {
    require(!needed || (needed->shape(0) == (h + mvs::kTileRows - 1) / mvs::kTileRows && needed->shape(1) == d &&
                        needed->shape(2) == (w + mvs::kTileColumns - 1) / mvs::kTileColumns),
            "needed must be (tile rows, D, tile columns)");
}

void check(const mvs::CostOptions& o) {
    require(o.radius >= 0 && o.radius <= 16 && o.top_k >= 1 && o.contrast > 0, "bad radius, top_k or contrast");
    require(o.noise >= 1e-6f && o.noise <= 1e6f, "noise must lie in [1e-6, 1e6]");  // of less, the square may be 0
}

Result<float> cost_volume(Image reference, Stack neighbors, Warps warps, Image first, Image step, int hypotheses,
                          const mvs::CostOptions& options, std::optional<Tiles> needed) {
    same_size(reference, first);
    same_size(reference, step);
    require(hypotheses >= 1, "at least one hypothesis");
    check(options);
    const mvs::Images images = images_of(reference, neighbors, warps);
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = static_cast<std::size_t>(hypotheses);
    require_tiles(needed, h, d, w);
    auto cost = allocate<float>({h, d, w});
    const mvs::CostOptions o = with_threads(options);
    nb::gil_scoped_release release;
    mvs::cost_volume(images, first.data(), step.data(), hypotheses, needed ? needed->data() : nullptr, o, cost.data());
    return cost;
}

Result<float> surface_costs(Image reference, Stack neighbors, Warps warps, Stack surfaces,
                            const mvs::CostOptions& options, std::optional<Tiles> needed) {
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = surfaces.shape(0);
    require(surfaces.shape(1) == h && surfaces.shape(2) == w && d >= 1, "surfaces must be (D, H, W)");
    check(options);
    const mvs::Images images = images_of(reference, neighbors, warps);
    require_tiles(needed, h, d, w);
    auto cost = allocate<float>({h, d, w});
    const mvs::CostOptions o = with_threads(options);
    nb::gil_scoped_release release;
    mvs::surface_costs(images, surfaces.data(), static_cast<int>(d), needed ? needed->data() : nullptr, o, cost.data());
    return cost;
}

Result<float> view_correlation(Image reference, Stack neighbors, Warps warps, Image inverse_depth,
                               const mvs::CostOptions& options) {
    same_size(reference, inverse_depth);
    check(options);
    const mvs::Images images = images_of(reference, neighbors, warps);
    auto correlation = allocate<float>({neighbors.shape(0), reference.shape(0), reference.shape(1)});
    const mvs::CostOptions o = with_threads(options);
    nb::gil_scoped_release release;
    mvs::view_correlation(images, inverse_depth.data(), o, correlation.data());
    return correlation;
}

nb::tuple semi_global(Stack cost, Image reference, Image first, Image step, const mvs::SmoothOptions& options) {
    same_size(reference, first);
    same_size(reference, step);
    const std::size_t h = cost.shape(0), d = cost.shape(1), w = cost.shape(2);
    require(h == reference.shape(0) && w == reference.shape(1) && d >= 1, "cost must be (H, D, W)");
    require(options.paths == 4 || options.paths == 8, "paths must be 4 or 8");
    require(options.edge > 0 && options.temperature > 0, "edge and temperature must be positive");
    auto index = allocate<float>({h, w}), probability = allocate<float>({h, w}), margin = allocate<float>({h, w});
    auto best = allocate<std::int32_t>({h, w});
    {
        const mvs::SmoothOptions o = with_threads(options);
        nb::gil_scoped_release release;
        mvs::semi_global(cost.data(), static_cast<int>(h), static_cast<int>(d), static_cast<int>(w), reference.data(),
                         first.data(), step.data(), o, index.data(), probability.data(), margin.data(), best.data());
    }
    return nb::make_tuple(index, probability, margin, best);
}

nb::tuple choose_surface(Stack cost, Stack surfaces, Image reference, const mvs::ChooseOptions& options) {
    const std::size_t h = reference.shape(0), w = reference.shape(1), d = surfaces.shape(0);
    require(surfaces.shape(1) == h && surfaces.shape(2) == w && d >= 1, "surfaces must be (D, H, W)");
    require(cost.shape(0) == h && cost.shape(1) == d && cost.shape(2) == w, "cost must be (H, D, W)");
    require(options.edge > 0, "edge must be positive");
    auto best = allocate<std::int32_t>({h, w});
    auto gap = allocate<float>({h, w});
    {
        const mvs::ChooseOptions o = with_threads(options);
        nb::gil_scoped_release release;
        mvs::choose_surface(cost.data(), surfaces.data(), static_cast<int>(d), static_cast<int>(h),
                            static_cast<int>(w), reference.data(), o, best.data(), gap.data());
    }
    return nb::make_tuple(best, gap);
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    using namespace nb::literals;
    m.attr("TILE") = nb::make_tuple(mvs::kTileRows, mvs::kTileColumns);
    nb::class_<mvs::CostOptions>(m, "CostOptions")
        .def(nb::init<std::string, int, int, float, float, float, float, int>(), "name"_a, "radius"_a, "top_k"_a,
             "noise"_a, "contrast"_a, "intensity_weight"_a, "intensity_range"_a, "threads"_a);
    nb::class_<mvs::SmoothOptions>(m, "SmoothOptions")
        .def(nb::init<float, float, float, float, float, int, int>(), "p1"_a, "p2"_a, "edge"_a, "break_steps"_a,
             "temperature"_a, "paths"_a, "threads"_a);
    nb::class_<mvs::ChooseOptions>(m, "ChooseOptions")
        .def(nb::init<float, float, float, float, int>(), "p1"_a, "p2"_a, "edge"_a, "apart"_a, "threads"_a);
    m.def("cost_volume", &cost_volume, "reference"_a, "neighbors"_a, "warps"_a, "first"_a, "step"_a, "hypotheses"_a,
          "options"_a, "needed"_a = nb::none());
    m.def("surface_costs", &surface_costs, "reference"_a, "neighbors"_a, "warps"_a, "surfaces"_a, "options"_a,
          "needed"_a = nb::none());
    m.def("view_correlation", &view_correlation, "reference"_a, "neighbors"_a, "warps"_a, "inverse_depth"_a,
          "options"_a);
    m.def("semi_global", &semi_global, "cost"_a, "reference"_a, "first"_a, "step"_a, "options"_a);
    m.def("choose_surface", &choose_surface, "cost"_a, "surfaces"_a, "reference"_a, "options"_a);
}
