// 1 - ZNCC, mixed with the difference of the windows' mean gray levels, which ZNCC does not see.
#include "mvs/zncc.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "mvs/lanes.hpp"

namespace mvs {

void Correlation::row(const Windows& windows, const NeighborRows& there, int y, Columns columns, float noise) {
    const int radius = windows.radius, side = 2 * radius + 1, band_row = y - windows.y0;
    const int up = std::max(-radius, -y), down = std::min(radius, windows.height - 1 - y);
    const float *mean_i = windows.mean_row(band_row), *var_i = windows.variance_row(band_row);
    for (int x = columns.from; x < columns.to; x += kLanes) {
        const float* w = windows.weights(band_row, x / Windows::kBlock) + x % Windows::kBlock;
        w += static_cast<std::ptrdiff_t>(up + radius) * side * Windows::kBlock;
        Lanes sum{}, square{}, product{};  // in registers through all taps
        for (int dy = up; dy <= down; ++dy) {
            const float* sample = there.sample_row(y + dy) + x;
            const float* here = windows.gray_row(band_row + dy) + x;
            for (int dx = -radius; dx <= radius; ++dx, w += Windows::kBlock) {
                const Lanes shown = load(sample + dx), weighted = load(w) * shown;
                sum += weighted;
                square += weighted * shown;
                product += weighted * load(here + dx);
            }
        }
        const Lanes variance = square - sum * sum;
        store(&mean[x], sum);
        store(&variance_[x], (variance > 0.0f ? variance : Lanes{}) + noise);
        store(&value[x], product - load(mean_i + x) * sum);
    }
    const float* variance = variance_.data();
    float* correlation = value.data();
#pragma omp simd
    for (int x = columns.from; x < columns.to; ++x)
        correlation[x] = correlation[x] / std::sqrt(var_i[x] * variance[x]);
}

namespace {

class Zncc : public MatchingCost {
  public:
    Zncc(const CostOptions& o, int padded)
        : noise_(o.noise), weight_(o.intensity_weight), sharpness_(1.0f / o.intensity_range), correlation_(padded) {
        if (!(o.intensity_weight >= 0 && o.intensity_weight <= 1 && o.intensity_range > 0))
            throw std::invalid_argument("intensity_weight must lie in [0, 1], intensity_range above 0");
    }

    void row(const Windows& windows, const NeighborRows& there, int y, Columns columns, float* cost) override {
        correlation_.row(windows, there, y, columns, noise_);
        const float *mean = windows.mean_row(y - windows.y0), *mean_there = correlation_.mean.data();
        const float* correlation = correlation_.value.data();
        const Lanes zero{}, one = zero + 1.0f;
        for (int x = columns.from; x < columns.to; x += kLanes) {
            const Lanes shape = smaller(one, larger(zero, one - load(correlation + x)));
            const Lanes apart = smaller(one, magnitude(load(mean + x) - load(mean_there + x)) * sharpness_);
            store(cost + x, shape + weight_ * (apart - shape));
        }
    }

  private:
    float noise_, weight_, sharpness_;
    Correlation correlation_;
};

const RegisteredCost registered("zncc", [](const CostOptions& o, int padded) -> std::unique_ptr<MatchingCost> {
    return std::make_unique<Zncc>(o, padded);
});

}  // namespace
}  // namespace mvs
