// Bounding volume hierarchy over triangles (binned surface area heuristic) and its traversal by packets of 16 rays
// that leave one point: the camera center or a texel. With a common origin a triangle test is three dot products a ray.
#pragma once
#include <cstdint>
#include <vector>

#include "vector.hpp"

namespace scene {

constexpr int LANES = 16;

struct Corners {
    Vec3 a, ab, ac;  // first corner, edges to the other two
};

struct alignas(64) Packet {
    float dx[LANES], dy[LANES], dz[LANES];
    float t[LANES];  // in: limit; out: nearest hit, in lengths of the direction
    float u[LANES], v[LANES];  // barycentrics of the hit
    int triangle[LANES];  // -1: no hit
    Vec3 origin;
};

class Bvh {
public:
    explicit Bvh(std::vector<Corners> triangles);

    // Nearest hit of every lane beyond `t_min`; lanes whose `t` is 0 stay inactive.
    void nearest(Packet& packet, float t_min) const;

private:
    struct Node {
        Vec3 low, high;
        int first;  // leaf: first triangle in order_; inner: index of the second child (the first one follows)
        uint16_t count;  // 0: inner node
        uint16_t axis;
    };
    std::vector<Node> nodes_;
    std::vector<Corners> ordered_;
    std::vector<int> order_;

    int build(const std::vector<Vec3>& low, const std::vector<Vec3>& high, int first, int last, int depth);
    static void intersect(Packet& packet, const Corners& triangle, int id, float t_min);
};

}  // namespace scene
