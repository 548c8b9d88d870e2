#include "mapping/partition.hpp"

#include <omp.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "caught.hpp"

namespace partition {
namespace {

constexpr int kKeys = (kLevels + 1) * (kLevels + 1);
enum Choice : int8_t { kNothing, kLeaf, kRows, kColumns };

constexpr int key_of(int rows, int columns) { return rows * (kLevels + 1) + columns; }

// Mean colors of all rectangles of one size.
using Means = std::vector<float>;

// Where a pixel's color lies between the mean colors of rectangles of 2^columns pixels, three values a pixel.
struct Between {
    std::vector<int32_t> before, after;
    std::vector<float> fraction;

    Between(int64_t pixels, int columns) : before(3 * pixels), after(3 * pixels), fraction(3 * pixels) {
        const int64_t last = (pixels >> columns) - 1;
        for (int64_t i = 0; i < 3 * pixels; ++i) {
            const float at = (static_cast<float>(i / 3) + 0.5f) / static_cast<float>(1 << columns) - 0.5f;
            const float first = std::floor(at);
            before[i] = static_cast<int32_t>(3 * std::clamp<int64_t>(static_cast<int64_t>(first), 0, last) + i % 3);
            after[i] = static_cast<int32_t>(3 * std::clamp<int64_t>(static_cast<int64_t>(first) + 1, 0, last) + i % 3);
            fraction[i] = at - first;
        }
    }
};

// What a strip of kSide rows of pixels comes to, for one size of rectangle; all by rows.
struct Sums {
    std::vector<float> count, left, distortion, cost;
    std::vector<double> sure, first, second;
};

class Splitting {
public:
    Splitting(const Image& image, double angle, double depth_noise, float price)
        : image_(image), angle_(angle), depth_noise_(depth_noise), price_(price) {
        for (int rows = 0; rows <= kLevels; ++rows)
            for (int columns = 0; columns <= kLevels; ++columns) {
                means_[key_of(rows, columns)] = mean_colors(rows, columns);
                choice_[key_of(rows, columns)].resize((image.height >> rows) * (image.width >> columns));
            }
        for (int level = 0; level <= kLevels; ++level) across_.emplace_back(image.width, level);
    }

    // Chooses for the rectangles of the strip that begins at this row.
    void choose(int64_t top, std::array<Sums, kKeys>& sums) {
        for (int rows = 0; rows <= kLevels; ++rows)
            for (int columns = 0; columns <= kLevels; ++columns) {
                Sums& here = sums[key_of(rows, columns)];
                if (rows > 0)
                    add_rows(sums[key_of(rows - 1, columns)], here, image_.width >> columns, kSide >> rows);
                else if (columns > 0)
                    add_columns(sums[key_of(0, columns - 1)], here, image_.width >> columns, kSide);
                else
                    begin(here, top);
                add_distortion(here, top, rows, columns);
                choose(sums, top, rows, columns);
            }
    }

    // The rectangles that the choices lead to from the largest down, larger ones first; of one size by rows.
    std::vector<int64_t> follow(int64_t* labels) const {
        std::vector<int64_t> sides;
        std::array<std::vector<char>, kKeys> reached;
        for (int key = 0; key < kKeys; ++key) reached[key].assign(choice_[key].size(), key == kKeys - 1);
        std::fill(labels, labels + image_.height * image_.width, -1);
        for (int sum = 2 * kLevels; sum >= 0; --sum)
            for (int rows = std::max(0, sum - kLevels); rows <= std::min(sum, kLevels); ++rows)
                follow(rows, sum - rows, reached, sides, labels);
        return sides;
    }

private:
    Means mean_colors(int rows, int columns) const {
        const int64_t height = image_.height >> rows, width = image_.width >> columns;
        Means means(3 * height * width);
        if (rows > 0) {
            const Means& before = means_[key_of(rows - 1, columns)];
            for (int64_t y = 0; y < height; ++y)
                for (int64_t i = 0; i < 3 * width; ++i)
                    means[3 * width * y + i] =
                        0.5f * (before[3 * width * 2 * y + i] + before[3 * width * (2 * y + 1) + i]);
        } else if (columns > 0) {
            const Means& before = means_[key_of(0, columns - 1)];
            for (int64_t pixel = 0; pixel < height * width; ++pixel)
                for (int channel = 0; channel < 3; ++channel)
                    means[3 * pixel + channel] = 0.5f * (before[6 * pixel + channel] + before[6 * pixel + 3 + channel]);
        } else {
            std::copy(image_.colors, image_.colors + means.size(), means.begin());
        }
        return means;
    }

