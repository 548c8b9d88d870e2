// Adam on gradients that lie in memory: of any back end but the C++ one, which steps as it makes them.
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>

#include "bindings.hpp"
#include "rasterizer/adam.hpp"

using namespace bindings;

namespace {

using Gradient = Array<float, nb::ndim<2>>;
using Rows = Written<float, nb::ndim<2>>;
using Flags = Array<bool, nb::ndim<1>>;
using Counts = Written<int32_t, nb::ndim<1>>;

// value, gradient, first and second moment (N, width) of a parameter; rate, final_rate, low, high, lead and tail of Group
using Parameter = std::tuple<Rows, Gradient, Rows, Rows, float, float, float, float, int, float>;

int64_t step_all(const std::vector<Parameter>& parameters, Flags visible, Counts steps, float beta1, float beta2,
             float epsilon, int decay_steps, int threads) {
    const int64_t n = static_cast<int64_t>(visible.shape(0));
    require(static_cast<int64_t>(steps.shape(0)) == n, "adam: steps and visible differ in length");
    std::vector<adam::Group> groups;
    for (const auto& [value, gradient, first, second, rate, final_rate, low, high, lead, tail] : parameters) {
        const auto width = value.shape(1);
        const auto differs = [&](const auto& rows) {
            return static_cast<int64_t>(rows.shape(0)) != n || rows.shape(1) != width;
        };
        require(!differs(value) && !differs(gradient) && !differs(first) && !differs(second),
                "adam: the arrays of a group differ in shape");
        require(width <= adam::kMaxWidth, "adam: more than 48 values a splat");
        groups.push_back({value.data(), gradient.data(), first.data(), second.data(), static_cast<int>(width), rate,
                          final_rate, low, high, lead, tail, {}});
    }
    const adam::Step step(std::move(groups), {beta1, beta2, epsilon, decay_steps}, steps.data());
    const bool* seen = visible.data();
    const int64_t blocks = (n + adam::kBlock - 1) / adam::kBlock;
    int64_t refused = 0;

    nb::gil_scoped_release release;
#pragma omp parallel num_threads(threads) reduction(+ : refused)
    {
        adam::Block block;
#pragma omp for schedule(dynamic, 16)
        for (int64_t index = 0; index < blocks; ++index) {
            const int64_t begin = index * adam::kBlock;
            if (std::none_of(seen + begin, seen + std::min(n, begin + adam::kBlock), [](bool s) { return s; }))
                continue;
            refused += step.of_block(block, step.groups, seen, begin, n);
        }
    }
    return refused;
}

}  // namespace

void bind_adam(nb::module_& m) {
    m.def("adam", &step_all, nb::arg("parameters"), nb::arg("visible"), nb::arg("steps"), nb::arg("beta1"), nb::arg("beta2"),
          nb::arg("epsilon"), nb::arg("decay_steps"), nb::arg("threads"),
          "One step of every parameter in place; returns how many splats were refused for non-finite values.");
}
