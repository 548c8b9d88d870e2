// Python bindings of the fusion kernels. Shapes are checked here, once; the interpreter's lock is released inside.
#include "fusion/fusion.hpp"
#include "mvs/arguments.hpp"

namespace {

using namespace bindings;

fusion::DepthMaps maps_of(const Image& depth, const Stack& neighbors, const Warps& warps) {
    one_warp_each(neighbors, warps);
    return {depth.data(),         extent(depth, 0),     extent(depth, 1),    neighbors.data(), data_of(warps),
            extent(neighbors, 0), extent(neighbors, 1), extent(neighbors, 2)};
}

Result<float> parallax(Image depth, Stack neighbor_depths, Warps warps, int threads) {
    const fusion::DepthMaps maps = maps_of(depth, neighbor_depths, warps);
    auto moved = allocate<float>({depth.shape(0), depth.shape(1)});
    nb::gil_scoped_release release;
    fusion::parallax(maps, thread_count(threads), moved.data());
    return moved;
}

Result<std::uint8_t> consistent_views(Image depth, Stack neighbor_depths, Warps warps, Image relative, int threads) {
    same_size(depth, relative);
    const fusion::DepthMaps maps = maps_of(depth, neighbor_depths, warps);
    auto count = allocate<std::uint8_t>({depth.shape(0), depth.shape(1)});
    nb::gil_scoped_release release;
    fusion::consistent_views(maps, relative.data(), thread_count(threads), count.data());
    return count;
}

Result<float> splat_depths(Stack neighbor_depths, Stack neighbor_confidences, Warps back, int height, int width,
                           const fusion::FuseOptions& options) {
    one_warp_each(neighbor_depths, back);
    require(neighbor_confidences.size() == neighbor_depths.size(), "one confidence per depth");
    require(height > 0 && width > 0, "the reference needs a size");
    const std::size_t n = back.shape(0), h = static_cast<std::size_t>(height), w = static_cast<std::size_t>(width);
    auto splatted = allocate<float>({n, h, w});
    const int views = static_cast<int>(n), nh = extent(neighbor_depths, 1), nw = extent(neighbor_depths, 2);
    const std::size_t stride = static_cast<std::size_t>(nh) * nw;
    const fusion::Warp* warps = data_of(back);
    const float *depths = neighbor_depths.data(), *confidences = neighbor_confidences.data();
    const fusion::FuseOptions o = with_threads(options);
    nb::gil_scoped_release release;
#pragma omp parallel for schedule(static, 1) num_threads(o.threads)
    for (int i = 0; i < views; ++i)
        fusion::splat_depth(depths + i * stride, confidences + i * stride, nh, nw, warps[i], o.min_neighbor_confidence,
                            height, width, splatted.data() + i * h * w);
    return splatted;
}

nb::tuple fuse_depth(Image depth, Image confidence, Stack neighbor_depths, Stack neighbor_confidences, Stack splatted,
                     Warps warps, Image sigma, const fusion::FuseOptions& options) {
    same_size(depth, confidence);
    same_size(depth, sigma);
    one_warp_each(splatted, warps);
    require(neighbor_confidences.size() == neighbor_depths.size(), "one confidence per depth");
    const std::size_t h = depth.shape(0), w = depth.shape(1);
    require(splatted.shape(1) == h && splatted.shape(2) == w, "splatted depths must have the reference's size");
    const fusion::DepthMaps maps = maps_of(depth, neighbor_depths, warps);
    auto fused = allocate<float>({h, w}), support = allocate<float>({h, w});
    auto violation = allocate<float>({h, w}), own = allocate<float>({h, w});
    {
        const fusion::FuseOptions o = with_threads(options);
        nb::gil_scoped_release release;
        fusion::fuse_depth(maps, confidence.data(), neighbor_confidences.data(), splatted.data(), sigma.data(), o,
                           fused.data(), support.data(), violation.data(), own.data());
    }
    return nb::make_tuple(fused, support, violation, own);
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    using namespace nb::literals;
    nb::class_<fusion::FuseOptions>(m, "FuseOptions")
        .def(nb::init<float, float, int>(), "violation"_a, "min_neighbor_confidence"_a, "threads"_a);
    m.def("parallax", &parallax, "depth"_a, "neighbor_depths"_a, "warps"_a, "threads"_a);
    m.def("consistent_views", &consistent_views, "depth"_a, "neighbor_depths"_a, "warps"_a, "relative"_a, "threads"_a);
    m.def("splat_depths", &splat_depths, "neighbor_depths"_a, "neighbor_confidences"_a, "back"_a, "height"_a,
          "width"_a, "options"_a);
    m.def("fuse_depth", &fuse_depth, "depth"_a, "confidence"_a, "neighbor_depths"_a, "neighbor_confidences"_a,
          "splatted"_a, "warps"_a, "sigma"_a, "options"_a);
}
