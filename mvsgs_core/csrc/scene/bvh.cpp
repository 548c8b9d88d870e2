#pragma GCC optimize("O3")  // the binding library asks for small code; these loops want lanes
#include "bvh.hpp"

#include <algorithm>
#include <limits>
#include <numeric>

namespace scene {

namespace {

constexpr int BINS = 12;
constexpr int LEAF = 4;
constexpr int DEEPEST = 64;  // levels that follow the heuristic; 31 halvings after it reach any leaf
constexpr int STACK = 128;
constexpr float EDGE_TOLERANCE = 2e-6f;  // closes the cracks between neighboring triangles

Vec3 minimum(Vec3 a, Vec3 b) { return {std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)}; }
Vec3 maximum(Vec3 a, Vec3 b) { return {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}; }

struct Bounds {
    Vec3 low{1e30f, 1e30f, 1e30f}, high{-1e30f, -1e30f, -1e30f};
    void add(Vec3 l, Vec3 h) {
        low = minimum(low, l);
        high = maximum(high, h);
    }
    float area() const {
        const Vec3 d = high - low;
        return d.x < 0 ? 0.0f : d.x * d.y + d.y * d.z + d.z * d.x;
    }
};

}  // namespace

Bvh::Bvh(std::vector<Corners> triangles) : order_(triangles.size()) {
    std::iota(order_.begin(), order_.end(), 0);
    std::vector<Vec3> low(triangles.size()), high(triangles.size());
    for (size_t i = 0; i < triangles.size(); ++i) {
        const Vec3 a = triangles[i].a, b = a + triangles[i].ab, c = a + triangles[i].ac;
        low[i] = minimum(a, minimum(b, c));
        high[i] = maximum(a, maximum(b, c));
    }
    nodes_.reserve(triangles.size());
    build(low, high, 0, static_cast<int>(triangles.size()), 0);
    ordered_.reserve(triangles.size());
    for (const int i : order_) ordered_.push_back(triangles[i]);
}

int Bvh::build(const std::vector<Vec3>& low, const std::vector<Vec3>& high, int first, int last, int depth) {
    Bounds bounds, centers;
    for (int i = first; i < last; ++i) {
        const int k = order_[i];
        bounds.add(low[k], high[k]);
        const Vec3 c = 0.5f * (low[k] + high[k]);
        centers.add(c, c);
    }
    const int index = static_cast<int>(nodes_.size());
    nodes_.push_back({bounds.low, bounds.high, first, static_cast<uint16_t>(last - first), 0});
    if (last - first <= LEAF) return index;

    const Vec3 extent = centers.high - centers.low;
    float best = std::numeric_limits<float>::max();
    int best_axis = -1, best_bin = 0;
    auto bin_of = [&](int k, int axis) {
        const float c = 0.5f * (low[k][axis] + high[k][axis]);
        return std::min(BINS - 1, static_cast<int>(BINS * (c - centers.low[axis]) / extent[axis]));
    };
    for (int axis = 0; axis < 3; ++axis) {
        if (!(extent[axis] > 0)) continue;
        Bounds bins[BINS];
        int counts[BINS] = {};
        for (int i = first; i < last; ++i) {
            const int k = order_[i], b = bin_of(k, axis);
            bins[b].add(low[k], high[k]);
            ++counts[b];
        }
        float right_cost[BINS] = {};
        Bounds right;
        for (int b = BINS - 1, n = 0; b > 0; --b) {
            right.add(bins[b].low, bins[b].high);
            n += counts[b];
            right_cost[b] = static_cast<float>(n) * right.area();
        }
        Bounds left;
        for (int b = 0, n = 0; b < BINS - 1; ++b) {
            left.add(bins[b].low, bins[b].high);
            n += counts[b];
            const float cost = static_cast<float>(n) * left.area() + right_cost[b + 1];
            if (n > 0 && n < last - first && cost < best) best = cost, best_axis = axis, best_bin = b;
        }
    }
    int middle = (first + last) / 2;  // of triangles in any order, where no plane parts them or the tree gets too deep
    if (best_axis >= 0 && depth < DEEPEST) {
        middle = static_cast<int>(std::partition(order_.begin() + first, order_.begin() + last,
                                                 [&](int k) { return bin_of(k, best_axis) <= best_bin; }) -
                                  order_.begin());
    } else if (best_axis < 0 && last - first < std::numeric_limits<uint16_t>::max()) {
        return index;  // all centers coincide: one leaf
    }
    build(low, high, first, middle, depth + 1);
    const int second = build(low, high, middle, last, depth + 1);
    nodes_[index].first = second;
    nodes_[index].count = 0;
    nodes_[index].axis = static_cast<uint16_t>(std::max(best_axis, 0));
    return index;
}

