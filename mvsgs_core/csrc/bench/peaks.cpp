// The machine's peaks, for the roofline that the benchmark prints.
#include <omp.h>

#include <chrono>

#include "bench/bench.hpp"
#include "rasterizer/tile.hpp"

namespace splats {
namespace {

constexpr int kStreams = 4;  // independent chains of kernel values, to hide latency
#if defined(__AVX512F__)
constexpr int kRegisters = 1;  // of a `Lanes`
#elif defined(__AVX2__)
constexpr int kRegisters = 2;
#else
constexpr int kRegisters = 4;
#endif
constexpr int kChains = 12 / kRegisters;  // of products: more than latency times throughput, fewer than registers

// The compiler may not leave out what led to `value`.
template <class Value>
void keep(const Value& value) {
    asm volatile("" ::"m"(value));
}

// The best of some repetitions of `work` by all threads, in seconds.
template <class Work>
double best_seconds(int threads, Work work) {
    double best = 1e9;
    for (int repeat = 0; repeat < 7; ++repeat) {
        const auto start = std::chrono::steady_clock::now();
#pragma omp parallel num_threads(threads)
        work();
        best = std::min(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count());
    }
    return best;
}

// u and v to alpha, v the same all the time.
template <bool Exact>
void evaluate(int rounds) {
    constexpr float kLog2Opacity = -0.5f, kHalfBeta = 0.8f;
    Lanes u[kStreams], total[kStreams] = {};
    for (int k = 0; k < kStreams; ++k) u[k] = 0.01f * kLaneX + 0.1f * float(k);
    for (int i = 0; i < rounds; ++i) {
        for (int k = 0; k < kStreams; ++k) {
            Lanes m = u[k] * u[k] + kLaneY * kLaneY;
            if constexpr (Exact) m = exp2_limited(kHalfBeta * log2_of_positive(maximum(m, all(kCenterM))));
            total[k] += exp2_of_negative(kLog2Opacity - kHalfLog2e * m);
            u[k] += 1e-6f;
        }
    }
    for (const Lanes& sum : total) keep(sum);
}

void multiply(int rounds) {
    const Lanes factor = all(0.999f), step = all(1e-3f);
    Lanes chains[kChains];
    for (int k = 0; k < kChains; ++k) chains[k] = all(0.1f * float(k));
    for (int i = 0; i < rounds; ++i)
        for (Lanes& chain : chains) chain = chain * factor + step;
    for (const Lanes& chain : chains) keep(chain);
}

}  // namespace

double peak_kernel_values(bool exact, int threads) {
    constexpr int kRounds = 1 << 18;
    const double seconds = best_seconds(threads, [&] { exact ? evaluate<true>(kRounds) : evaluate<false>(kRounds); });
    return double(kStreams) * kLanes * kRounds * threads / seconds;
}

double peak_products(int threads) {
    constexpr int kRounds = 1 << 18;
    const double seconds = best_seconds(threads, [] { multiply(kRounds); });
    return double(kChains) * kLanes * kRounds * threads / seconds;
}

double peak_tile_bytes(int threads) {
    constexpr int kRounds = 1 << 14, kVectors = 16 * 5;
    const double seconds = best_seconds(threads, [] {
        Lanes blocks[kVectors] = {};
        for (int i = 0; i < kRounds; ++i) {
            for (Lanes& block : blocks) block += 1.0f;
            asm volatile("" ::"r"(blocks) : "memory");
        }
    });
    return 2.0 * sizeof(Lanes) * kVectors * kRounds * threads / seconds;
}

double peak_memory_bytes(int threads) {
    constexpr size_t kFloats = 1 << 23;  // 32 MB a thread
    std::vector<std::vector<float>> from(threads, std::vector<float>(kFloats, 1.0f)), to = from;
    const double seconds = best_seconds(threads, [&] {
        const int thread = omp_get_thread_num();
        std::copy(from[thread].begin(), from[thread].end(), to[thread].begin());
    });
    return 2.0 * sizeof(float) * kFloats * threads / seconds;
}

}  // namespace splats
