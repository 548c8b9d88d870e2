// What a forward pass computes and a backward pass reads again: splats on the image, and their pairs with tiles.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#if __has_include(<sys/mman.h>)
#include <sys/mman.h>
#endif
#include <utility>
#include <vector>

#include "rasterizer/adam.hpp"
#include "rasterizer/lanes.hpp"

namespace splats {

constexpr uint32_t kMaxPairs = uint32_t(1) << 31;  // of a view, with tiles: places are 32-bit integers
constexpr size_t kChunk = 1024;        // splats that a thread takes at once; sums by chunk do not depend on the threads
constexpr int kTile = 16;              // pixels; 16 blocks of 4x4, one vector each
constexpr float kBlur = 0.3f;          // px^2 on the diagonal of the image covariance
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kLog2MinAlpha = -7.994353436858858f;  // log2(1 / 255)
constexpr float kClampMargin = 0.3f;  // of tan(fov)
constexpr float kMinCompensation = 0.005f;
constexpr float kMaxMotion = 0.5f;  // of the image's width or height
constexpr float kMaxVariance = 1e16f;  // px^2
constexpr float kMinQuaternion = 1e-8f;
constexpr float kMaxReach = 1e12f;
constexpr float kMinBeta = 0.1f, kMaxBeta = 20.0f;
constexpr float kCenterM = 1e-6f;      // the exact kernel is flat below this m
constexpr float kSqrtHalfLog2e = 0.8493218002880191f;  // sqrt(log2(e) / 2)
constexpr float kHalfLog2e = 0.7213475204444817f;

// At least so many bytes, aligned to cache lines; from huge pages where they are many: the walks go through all of it.
inline void* take_memory(size_t bytes) {
    constexpr size_t kHuge = size_t(1) << 21;
    const size_t page = bytes >= kHuge ? kHuge : 64;
    const size_t whole = (bytes + page - 1) / page * page;
    void* memory = std::aligned_alloc(page, whole);
    if (!memory) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
    if (page == kHuge) madvise(memory, whole, MADV_HUGEPAGE);
#endif
    return memory;
}

// Grow-only memory without initialization, aligned to cache lines.
template <class T>
class Buffer {
   public:
    T* resize(size_t count) {
        if (count > capacity_) {
            release();
            const size_t capacity = count + count / 4 + 64;
            data_ = static_cast<T*>(take_memory(capacity * sizeof(T)));
            capacity_ = capacity;  // only now: the memory may not be there
        }
        return data_;
    }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }
    T* data() { return data_; }
    const T* data() const { return data_; }
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { release(); }

