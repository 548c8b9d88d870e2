// Matching costs: how unlike a pixel's window and what a neighbor shows there are.
//
// A cost is a class in a file of its own, which ends in
//     const RegisteredCost registered("name", [](const CostOptions& o, int padded) -> std::unique_ptr<MatchingCost> {...});
// and its twin in mvsgs_core/mvs/matching_cost.py. The sweep knows none of them by name.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "mvs/mvs.hpp"
#include "mvs/windows.hpp"

namespace mvs {

// Columns [from, to) of some rows.
struct Columns {
    int from, to;
    Columns wider(int by, int width) const { return {std::max(from - by, 0), std::min(to + by, width)}; }
};

// What a neighbor shows of some rows of the reference at one hypothesis; rows padded by the windows' radius.
struct NeighborRows {
    int radius, padded, stride;
    int begin = 0;  // the first row
    std::vector<float> sample, seen;
    NeighborRows(int padded_, int radius_)
        : radius(radius_), padded(padded_), stride(padded_ + 2 * radius_),
          sample(static_cast<std::size_t>(stride) * (kBand + 2 * radius_), 0.0f),
          seen(static_cast<std::size_t>(padded_) * (kBand + 2 * radius_), 0.0f) {}

    // Gray levels of row y at column 0, which may be passed by the radius on both sides.
    const float* sample_row(int y) const { return sample.data() + static_cast<std::size_t>(y - begin) * stride + radius; }
    // 1 where the neighbor sees the pixel of row y, else 0.
    const float* seen_row(int y) const { return seen.data() + static_cast<std::size_t>(y - begin) * padded; }
};

class MatchingCost {
  public:
    virtual ~MatchingCost() = default;
    // Costs in [0, 1] of row y of the windows, in `columns`; whole vectors of lanes may be written, `padded` is enough.
    virtual void row(const Windows& windows, const NeighborRows& there, int y, Columns columns, float* cost) = 0;
};

// `padded`: length of a row. One is made for each thread. Raises std::invalid_argument for options without sense.
using MakeCost = std::unique_ptr<MatchingCost> (*)(const CostOptions& options, int padded);

struct RegisteredCost {
    RegisteredCost(const char* name, MakeCost make);
};

// Raises std::invalid_argument, naming those that there are.
MakeCost find_cost(const std::string& name);

}  // namespace mvs
