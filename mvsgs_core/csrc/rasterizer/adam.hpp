// Selective Adam: only splats that the last render saw are stepped, each with its own step count. Splats go together in
// blocks, each group's values as one long row.
// A splat with any non-finite gradient, or whose step would give a non-finite parameter, is left as it was and counted.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

namespace adam {

struct Group {
    float* value;
    const float* gradient;
    float* first;   // running mean of the gradient
    float* second;  // running mean of its square
    int width;
    float rate;        // learning rate of a new splat
    float final_rate;  // and of an old one: log-linear in between over `decay_steps`
    float low, high;   // no step goes beyond; a value that is there already goes no further
    int lead;          // columns that take the full rate,
    float tail;        // the others this fraction of it: spherical harmonics beyond degree 0
    std::vector<float> rates{};  // by age, as far as a table goes; empty where the rate stays

    float computed_rate(int32_t age, int decay_steps) const {
        return rate * std::pow(final_rate / rate, static_cast<float>(age) / static_cast<float>(decay_steps));
    }
    float rate_at(int32_t age, int decay_steps) const {
        const int32_t counted = std::min(age, decay_steps);
        return counted < static_cast<int32_t>(rates.size()) ? rates[counted] : computed_rate(counted, decay_steps);
    }
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
constexpr int kMaxAges = 4096;  // of a table of rates
constexpr int kFew = 2;  // where less than one of so many splats of a block is stepped, they go one by one
constexpr int kBlock = 128;  // splats that go together: what they need stays in the first-level cache

inline bool finite(const float* values, int count) {
    // One test for all: a sum of magnitudes is finite only if every term is (and none is near overflow).
    float sum = 0.0f;
    for (int k = 0; k < count; ++k) sum += std::fabs(values[k]);
    return std::isfinite(sum);
}

// One step of a value, in place; returns a number that is finite only if all three are.
inline float step_value(const Group& g, const Constants& c, float d, float rate, float correction1, float correction2,
                        float& value, float& first, float& second) {
    first = c.beta1 * first + (1.0f - c.beta1) * d;
    second = c.beta2 * second + (1.0f - c.beta2) * d * d;
    const float step = rate * (first * correction1) / (std::sqrt(second * correction2) + c.epsilon);
    value = std::min(std::max(value - step, std::min(g.low, value)), std::max(g.high, value));
    return std::fabs(value) + std::fabs(first) + second;
}

// Every number `width` times.
template <int Width>
void spread(const float* numbers, int count, float* out) {
    for (int i = 0; i < count; ++i)
        for (int k = 0; k < Width; ++k) out[Width * i + k] = numbers[i];
}
inline void spread(const float* numbers, int count, int width, float* out) {
    if (width == 1) return spread<1>(numbers, count, out);
    if (width == 3) return spread<3>(numbers, count, out);
    if (width == 4) return spread<4>(numbers, count, out);
    for (int i = 0; i < count; ++i) std::fill_n(out + i * width, width, numbers[i]);
}

// Neighboring splats, whose values are stepped as one long row: that vectorizes where rows of one to four don't.
struct Block {
    int64_t begin = 0, origin = 0;  // origin: the splat that gradients and what is seen begin with
    int count = 0, taken_count = 0;
    float taken[kBlock], correction1[kBlock], correction2[kBlock];  // of each splat; taken is 0 or 1
    int32_t age[kBlock];
    bool failed[kBlock];
    int width = 0;  // of what follows: the same for each value, and the values as they would be
    float wide_taken[kBlock * kMaxWidth], wide_correction1[kBlock * kMaxWidth], wide_correction2[kBlock * kMaxWidth];
    float rate[kBlock * kMaxWidth];
    float value[kBlock * kMaxWidth], first[kBlock * kMaxWidth], second[kBlock * kMaxWidth];

    const float* gradient(const Group& g) const { return g.gradient + (begin - origin) * g.width; }

    // Which of the splats from `from` on are stepped; returns how many of those seen are not.
    int64_t take(const std::vector<Group>& groups, const bool* seen, int64_t from, int64_t end) {
        begin = from;
        count = static_cast<int>(std::min<int64_t>(kBlock, end - from));
        width = taken_count = 0;
        seen += begin - origin;
        bool all = true;
        for (const Group& g : groups) all = all && finite(gradient(g), count * g.width);
        int64_t refused = 0;
        for (int i = 0; i < count; ++i) {
            bool good = true;
            if (!all && seen[i])
                for (const Group& g : groups) good = good && finite(gradient(g) + i * g.width, g.width);
            taken[i] = seen[i] && good ? 1.0f : 0.0f;
            taken_count += seen[i] && good;
            failed[i] = false;
            refused += !good;
        }
        return refused;
    }