   private:
    void release() {
        std::free(data_);
        data_ = nullptr;
        capacity_ = 0;
    }
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

struct Camera {
    double rotation[3][3];  // world_from_cam
    double center[3];       // of the camera, world
    float fx, fy, cx, cy;   // px
    int width, height;
    float near;
    float slope_min[2], slope_max[2];  // limits of x/z and y/z in the Jacobian
    std::array<float, 6> readout;      // twist while the image is read
    bool rolling = false;              // whether that is not 0
};

// Read-only parameters; shapes as in splats.py.
struct Parameters {
    const float *means, *log_scales, *quaternions, *opacity_logits, *sh, *betas;
    int64_t count;
    int bases, degree;
    bool exact, antialiased;
};

// A splat on the image, one cache line. With d = pixel - mean: u = pitch_u (dx - shear dy), v = pitch_v dy;
// Gaussian: log2(alpha) = log2_opacity - u^2 - v^2; exact: m = u^2 + v^2 and
// log2(alpha) = log2_opacity - log2(e)/2 m^(beta/2). The mean is split, for dx keeps its precision far from the corner.
struct alignas(64) ProjectedSplat {
    float whole_x, whole_y, part_x, part_y;  // mean = whole + part, px
    float pitch_u, shear, pitch_v;
    float log2_opacity;
    float red, green, blue, depth;
    float half_beta;
    float radius;        // px, 0 = not visible
    float unused[2];
};

// The slots of a splat's pairs.
struct SlotSpan {
    uint32_t first, count;
};

// Pairs of some splats with the tiles they touch, in the order of the splats.
struct PairList {
    std::vector<uint32_t> tiles;
    std::vector<uint16_t> blocks;
    uint32_t count = 0;
};

struct Pair {
    uint32_t splat;
    uint32_t slot;    // place in the order by splat: where the backward pass leaves this pair's sums
    uint16_t blocks;  // which of the tile's 4x4 blocks the ellipse touches; after blending: of those, which it found
                      // not yet full
};

struct Frame {
    Camera camera;
    bool exact = false, antialiased = false;
    int degree = 0, tiles_x = 0, tiles_y = 0;
    float background[3] = {0, 0, 0};
    int64_t refused = 0, pair_count = 0, visible_count = 0;
    int64_t evaluated = 0;    // kernel values of the last forward pass, lanes off the ellipse included
    int64_t contributed = 0;  // of those, pairs of splat and pixel that got color; counted with the weights only
    Buffer<ProjectedSplat> splats;      // by splat index
    Buffer<SlotSpan> spans;          // by splat index
    Buffer<uint32_t> order, order_scratch, depth_keys, depth_keys_scratch;
    std::vector<PairList> chunk_pairs;  // of kChunk splats each
    Buffer<uint32_t> listed_tiles;   // of all pairs, by slot
    Buffer<uint16_t> listed_blocks;
    Buffer<uint32_t> chunk_counts;   // (threads, tiles)
    Buffer<Pair> pairs;              // by tile, front to back
    Buffer<uint32_t> tile_begin;     // (tiles + 1)
    Buffer<Lanes> slots;             // by splat: sums of one pair each
    Buffer<float> weight_slots;      // by splat: the largest blending weight of one pair
};

struct Gradients {
    float *means, *log_scales, *quaternions, *opacity_logits, *sh, *betas, *means2d;
    double* pose;  // (3, 4): of the rotation and of the camera's center
    int64_t refused = 0;
};

// What a backward pass that steps the splats itself leaves.
struct Stepped {
    float *means2d_gradient, *means2d_views;  // (N) added to: the gradient's length on the image, 1 for each splat seen
    double* pose;                             // as of Gradients
    int64_t refused = 0, refused_steps = 0;   // splats with gradients, and with steps, that are not finite
};

// Projects and orders the splats and pairs them with the tiles they touch; radii (N), px, are 0 where nothing is seen.
// Raises std::invalid_argument for max_pairs pairs or more.
void bin(Frame& frame, const Parameters& parameters, uint32_t max_pairs, float* radii, int threads);

// Blends all tiles; color (H, W, 3), depth (H, W), opacity (H, W). weights: fill frame.weight_slots as well.
void blend(Frame& frame, bool weights, float* color, float* depth, float* opacity, int threads);

// Sums of one pair, as they lie in a slot (through kSumLane).
enum Sum { kRed, kGreen, kBlue, kDepth, kAlpha, kU, kV, kUU, kUV, kVV, kBeta };

// Fills frame.slots from the gradients of the outputs; depth_gradient and opacity_gradient may be null.
void blend_backward(Frame& frame, const float* color, const float* depth, const float* opacity,
                    const float* color_gradient, const float* depth_gradient, const float* opacity_gradient,
                    int threads);

// Sums the slots of every splat and takes them to its parameters and to the pose.
void project_backward(Frame& frame, const Parameters& parameters, Gradients& gradients, int threads);

// The gradients (N) of the opacities' logits alone, from the same slots. Returns how many were not finite: they are 0.
int64_t opacity_backward(const Frame& frame, const float* opacity_logits, int64_t count, float* on_logits, int threads);

// As project_backward, and each splat seen is stepped while its gradients are in the cache, instead of their being kept. fields: of
// Splats, that each of the step's groups is.
void project_and_step(Frame& frame, const Parameters& parameters, const adam::Step& step, const std::vector<int>& fields,
                      Stepped& stepped, int threads);

}  // namespace splats
