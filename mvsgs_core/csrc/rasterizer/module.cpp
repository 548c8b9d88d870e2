// Python bindings of the rasterizer and of the losses.
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

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
    int threads = 1;
    Pass() = default;
    Pass(const Pass&) = delete;
    ~Pass() { pool().give(std::move(frame)); }
};

std::unique_ptr<Pass> forward(nb::handle settings, Array<double> pose, const SplatArrays& splats, Out color,
                              Out depth, Out opacity, Out radii, uint32_t max_pairs) {
    auto pass = std::make_unique<Pass>();
    Frame& frame = *pass->frame;
    frame.camera = camera_of(settings, pose);
    std::tie(frame.background[0], frame.background[1], frame.background[2]) =
        setting<std::tuple<float, float, float>>(settings, "background");
    frame.exact = setting<bool>(settings, "exact");
    frame.antialiased = setting<bool>(settings, "antialiased");
    frame.degree = setting<int>(settings, "degree");
    frame.tiles_x = (frame.camera.width + kTile - 1) / kTile;
    frame.tiles_y = (frame.camera.height + kTile - 1) / kTile;
    pass->threads = thread_count(setting<int>(settings, "threads"));
    const bool weights = setting<bool>(settings, "weights");
    const Parameters p = parameters(frame, splats);
    {
        const nb::gil_scoped_release released;
        bin(frame, p, max_pairs, radii.data(), pass->threads);
        blend(frame, weights, color.data(), depth.data(), opacity.data(), pass->threads);
    }
    return pass;
}

// on_splats: of the fields of Splats. Returns how many splats had a gradient that is not finite: theirs are 0.
int64_t backward(Pass& pass, const SplatArrays& splats, In color, In depth, In opacity, In on_color,
                 std::optional<In> on_depth, std::optional<In> on_opacity, const std::array<Out, 6>& on_splats,
                 Out on_means2d, Written<double> on_pose) {
    Frame& frame = *pass.frame;
    const Parameters p = parameters(frame, splats);
    const auto& [means, log_scales, quaternions, opacity_logits, sh, betas] = on_splats;
    Gradients gradients{means.data(), log_scales.data(), quaternions.data(), opacity_logits.data(),
                        sh.data(),    betas.data(),      on_means2d.data(),  on_pose.data()};
    const nb::gil_scoped_release released;
    blend_backward(frame, color.data(), depth.data(), opacity.data(), on_color.data(), data_of(on_depth),
                   data_of(on_opacity), pass.threads);
    project_backward(frame, p, gradients, pass.threads);
    return gradients.refused;
}

// The same for the logits of the opacities alone.
int64_t backward_opacity(Pass& pass, In opacity_logits, In color, In depth, In opacity, In on_color,
                         std::optional<In> on_depth, std::optional<In> on_opacity, Out on_logits) {
    Frame& frame = *pass.frame;
    const nb::gil_scoped_release released;
    blend_backward(frame, color.data(), depth.data(), opacity.data(), on_color.data(), data_of(on_depth),
                   data_of(on_opacity), pass.threads);
    return opacity_backward(frame, opacity_logits.data(), int64_t(opacity_logits.shape(0)), on_logits.data(),
                            pass.threads);
}

// A group of Adam's step: field of Splats, first and second moment, and rate, final_rate, low, high, lead, tail.
using Moved = std::tuple<int, Out, Out, float, float, float, float, int, float>;

// Backward pass and step in one; beta1, beta2, epsilon. Returns how many splats had gradients, and how many steps, that
// are not finite: those are left as they were.
std::tuple<int64_t, int64_t> backward_step(Pass& pass, const std::array<Out, 6>& values, In color, In depth, In opacity,
                                           In on_color, std::optional<In> on_depth, std::optional<In> on_opacity,
                                           const std::vector<Moved>& moved, Written<int32_t> ages,
                                           const std::tuple<float, float, float>& constants, int decay_steps,
                                           Out means2d_gradient, Out means2d_views, Written<double> on_pose) {
    Frame& frame = *pass.frame;
    const auto& [means, log_scales, quaternions, opacity_logits, sh, betas] = values;
    const Parameters p{means.data(), log_scales.data(), quaternions.data(), opacity_logits.data(), sh.data(), betas.data(),
                       int64_t(means.shape(0)), int(sh.shape(1)), frame.degree, frame.exact, frame.antialiased};
    const size_t count = size_t(p.count);
    if (ages.size() != count || means2d_gradient.size() != count || means2d_views.size() != count)
        throw std::invalid_argument("backward_step: ages or counters differ in length from the splats");
    const int widths[6] = {3, 3, 4, 1, 3 * p.bases, 1};
    std::vector<adam::Group> groups;
    std::vector<int> fields;
    for (const auto& [field, first, second, rate, final_rate, low, high, lead, tail] : moved) {
        if (field < 0 || field > 5 || first.size() != values[field].size() || second.size() != values[field].size())
            throw std::invalid_argument("backward_step: moments differ in shape from what they are of");
        fields.push_back(field);
        groups.push_back({values[field].data(), nullptr, first.data(), second.data(), widths[field], rate, final_rate, low,
                          high, lead, tail, {}});
    }
    const auto [beta1, beta2, epsilon] = constants;
    const adam::Step step(std::move(groups), {beta1, beta2, epsilon, decay_steps}, ages.data());
    Stepped stepped{means2d_gradient.data(), means2d_views.data(), on_pose.data()};
    const nb::gil_scoped_release released;
    blend_backward(frame, color.data(), depth.data(), opacity.data(), on_color.data(), data_of(on_depth),
                   data_of(on_opacity), pass.threads);
    project_and_step(frame, p, step, fields, stepped, pass.threads);
    return {stepped.refused, stepped.refused_steps};
}

