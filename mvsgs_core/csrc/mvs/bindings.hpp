// What the Python bindings of stereo, fusion and the mapper share: array types, checks, results.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <omp.h>

#include <cstdint>
#include <stdexcept>

#include "mvs/warp.hpp"

#define MVSGS_EXPAND(name, m) NB_MODULE(name, m)

namespace bindings {

namespace nb = nanobind;

using Image = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Stack = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Warps = nb::ndarray<const float, nb::shape<-1, 12>, nb::c_contig, nb::device::cpu>;
template <typename T>
using Result = nb::ndarray<nb::numpy, T>;

inline void require(bool condition, const char* what) {
    if (!condition) throw std::invalid_argument(what);
}

inline void same_size(const Image& a, const Image& b) {
    require(a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1), "maps of the reference must have its size");
}

inline void one_warp_each(const Stack& neighbors, const Warps& warps) {
    require(neighbors.shape(0) == warps.shape(0), "one warp per neighbor");
}

inline const mvs::Warp* data_of(const Warps& warps) { return reinterpret_cast<const mvs::Warp*>(warps.data()); }

template <typename Array>
int extent(const Array& array, std::size_t axis) {
    return static_cast<int>(array.shape(axis));
}

inline int thread_count(int threads) { return threads > 0 ? threads : omp_get_max_threads(); }

// A copy of a kernel's options with `threads` decided: 0 means all that OpenMP has.
template <typename Options>
Options with_threads(Options options) {
    options.threads = thread_count(options.threads);
    return options;
}

template <typename T, std::size_t N>
Result<T> allocate(const std::size_t (&shape)[N]) {
    std::size_t size = 1;
    for (std::size_t n : shape) size *= n;
    T* data = new T[size];
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return Result<T>(data, N, shape, owner);
}

}  // namespace bindings
