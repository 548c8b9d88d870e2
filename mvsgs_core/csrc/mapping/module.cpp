// Python bindings of the mapper's kernels. Shapes are checked here, once; the interpreter's lock is released inside.
#include <algorithm>

#include "mapping/partition.hpp"
#include "mvs/bindings.hpp"

namespace nb = nanobind;

void bind_adam(nb::module_& m);

namespace {

using namespace bindings;
using Colors = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Precise = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

nb::tuple split(Colors colors, Image weight, Image left, Mask taken, Mask sure, Precise logarithm, double angle,
                float price, int threads) {
    const std::size_t height = colors.shape(0), width = colors.shape(1);
    require(height % partition::kSide == 0 && width % partition::kSide == 0, "partition: sides are multiples of 8");
    const auto same = [&](const auto& other) { return other.shape(0) == height && other.shape(1) == width; };
    require(same(weight) && same(left) && same(taken) && same(sure) && same(logarithm), "partition: sizes differ");
    const partition::Image image{static_cast<int64_t>(height), static_cast<int64_t>(width), colors.data(),
                                 weight.data(), left.data(), taken.data(), sure.data(), logarithm.data()};
    auto labels = allocate<std::int64_t>({height, width});
    std::vector<int64_t> sides;
    {
        nb::gil_scoped_release release;
        sides = partition::split(image, angle, price, thread_count(threads), labels.data());
    }
    auto found = allocate<std::int64_t>({sides.size() / 2, std::size_t{2}});
    std::copy(sides.begin(), sides.end(), found.data());
    return nb::make_tuple(labels, found);
}

}  // namespace

#define MVSGS_DEFINE(name) NB_MODULE(name, m)
MVSGS_DEFINE(MVSGS_MODULE) {
    m.doc() = "Kernels of the online mapper.";
    bind_adam(m);
    m.def("partition", &split, nb::arg("colors"), nb::arg("weight"), nb::arg("left"), nb::arg("taken"), nb::arg("sure"),
          nb::arg("logarithm"), nb::arg("angle"), nb::arg("price"), nb::arg("threads"),
          "Labels (H, W), -1 where there is no rectangle, and rows and columns (N, 2) of each.");
}
