// Python bindings of what the benchmark of the rasterizer measures against. Not part of an installed package.
#include "bench/bench.hpp"
#include "rasterizer/arguments.hpp"

using namespace splats;

namespace {

// (forward, backward) seconds of the plain-loop rasterizer.
std::tuple<double, double> run_baseline(nb::handle settings, Array<double> pose, const SplatArrays& splats,
                                        Out color, In color_gradient, Out image_gradient) {
    const Camera camera = camera_of(settings, pose);
    Frame frame;
    frame.exact = setting<bool>(settings, "exact");
    const Parameters p = parameters(frame, splats);
    const int threads = thread_count(setting<int>(settings, "threads"));
    const nb::gil_scoped_release released;
    const BaselineSeconds seconds =
        baseline(camera, p, color.data(), color_gradient.data(), image_gradient.data(), threads);
    return {seconds.forward, seconds.backward};
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    m.def("baseline", &run_baseline);
    m.def("peak_kernel_values", &peak_kernel_values);
    m.def("peak_products", &peak_products);
    m.def("peak_tile_bytes", &peak_tile_bytes);
    m.def("peak_memory_bytes", &peak_memory_bytes);
}
