// The machine's peaks, for the roofline that the benchmark prints.
#include <omp.h>

#include <chrono>

#include "splats/baseline.hpp"
#include "splats/tile.hpp"

namespace splats {
namespace {

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

template <bool Exact>
void evaluate(int rounds) {
    constexpr int kStreams = 4;  // independent chains, to hide latency
    ScreenSplat s{};
    s.log2_opacity = -0.5f;
    s.half_beta = 0.8f;
    Lanes u[kStreams], total[kStreams] = {};
    for (int k = 0; k < kStreams; ++k) u[k] = 0.01f * kLaneX + 0.1f * float(k);
    for (int i = 0; i < rounds; ++i) {
        for (int k = 0; k < kStreams; ++k) {
            Lanes log2_m, power;
            total[k] += exp2_of_negative(log2_alpha<Exact>(s, u[k], kLaneY, log2_m, power));
            u[k] += 1e-6f;
        }
    }
    volatile float sink = sum(total[0] + total[1] + total[2] + total[3]);
    (void)sink;
}

}  // namespace

double peak_densities(bool exact, int threads) {
    constexpr int kRounds = 1 << 18;
    const double seconds = best_seconds(threads, [&] { exact ? evaluate<true>(kRounds) : evaluate<false>(kRounds); });
    return 4.0 * kLanes * kRounds * threads / seconds;
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