    void widen(int to) {
        if (width == to) return;
        width = to;
        spread(taken, count, width, wide_taken);
        spread(correction1, count, width, wide_correction1);
        spread(correction2, count, width, wide_correction2);
    }

    void set_rates(const Group& g, int decay_steps) {
        if (g.rates.empty()) {
            std::fill_n(rate, count * g.width, g.rate);
        } else {
            float own[kBlock];
            for (int i = 0; i < count; ++i) own[i] = g.rate_at(age[i], decay_steps);
            spread(own, count, g.width, rate);
        }
        for (int i = 0; g.lead < g.width && i < count; ++i)
            for (int k = g.lead; k < g.width; ++k) rate[i * g.width + k] *= g.tail;
    }

    // One group's step of all splats taken. Returns false, with nothing changed, if something is not finite.
    bool step(const Group& g, const Constants& c) {
        widen(g.width);
        set_rates(g, c.decay_steps);
        const int64_t offset = begin * g.width;
        const int length = count * g.width;
        const float* on_value = gradient(g);
        float sum = 0.0f;
#pragma omp simd reduction(+ : sum)
        for (int e = 0; e < length; ++e) {
            float x = g.value[offset + e], m = g.first[offset + e], v = g.second[offset + e];
            sum += step_value(g, c, on_value[e], rate[e], wide_correction1[e], wide_correction2[e], x, m, v);
            value[e] = x;
            first[e] = m;
            second[e] = v;
        }
        if (!std::isfinite(sum)) return false;
#pragma omp simd
        for (int e = 0; e < length; ++e) {
            const bool stepped = wide_taken[e] > 0.5f;
            g.value[offset + e] = stepped ? value[e] : g.value[offset + e];
            g.first[offset + e] = stepped ? first[e] : g.first[offset + e];
            g.second[offset + e] = stepped ? second[e] : g.second[offset + e];
        }
        return true;
    }

    // The same splat by splat, for few of them, or where something is not finite: that stays as it was.
    void step_one_by_one(const Group& g, const Constants& c) {
        for (int i = 0; i < count; ++i) {
            if (taken[i] < 0.5f) continue;
            const int64_t offset = (begin + i) * g.width;
            const float full = g.rates.empty() ? g.rate : g.rate_at(age[i], c.decay_steps);
            float sum = 0.0f;
            for (int k = 0; k < g.width; ++k) {
                value[k] = g.value[offset + k];
                first[k] = g.first[offset + k];
                second[k] = g.second[offset + k];
                sum += step_value(g, c, gradient(g)[i * g.width + k], k < g.lead ? full : full * g.tail, correction1[i],
                                  correction2[i], value[k], first[k], second[k]);
            }
            failed[i] = failed[i] || !std::isfinite(sum);
            if (!std::isfinite(sum)) continue;
            std::copy_n(value, g.width, g.value + offset);
            std::copy_n(first, g.width, g.first + offset);
            std::copy_n(second, g.width, g.second + offset);
        }
    }
};

// One step of all: the groups, and how old each splat is.
struct Step {
    std::vector<Group> groups;
    Constants constants;
    Corrections corrections1, corrections2;
    int32_t* ages;  // of each splat, in steps

    Step(std::vector<Group> given, Constants c, int32_t* steps)
        : groups(std::move(given)), constants(c), corrections1(c.beta1), corrections2(c.beta2), ages(steps) {
        constants.decay_steps = std::max(c.decay_steps, 1);
        for (Group& g : groups)
            for (int age = 0; g.final_rate != g.rate && age <= std::min(constants.decay_steps, kMaxAges); ++age)
                g.rates.push_back(g.computed_rate(age, constants.decay_steps));
    }

    // The splats from `begin` to at most `end`, a block of them; returns how many of those seen were refused.
    // own: the groups, with the block's gradients.
    int64_t of_block(Block& block, const std::vector<Group>& own, const bool* seen, int64_t begin, int64_t end) const {
        int64_t refused = block.take(own, seen, begin, end);
        for (int i = 0; i < block.count; ++i) {
            block.age[i] = ages[begin + i] += block.taken[i] > 0.5f;
            block.correction1[i] = corrections1[block.age[i]];
            block.correction2[i] = corrections2[block.age[i]];
        }
        const bool few = kFew * block.taken_count < block.count;
        for (const Group& g : own)
            if (few || !block.step(g, constants)) block.step_one_by_one(g, constants);
        return refused + std::count(block.failed, block.failed + block.count, true);
    }
};

}  // namespace adam