    void begin(Sums& sums, int64_t top) const {
        const int64_t pixels = kSide * image_.width, start = top * image_.width;
        sums.count.resize(pixels), sums.left.resize(pixels);
        sums.sure.resize(pixels), sums.first.resize(pixels), sums.second.resize(pixels);
        for (int64_t i = 0; i < pixels; ++i) {
            const double depth = image_.logarithm[start + i];
            sums.count[i] = image_.taken[start + i];
            sums.left[i] = image_.left[start + i];
            sums.sure[i] = image_.sure[start + i];
            sums.first[i] = depth;
            sums.second[i] = depth * depth;
        }
    }

    template <typename Value>
    static void add_rows(const std::vector<Value>& before, std::vector<Value>& sums, int64_t width, int64_t height) {
        sums.resize(width * height);
        for (int64_t y = 0; y < height; ++y)
            for (int64_t x = 0; x < width; ++x)
                sums[width * y + x] = before[width * 2 * y + x] + before[width * (2 * y + 1) + x];
    }

    template <typename Value>
    static void add_columns(const std::vector<Value>& before, std::vector<Value>& sums, int64_t width, int64_t height) {
        sums.resize(width * height);
        for (int64_t i = 0; i < width * height; ++i) sums[i] = before[2 * i] + before[2 * i + 1];
    }

    static void add_rows(const Sums& before, Sums& sums, int64_t width, int64_t height) {
        add_rows(before.count, sums.count, width, height), add_rows(before.left, sums.left, width, height);
        add_rows(before.sure, sums.sure, width, height), add_rows(before.first, sums.first, width, height);
        add_rows(before.second, sums.second, width, height);
    }

    static void add_columns(const Sums& before, Sums& sums, int64_t width, int64_t height) {
        add_columns(before.count, sums.count, width, height), add_columns(before.left, sums.left, width, height);
        add_columns(before.sure, sums.sure, width, height), add_columns(before.first, sums.first, width, height);
        add_columns(before.second, sums.second, width, height);
    }

    // Weighted squared error, mean over the colors, of the mean colors, blended, against the image's. A single pixel
    // has none.
    void add_distortion(Sums& sums, int64_t top, int rows, int columns) const {
        const int64_t width = image_.width, wide = width >> columns, high = kSide >> rows;
        sums.distortion.assign(wide * high, 0.0f);
        if (rows == 0 && columns == 0) return;
        const Means& means = means_[key_of(rows, columns)];
        const Between& across = across_[columns];
        const int64_t last = (image_.height >> rows) - 1;
        std::vector<float> mean(3 * wide), squared(3 * width), error(width);
        for (int64_t y = top; y < top + kSide; ++y) {
            const float at = (static_cast<float>(y) + 0.5f) / static_cast<float>(1 << rows) - 0.5f;
            const float first = std::floor(at), fraction = at - first;
            const float* above = &means[3 * wide * std::clamp<int64_t>(static_cast<int64_t>(first), 0, last)];
            const float* below = &means[3 * wide * std::clamp<int64_t>(static_cast<int64_t>(first) + 1, 0, last)];
            for (int64_t i = 0; i < 3 * wide; ++i) mean[i] = above[i] + fraction * (below[i] - above[i]);
            const float* color = image_.colors + 3 * width * y;
            for (int64_t i = 0; i < 3 * width; ++i) {
                const float left = mean[across.before[i]];
                const float difference = color[i] - (left + across.fraction[i] * (mean[across.after[i]] - left));
                squared[i] = difference * difference;
            }
            const float* weight = image_.weight + width * y;
            for (int64_t x = 0; x < width; ++x)
                error[x] = (squared[3 * x] + squared[3 * x + 1] + squared[3 * x + 2]) * weight[x] / 3.0f;
            float* row = &sums.distortion[wide * ((y - top) >> rows)];
            for (int64_t x = 0; x < width; ++x) row[x >> columns] += error[x];
        }
    }

