// Selective Adam: only splats that the last render saw are stepped, each with its own step count.
// A splat with any non-finite gradient, or whose step would give a non-finite parameter, is left as it was and counted.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>
#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;
using Rows = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

namespace {

struct Group {
    float* value;
    const float* gradient;
    float* first;   // running mean of the gradient
    float* second;  // running mean of its square
    int width;
    float rate;        // learning rate of a new splat
    float final_rate;  // and of an old one: log-linear in between over `decay_steps`
    float low, high;   // values are kept inside
    int lead;          // columns that take the full rate,
    float tail;        // the others this share of it: spherical harmonics beyond degree 0
};

struct Constants {
    float beta1, beta2, epsilon;
    int decay_steps;
};

// 1 / (1 - beta^t): Adam's bias corrections. Splats differ in age, so that a table saves two powers a splat.
struct Corrections {
    static constexpr int kSize = 8192;
    std::vector<float> table;
    float beta;

    explicit Corrections(float b) : table(kSize), beta(b) {
        double power = 1.0;  // beta^t
        for (int t = 0; t < kSize; ++t) {
            table[t] = t == 0 ? 1.0f : static_cast<float>(1.0 / (1.0 - power));
            power *= static_cast<double>(beta);
        }
    }
    float operator[](int t) const {
        return t < kSize ? table[t] : 1.0f / (1.0f - std::pow(beta, static_cast<float>(t)));
    }
};

// Largest width of one parameter of one splat: 16 spherical harmonics of 3 colors.
constexpr int kMaxWidth = 48;
constexpr int64_t kBlock = 256;

bool finite_row(const float* row, int width) {
    // One test for the row: a sum of magnitudes is finite only if every term is (and none is near overflow).
    float sum = 0.0f;
    for (int k = 0; k < width; ++k) sum += std::fabs(row[k]);
    return std::isfinite(sum);
}

bool step_row(const Group& g, int64_t i, float rate, float correction1, float correction2, const Constants& c) {
    const int64_t offset = i * g.width;
    float m[kMaxWidth], v[kMaxWidth], value[kMaxWidth];
    float sum = 0.0f;
    for (int k = 0; k < g.width; ++k) {
        const float d = g.gradient[offset + k];
        m[k] = c.beta1 * g.first[offset + k] + (1.0f - c.beta1) * d;
        v[k] = c.beta2 * g.second[offset + k] + (1.0f - c.beta2) * d * d;
        const float step = (k < g.lead ? rate : rate * g.tail) * (m[k] * correction1) / (std::sqrt(v[k] * correction2) + c.epsilon);
        value[k] = std::min(std::max(g.value[offset + k] - step, g.low), g.high);
        sum += std::fabs(value[k]) + std::fabs(m[k]) + v[k];
    }
    if (!std::isfinite(sum)) return false;
    for (int k = 0; k < g.width; ++k) {
        g.value[offset + k] = value[k];
        g.first[offset + k] = m[k];
        g.second[offset + k] = v[k];
    }
    return true;
}

int64_t adam(const std::vector<Rows>& values, const std::vector<Rows>& gradients, const std::vector<Rows>& firsts,
             const std::vector<Rows>& seconds, const std::vector<std::vector<float>>& settings, Flags visible,
             Counts steps, float beta1, float beta2, float epsilon, int decay_steps, int threads) {
    const int64_t n = static_cast<int64_t>(visible.shape(0));
    const size_t count = values.size();
    if (gradients.size() != count || firsts.size() != count || seconds.size() != count || settings.size() != count)
        throw std::invalid_argument("adam: every group needs a gradient, two moments and its settings");
    if (static_cast<int64_t>(steps.shape(0)) != n) throw std::invalid_argument("adam: steps and visible differ in length");
    std::vector<Group> groups;
    for (size_t j = 0; j < count; ++j) {
        const auto width = values[j].shape(1);
        for (const Rows* rows : {&values[j], &gradients[j], &firsts[j], &seconds[j]})
            if (static_cast<int64_t>(rows->shape(0)) != n || rows->shape(1) != width)
                throw std::invalid_argument("adam: the arrays of a group differ in shape");
        if (width > kMaxWidth) throw std::invalid_argument("adam: more than 48 values a splat");
        if (settings[j].size() != 6)
            throw std::invalid_argument("adam: settings are (rate, final rate, low, high, lead, tail)");
        groups.push_back({values[j].data(), gradients[j].data(), firsts[j].data(), seconds[j].data(),
                          static_cast<int>(width), settings[j][0], settings[j][1], settings[j][2], settings[j][3],
                          static_cast<int>(settings[j][4]), settings[j][5]});
    }
    const Constants constants{beta1, beta2, epsilon, std::max(decay_steps, 1)};
    static Corrections corrections1(beta1), corrections2(beta2);
    if (corrections1.beta != beta1) corrections1 = Corrections(beta1);
    if (corrections2.beta != beta2) corrections2 = Corrections(beta2);
    const bool* seen = visible.data();
    int32_t* step_counts = steps.data();
    const int64_t blocks = (n + kBlock - 1) / kBlock;
    int64_t refused = 0;

    nb::gil_scoped_release release;
#pragma omp parallel for schedule(dynamic, 8) num_threads(threads) reduction(+ : refused)
    for (int64_t block = 0; block < blocks; ++block) {
        for (int64_t i = block * kBlock; i < std::min(n, (block + 1) * kBlock); ++i) {
            if (!seen[i]) continue;
            bool finite = true;
            for (const Group& g : groups) finite = finite && finite_row(g.gradient + i * g.width, g.width);
            if (!finite) {
                ++refused;
                continue;
            }
            const int32_t t = ++step_counts[i];
            const float correction1 = corrections1[t];
            const float correction2 = corrections2[t];
            const float age = std::min(1.0f, static_cast<float>(t) / static_cast<float>(constants.decay_steps));
            bool taken = true;
            for (const Group& g : groups) {
                const float rate =
                    g.final_rate == g.rate ? g.rate : g.rate * std::pow(g.final_rate / g.rate, age);
                taken = step_row(g, i, rate, correction1, correction2, constants) && taken;
            }
            if (!taken) ++refused;
        }
    }
    return refused;
}

}  // namespace

#define MVSGS_DEFINE(name) NB_MODULE(name, m)
MVSGS_DEFINE(MVSGS_MODULE) {
    m.doc() = "Kernels of the online mapper.";
    m.def("adam", &adam, nb::arg("values"), nb::arg("gradients"), nb::arg("firsts"), nb::arg("seconds"),
          nb::arg("settings"), nb::arg("visible"), nb::arg("steps"), nb::arg("beta1"), nb::arg("beta2"),
          nb::arg("epsilon"), nb::arg("decay_steps"), nb::arg("threads"),
          "One step of every group in place; returns how many splats were refused for non-finite values.");
}