// The largest blending weight of every splat; the pass must have been made with weights.
void weights(const Pass& pass, Out weight_max) {
    const Frame& frame = *pass.frame;
    const size_t count = weight_max.shape(0);
    for (size_t i = 0; i < count; ++i) {
        const SlotSpan span = frame.spans[i];
        float max = 0.0f;
        for (uint32_t k = span.first; k < span.first + span.count; ++k) max = std::max(max, frame.weight_slots[k]);
        weight_max.data()[i] = max;
    }
}

// (weighted L1, SSIM); `gradient` gets that of their weighted sum. pixel_weight may be None.
std::tuple<double, double> image_loss(In image, In target, std::optional<In> pixel_weight, float l1_weight,
                                      float ssim_weight, Out gradient, int threads) {
    const nb::gil_scoped_release released;
    const Photometric result =
        photometric(image.data(), target.data(), data_of(pixel_weight), int(image.shape(0)), int(image.shape(1)),
                    l1_weight, ssim_weight, gradient.data(), thread_count(threads));
    return {result.l1, result.ssim};
}

// (L1, SSIM) of a photograph, see photometric.hpp; `gradient` gets that by the color. What may be None is not there.
std::tuple<double, double> photograph(In color, Array<uint8_t> image, std::optional<In> exposure,
                                      std::optional<In> factor, std::optional<Array<bool>> valid, bool clipped,
                                      float l1_weight, float ssim_weight, Out gradient, int threads) {
    const nb::gil_scoped_release released;
    const uint8_t* mask = valid ? reinterpret_cast<const uint8_t*>(valid->data()) : nullptr;
    const Formation formation{data_of(exposure), data_of(factor), mask, clipped};
    const Photometric result =
        photograph_loss(color.data(), image.data(), formation, int(color.shape(0)), int(color.shape(1)), l1_weight,
                        ssim_weight, gradient.data(), thread_count(threads));
    return {result.l1, result.ssim};
}

}  // namespace

NB_MODULE(MVSGS_MODULE, m) {
    nb::set_leak_warnings(false);  // a render may well outlive the interpreter's other modules
    nb::class_<Pass>(m, "Pass")
        .def_prop_ro("refused", [](const Pass& pass) { return pass.frame->refused; })
        .def_prop_ro("pairs", [](const Pass& pass) { return pass.frame->pair_count; })
        .def_prop_ro("evaluated", [](const Pass& pass) { return pass.frame->evaluated; })
        .def_prop_ro("contributed", [](const Pass& pass) { return pass.frame->contributed; });
    m.def("forward", &forward, nb::arg("settings"), nb::arg("pose"), nb::arg("splats"), nb::arg("color"),
          nb::arg("depth"), nb::arg("opacity"), nb::arg("radii"), nb::arg("max_pairs") = kMaxPairs);
    m.def("backward", &backward, nb::arg(), nb::arg("splats"), nb::arg("color"), nb::arg("depth"), nb::arg("opacity"),
          nb::arg("on_color"), nb::arg("on_depth").none(), nb::arg("on_opacity").none(), nb::arg("on_splats"),
          nb::arg("on_means2d"), nb::arg("on_pose"));
    m.def("backward_opacity", &backward_opacity, nb::arg(), nb::arg("opacity_logits"), nb::arg("color"),
          nb::arg("depth"), nb::arg("opacity"), nb::arg("on_color"), nb::arg("on_depth").none(),
          nb::arg("on_opacity").none(), nb::arg("on_logits"));
    m.def("backward_step", &backward_step, nb::arg(), nb::arg("values"), nb::arg("color"), nb::arg("depth"),
          nb::arg("opacity"), nb::arg("on_color"), nb::arg("on_depth").none(), nb::arg("on_opacity").none(),
          nb::arg("moved"), nb::arg("ages"), nb::arg("constants"), nb::arg("decay_steps"), nb::arg("means2d_gradient"),
          nb::arg("means2d_views"), nb::arg("on_pose"));
    m.def("weights", &weights);
    m.def("image_loss", &image_loss, nb::arg("image"), nb::arg("target"), nb::arg("pixel_weight").none(),
          nb::arg("l1_weight"), nb::arg("ssim_weight"), nb::arg("gradient"), nb::arg("threads"));
    m.def("photograph_loss", &photograph, nb::arg("color"), nb::arg("photograph"), nb::arg("exposure").none(),
          nb::arg("factor").none(), nb::arg("valid").none(), nb::arg("clipped"), nb::arg("l1_weight"),
          nb::arg("ssim_weight"), nb::arg("gradient"), nb::arg("threads"));
}