// Moeller and Trumbore 1997, with everything that does not depend on the direction taken out of the lanes' loop.
void Bvh::intersect(Packet& packet, const Corners& triangle, int id, float t_min) {
    const Vec3 s = packet.origin - triangle.a;
    const Vec3 normal = cross(triangle.ac, triangle.ab);
    const Vec3 to_u = cross(triangle.ac, s), to_v = cross(s, triangle.ab);
    const float to_t = dot(triangle.ac, cross(s, triangle.ab));
    for (int l = 0; l < LANES; ++l) {
        const float dx = packet.dx[l], dy = packet.dy[l], dz = packet.dz[l];
        const float inverse = 1.0f / (dx * normal.x + dy * normal.y + dz * normal.z);
        const float u = (dx * to_u.x + dy * to_u.y + dz * to_u.z) * inverse;
        const float v = (dx * to_v.x + dy * to_v.y + dz * to_v.z) * inverse;
        const float t = to_t * inverse;
        const bool hit = (u >= -EDGE_TOLERANCE) & (v >= -EDGE_TOLERANCE) & (u + v <= 1.0f + EDGE_TOLERANCE) &
                         (t > t_min) & (t < packet.t[l]);
        packet.t[l] = hit ? t : packet.t[l];
        packet.u[l] = hit ? u : packet.u[l];
        packet.v[l] = hit ? v : packet.v[l];
        packet.triangle[l] = hit ? id : packet.triangle[l];
    }
}

void Bvh::nearest(Packet& packet, float t_min) const {
    alignas(64) float ix[LANES], iy[LANES], iz[LANES];
    Vec3 mean;
    for (int l = 0; l < LANES; ++l) {
        auto inverse = [](float d) { return 1.0f / (std::fabs(d) < 1e-12f ? std::copysign(1e-12f, d) : d); };
        ix[l] = inverse(packet.dx[l]);
        iy[l] = inverse(packet.dy[l]);
        iz[l] = inverse(packet.dz[l]);
        mean = mean + Vec3{packet.dx[l], packet.dy[l], packet.dz[l]};
        packet.triangle[l] = -1;
    }
    if (ordered_.empty()) return;
    int stack[STACK];
    int top = 0;
    stack[top++] = 0;
    while (top > 0) {
        const int index = stack[--top];
        const Node& node = nodes_[index];
        const Vec3 low = node.low - packet.origin, high = node.high - packet.origin;
        int any = 0;
        for (int l = 0; l < LANES; ++l) {
            const float x0 = low.x * ix[l], x1 = high.x * ix[l];
            const float y0 = low.y * iy[l], y1 = high.y * iy[l];
            const float z0 = low.z * iz[l], z1 = high.z * iz[l];
            float near = x0 < x1 ? x0 : x1, far = x0 < x1 ? x1 : x0;
            const float ny = y0 < y1 ? y0 : y1, fy = y0 < y1 ? y1 : y0;
            const float nz = z0 < z1 ? z0 : z1, fz = z0 < z1 ? z1 : z0;
            near = near > ny ? near : ny;
            near = near > nz ? near : nz;
            far = far < fy ? far : fy;
            far = far < fz ? far : fz;
            any |= (near <= far * 1.00001f) & (far > t_min) & (near < packet.t[l]);
        }
        if (!any) continue;
        if (node.count > 0) {
            for (int i = node.first; i < node.first + node.count; ++i) intersect(packet, ordered_[i], order_[i], t_min);
        } else if (mean[node.axis] > 0) {
            stack[top++] = node.first;
            stack[top++] = index + 1;
        } else {
            stack[top++] = index + 1;
            stack[top++] = node.first;
        }
    }
}

}  // namespace scene
