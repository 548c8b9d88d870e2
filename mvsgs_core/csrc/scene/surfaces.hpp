// What a ray sees where it hits: textured, lit triangles. Textures are sRGB with a mip chain; light is a coarse linear map.
#pragma once
#include <cstdint>
#include <vector>

#include "bvh.hpp"

namespace scene {

typedef float Color __attribute__((vector_size(16)));  // linear r, g, b, unused

struct Patch {
    int height, width;  // texture, texels
    int light_height, light_width;
    float gloss;
    int levels = 0;
    size_t offsets[16] = {};  // of each mip level in the pool
    size_t light_offset = 0;
    Color mean_albedo{};
};

struct Triangle {
    Vec3 normal;  // unit
    float u[3], v[3];  // texture coordinates of the corners, 0 to 1 over the patch
    float density;  // texels per square unit of length
    int patch;
};

class Surfaces {
public:
    std::vector<Triangle> triangles;
    std::vector<Patch> patches;

    // Appends a patch with its mip chain. rgb: (height, width, 3) sRGB.
    void add_patch(const uint8_t* rgb, int height, int width, int light_height, int light_width, float gloss);
    size_t light_texels() const { return light_.size(); }
    Color* light() { return light_.data(); }

    // Linear albedo at (u, v) of a patch, filtered over `footprint` texels (an area), trilinear.
    Color albedo(const Patch& patch, float u, float v, float footprint) const;
    Color light_at(const Patch& patch, float u, float v) const;

private:
    std::vector<uint32_t> pool_;
    std::vector<Color> light_;
    Color texel(const Patch& patch, int level, float u, float v) const;
};

Color to_linear(Color srgb_0_255);

}  // namespace scene