    void choose(std::array<Sums, kKeys>& sums, int64_t top, int rows, int columns) {
        constexpr float kImpossible = std::numeric_limits<float>::infinity();
        Sums& here = sums[key_of(rows, columns)];
        const int64_t wide = image_.width >> columns, high = kSide >> rows;
        const double spread = depth_noise_ * depth_noise_ + angle_ * angle_ * static_cast<double>(1 << (rows + columns));
        const float* halves_by_rows = rows > 0 ? sums[key_of(rows - 1, columns)].cost.data() : nullptr;
        const float* halves_by_columns = columns > 0 ? sums[key_of(rows, columns - 1)].cost.data() : nullptr;
        int8_t* choice = &choice_[key_of(rows, columns)][(top >> rows) * wide];
        here.cost.resize(wide * high);
        for (int64_t y = 0; y < high; ++y)
            for (int64_t x = 0; x < wide; ++x) {
                const int64_t i = wide * y + x;
                const double known = std::max(here.sure[i], 1.0), mean = here.first[i] / known;
                const bool on_two = here.second[i] / known - mean * mean > spread;
                float cost = here.left[i];
                int8_t best = kNothing;
                const auto take = [&](float other, int8_t what) {
                    best = other < cost ? what : best;
                    cost = other < cost ? other : cost;  // NaN is no cost
                };
                take(on_two ? kImpossible : here.distortion[i] + price_, kLeaf);
                if (halves_by_rows)
                    take(halves_by_rows[wide * 2 * y + x] + halves_by_rows[wide * (2 * y + 1) + x], kRows);
                if (halves_by_columns) take(halves_by_columns[2 * i] + halves_by_columns[2 * i + 1], kColumns);
                const bool any = here.count[i] > 0.0f;
                here.cost[i] = any ? cost : 0.0f;
                choice[i] = any ? best : static_cast<int8_t>(kNothing);
            }
    }

    void follow(int rows, int columns, std::array<std::vector<char>, kKeys>& reached, std::vector<int64_t>& sides,
                int64_t* labels) const {
        const int64_t wide = image_.width >> columns, high = image_.height >> rows;
        const int key = key_of(rows, columns);
        for (int64_t y = 0; y < high; ++y)
            for (int64_t x = 0; x < wide; ++x) {
                const int64_t i = wide * y + x;
                if (!reached[key][i]) continue;
                if (choice_[key][i] == kLeaf) {
                    const auto number = static_cast<int64_t>(sides.size() / 2);
                    sides.push_back(1 << rows), sides.push_back(1 << columns);
                    for (int64_t v = y << rows; v < (y + 1) << rows; ++v)
                        for (int64_t u = x << columns; u < (x + 1) << columns; ++u)
                            if (image_.taken[image_.width * v + u]) labels[image_.width * v + u] = number;
                } else if (choice_[key][i] == kRows) {
                    auto& halves = reached[key_of(rows - 1, columns)];
                    halves[wide * 2 * y + x] = halves[wide * (2 * y + 1) + x] = 1;
                } else if (choice_[key][i] == kColumns) {
                    auto& halves = reached[key_of(rows, columns - 1)];
                    halves[2 * i] = halves[2 * i + 1] = 1;
                }
            }
    }

    const Image& image_;
    double angle_;
    double depth_noise_;
    float price_;
    std::array<Means, kKeys> means_;
    std::vector<Between> across_;
    std::array<std::vector<int8_t>, kKeys> choice_;
};

}  // namespace

std::vector<int64_t> split(const Image& image, double angle, double depth_noise, float price, int threads,
                           int64_t* labels) {
    Splitting splitting(image, angle, depth_noise, price);
    Caught caught;
#pragma omp parallel num_threads(threads)
    {
        std::array<Sums, kKeys> sums;
#pragma omp for schedule(dynamic)
        for (int64_t top = 0; top < image.height; top += kSide) caught([&] { splitting.choose(top, sums); });
    }
    caught.rethrow();
    return splitting.follow(labels);
}

}  // namespace partition
