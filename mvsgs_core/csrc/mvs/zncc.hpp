#pragma once

#include <vector>

#include "mvs/matching_cost.hpp"

namespace mvs {

// ZNCC of the reference's windows against what a neighbor shows, row by row.
class Correlation {
  public:
    std::vector<float> value, mean;  // [column]: ZNCC, mean gray level of the neighbor's window

    explicit Correlation(int padded) : value(padded), mean(padded), variance_(padded) {}

    // Of row y, from the first of the columns to the end of the last one's vector.
    void row(const Windows& windows, const NeighborRows& there, int y, Columns columns, float noise);

  private:
    std::vector<float> variance_;
};

}  // namespace mvs
