// The pose's gradient: (3, 4) by rows, of the rotation and of the camera's center.
#pragma once

#include <algorithm>
#include <vector>

#include "rasterizer/lanes.hpp"

namespace splats {

// Sums of a chunk, lane by lane in float64.
struct PoseSum {
    alignas(64) double lanes[12][kLanes] = {};

    void add(int entry, const Lanes& part) {
        alignas(64) float values[kLanes];
        store(part, values);
        for (int i = 0; i < kLanes; ++i) lanes[entry][i] += values[i];
    }

    void total(double* pose) const {
        for (int k = 0; k < 12; ++k) {
            pose[k] = 0.0;
            for (const double value : lanes[k]) pose[k] += value;
        }
    }
};

// Adds up the chunks' parts, in their order.
inline void sum_pose(const std::vector<double>& parts, double* pose) {
    std::fill(pose, pose + 12, 0.0);
    for (size_t k = 0; k < parts.size(); ++k) pose[k % 12] += parts[k];
}

}  // namespace splats
