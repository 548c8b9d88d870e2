// Python bindings of the rasterizer and of the losses.
#include <nanobind/stl/unique_ptr.h>

#include <mutex>

#include "rasterizer/arguments.hpp"
#include "rasterizer/photometric.hpp"

using namespace splats;

namespace {

// Frames come back here, so that the next view finds its memory warm.
class Pool {
   public:
    std::unique_ptr<Frame> take() {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (free_.empty()) return std::make_unique<Frame>();
        std::unique_ptr<Frame> frame = std::move(free_.back());
        free_.pop_back();
        return frame;
    }
    void give(std::unique_ptr<Frame> frame) {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (free_.size() < 4) free_.push_back(std::move(frame));
    }

   private:
    std::mutex mutex_;
    std::vector<std::unique_ptr<Frame>> free_;
};

Pool& pool() {
    static Pool* instance = new Pool;  // lives as long as the process: frames may come back at its very end
    return *instance;
}

// What Python holds between the forward and the backward pass.
struct Pass {
    std::unique_ptr<Frame> frame = pool().take();
    Pass() = default;
    Pass(const Pass&) = delete;
    ~Pass() { pool().give(std::move(frame)); }
};

std::unique_ptr<Pass> forward(In means, In log_scales, In quaternions, In opacity_logits, In sh, In betas,
                              Array<const double> pose, Intrinsics intrinsics, float near,
                              std::tuple<float, float, float> background, bool exact, bool antialiased, int degree,
                              nb::object tile_mask, bool weights, int threads, Out color, Out depth, Out opacity,
                              Out radii) {
    auto pass = std::make_unique<Pass>();
    Frame& frame = *pass->frame;
    frame.camera = camera_of(pose, intrinsics, near, int(color.shape(1)), int(color.shape(0)));
    std::tie(frame.background[0], frame.background[1], frame.background[2]) = background;
    frame.exact = exact;
    frame.antialiased = antialiased;
    frame.degree = degree;
    frame.tiles_x = (frame.camera.width + kTile - 1) / kTile;
    frame.tiles_y = (frame.camera.height + kTile - 1) / kTile;
    const Parameters p = parameters(frame, means, log_scales, quaternions, opacity_logits, sh, betas);
    Array<const bool> mask;
    if (!tile_mask.is_none()) mask = nb::cast<Array<const bool>>(tile_mask);
    {
        const nb::gil_scoped_release released;
        bin(frame, p, mask.is_valid() ? mask.data() : nullptr, radii.data(), thread_count(threads));
        blend(frame, weights, color.data(), depth.data(), opacity.data(), thread_count(threads));
    }
    return pass;
}

// Returns how many splats had a gradient that is not finite: theirs are 0.
int64_t backward(Pass& pass, In means, In log_scales, In quaternions, In opacity_logits, In sh, In betas, In color,
                 In depth, In opacity, In color_gradient, nb::object depth_gradient, nb::object opacity_gradient,
                 int threads, Out on_means, Out on_log_scales, Out on_quaternions, Out on_opacity_logits, Out on_sh,
                 Out on_betas, Out on_screen, Array<double> on_pose) {
    Frame& frame = *pass.frame;
    const Parameters p = parameters(frame, means, log_scales, quaternions, opacity_logits, sh, betas);
    In of_depth, of_opacity;
    if (!depth_gradient.is_none()) of_depth = nb::cast<In>(depth_gradient);
    if (!opacity_gradient.is_none()) of_opacity = nb::cast<In>(opacity_gradient);
    Gradients gradients{on_means.data(), on_log_scales.data(), on_quaternions.data(), on_opacity_logits.data(),
                        on_sh.data(), on_betas.data(), on_screen.data(), on_pose.data(), 0};
    const nb::gil_scoped_release released;
    blend_backward(frame, color.data(), depth.data(), opacity.data(), color_gradient.data(),
                   of_depth.is_valid() ? of_depth.data() : nullptr,
                   of_opacity.is_valid() ? of_opacity.data() : nullptr, thread_count(threads));
    project_backward(frame, p, gradients, thread_count(threads));
    return gradients.refused;
}

// (sum, max) of the blending weights of every splat; the pass must have been made with weights.
void weights(const Pass& pass, Out weight_sum, Out weight_max) {
    const Frame& frame = *pass.frame;
    const size_t count = weight_sum.shape(0);
    for (size_t i = 0; i < count; ++i) {
        const SlotSpan span = frame.spans[i];
        float sum = 0.0f, most = 0.0f;
        for (uint32_t k = span.first; k < span.first + span.count; ++k) {
            sum += frame.weight_slots[2 * size_t(k)];
            most = std::max(most, frame.weight_slots[2 * size_t(k) + 1]);
        }
        weight_sum.data()[i] = sum;
        weight_max.data()[i] = most;
    }
}

// (weighted L1, SSIM); `gradient` gets that of their weighted sum. pixel_weight may be None.
std::tuple<double, double> image_loss(In image, In target, nb::object pixel_weight, float l1_weight, float ssim_weight,
                                      Out gradient, int threads) {
    In weight;
    if (!pixel_weight.is_none()) weight = nb::cast<In>(pixel_weight);
    const nb::gil_scoped_release released;
    const Photometric result =
        photometric(image.data(), target.data(), weight.is_valid() ? weight.data() : nullptr, int(image.shape(0)),
                    int(image.shape(1)), l1_weight, ssim_weight, gradient.data(), thread_count(threads));
    return {result.l1, result.ssim};
}

}  // namespace

#define SPLATS_MODULE(name) NB_MODULE(name, m)
SPLATS_MODULE(MVSGS_MODULE) {
    nb::set_leak_warnings(false);  // a render may well outlive the interpreter's other modules
    nb::class_<Pass>(m, "Pass")
        .def_prop_ro("refused", [](const Pass& pass) { return pass.frame->refused; })
        .def_prop_ro("pairs", [](const Pass& pass) { return pass.frame->pair_count; })
        .def_prop_ro("evaluated", [](const Pass& pass) { return pass.frame->evaluated; })
        .def_prop_ro("contributed", [](const Pass& pass) { return pass.frame->contributed; });
    m.def("forward", &forward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg("pose"),
          nb::arg("intrinsics"), nb::arg("near"), nb::arg("background"), nb::arg("exact"), nb::arg("antialiased"),
          nb::arg("degree"), nb::arg("tile_mask").none(), nb::arg("weights"), nb::arg("threads"), nb::arg("color"),
          nb::arg("depth"), nb::arg("opacity"), nb::arg("radii"));
    m.def("backward", &backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg("color"), nb::arg("depth"), nb::arg("opacity"), nb::arg("color_gradient"),
          nb::arg("depth_gradient").none(), nb::arg("opacity_gradient").none(), nb::arg("threads"),
          nb::arg("on_means"), nb::arg("on_log_scales"), nb::arg("on_quaternions"), nb::arg("on_opacity_logits"),
          nb::arg("on_sh"), nb::arg("on_betas"), nb::arg("on_screen"), nb::arg("on_pose"));
    m.def("weights", &weights);
    m.def("image_loss", &image_loss, nb::arg("image"), nb::arg("target"), nb::arg("pixel_weight").none(),
          nb::arg("l1_weight"), nb::arg("ssim_weight"), nb::arg("gradient"), nb::arg("threads"));
}
