// Python bindings of what the benchmark of the rasterizer measures against. Not part of an installed package.
#include "bench/bench.hpp"
#include "rasterizer/arguments.hpp"

using namespace splats;

namespace {

// (forward, backward) seconds of the plain-loop rasterizer.
std::tuple<double, double> run_baseline(In means, In log_scales, In quaternions, In opacity_logits, In sh, In betas,
                                        Array<const double> pose, Intrinsics intrinsics, bool exact, int threads,
                                        Out color, In color_gradient, Out image_gradient) {
    const Camera camera = camera_of(pose, intrinsics, 1e-3f, int(color.shape(1)), int(color.shape(0)));
    Frame frame;
    frame.exact = exact;
    const Parameters p = parameters(frame, means, log_scales, quaternions, opacity_logits, sh, betas);
    const nb::gil_scoped_release released;
    const BaselineSeconds seconds =
        baseline(camera, p, color.data(), color_gradient.data(), image_gradient.data(), thread_count(threads));
    return {seconds.forward, seconds.backward};
}

}  // namespace

#define BENCH_MODULE(name) NB_MODULE(name, m)
BENCH_MODULE(MVSGS_MODULE) {
    m.def("baseline", &run_baseline);
    m.def("peak_densities", &peak_densities);
    m.def("peak_products", &peak_products);
    m.def("peak_tile_bytes", &peak_tile_bytes);
    m.def("peak_memory_bytes", &peak_memory_bytes);
}
