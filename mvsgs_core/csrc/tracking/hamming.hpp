// Mutual best matches of two sets of binary descriptors that pass the ratio test: all distances, none of them stored.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

namespace mvsgs {

constexpr int DESCRIPTOR_BYTES = 32, DESCRIPTOR_WORDS = DESCRIPTOR_BYTES / 8;

// In plain arithmetic, which compilers vectorize or know for the instruction that a machine may have.
inline uint64_t bits_set(uint64_t x) {
    x -= (x >> 1) & 0x5555555555555555;
    x = (x & 0x3333333333333333) + ((x >> 2) & 0x3333333333333333);
    return (((x + (x >> 4)) & 0x0f0f0f0f0f0f0f0f) * 0x0101010101010101) >> 56;
}

// Word w of all descriptors is contiguous, from w * n.
inline std::vector<uint64_t> by_words(const uint8_t* descriptors, int n) {
    std::vector<uint64_t> out(static_cast<size_t>(DESCRIPTOR_WORDS) * n);
    for (int k = 0; k < n; ++k)
        for (int w = 0; w < DESCRIPTOR_WORDS; ++w)
            std::memcpy(&out[static_cast<size_t>(w) * n + k], descriptors + DESCRIPTOR_BYTES * k + 8 * w, 8);
    return out;
}

// Pairs (row of a, row of b), by rows of a: each the other's nearest, the first of equal ones, nearer than `limit` bits
// and than `ratio` of the distance to the second nearest in b.
inline std::vector<int64_t> mutual_matches(const uint8_t* a, int n, const uint8_t* b, int m, int limit, double ratio) {
    const std::vector<uint64_t> words = by_words(b, m);
    std::vector<int32_t> distance(m), smallest(m, 8 * DESCRIPTOR_BYTES + 1), nearest_of_b(m, -1), nearest_of_a(n, -1);
    for (int i = 0; i < n; ++i) {
        uint64_t own[DESCRIPTOR_WORDS];
        std::memcpy(own, a + DESCRIPTOR_BYTES * i, DESCRIPTOR_BYTES);
        for (int j = 0; j < m; ++j) {
            uint64_t sum = 0;
            for (int w = 0; w < DESCRIPTOR_WORDS; ++w) sum += bits_set(own[w] ^ words[static_cast<size_t>(w) * m + j]);
            distance[j] = static_cast<int32_t>(sum);
        }
        for (int j = 0; j < m; ++j) {
            const bool nearer = distance[j] < smallest[j];
            smallest[j] = nearer ? distance[j] : smallest[j];
            nearest_of_b[j] = nearer ? i : nearest_of_b[j];
        }
        int best = -1, first = 8 * DESCRIPTOR_BYTES + 1, second = first;
        for (int j = 0; j < m; ++j) {
            if (distance[j] >= second) continue;
            second = std::max(first, distance[j]);
            if (distance[j] < first) first = distance[j], best = j;
        }
        if (first < limit && first < ratio * second) nearest_of_a[i] = best;
    }
    std::vector<int64_t> pairs;
    for (int i = 0; i < n; ++i)
        if (const int j = nearest_of_a[i]; j >= 0 && nearest_of_b[j] == i) pairs.insert(pairs.end(), {i, j});
    return pairs;
}

}  // namespace mvsgs
