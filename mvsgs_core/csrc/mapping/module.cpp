// Python bindings of the mapper's kernels. Shapes are checked here, once; the interpreter's lock is released inside.
#include "bindings.hpp"
#include "mapping/partition.hpp"

void bind_adam(nanobind::module_& m);

namespace {

using namespace bindings;
using Image = Array<float, nb::ndim<2>>;
using Colors = Array<float, nb::shape<-1, -1, 3>>;
using Mask = Array<bool, nb::ndim<2>>;
using Precise = Array<double, nb::ndim<2>>;

nb::tuple split(Colors colors, Image weight, Image left, Mask taken, Mask sure, Precise logarithm, double angle, double depth_noise,
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
        sides = partition::split(image, angle, depth_noise, price, thread_count(threads), labels.data());
    }
    const std::size_t count = sides.size() / 2;
    return nb::make_tuple(labels, to_numpy(std::move(sides), {count, 2}));
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    m.doc() = "Kernels of the online mapper.";
    bind_adam(m);
    m.def("partition", &split, nb::arg("colors"), nb::arg("weight"), nb::arg("left"), nb::arg("taken"), nb::arg("sure"),
          nb::arg("logarithm"), nb::arg("angle"), nb::arg("depth_noise"), nb::arg("price"), nb::arg("threads"),
          "Labels (H, W), -1 where there is no rectangle, and rows and columns (N, 2) of each.");
}
