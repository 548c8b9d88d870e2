// What the Python bindings of all kernels share: arrays in and out, checks, threads.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <omp.h>

#include <cstddef>
#include <initializer_list>
#include <stdexcept>
#include <utility>
#include <vector>

#include "in_place.hpp"

namespace bindings {

namespace nb = nanobind;

// What a kernel reads.
template <class T, class... Shape>
using Array = nb::ndarray<const T, nb::c_contig, nb::device::cpu, Shape...>;
// What it writes into.
template <class T, class... Shape>
using Written = InPlace<T, nb::c_contig, nb::device::cpu, Shape...>;
// What it makes.
template <class T>
using Result = nb::ndarray<nb::numpy, T>;

inline void require(bool condition, const char* what) {
    if (!condition) throw std::invalid_argument(what);
}

// 0: all that OpenMP has.
inline int thread_count(int threads) { return threads > 0 ? threads : omp_get_max_threads(); }

// Not initialized.
template <class T>
Result<T> allocate(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t n : shape) size *= n;
    T* data = new T[size];
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return Result<T>(data, shape, owner);
}

// The values themselves, not a copy.
template <class T>
Result<T> to_numpy(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
    auto* owned = new std::vector<T>(std::move(values));
    nb::capsule owner(owned, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
    return Result<T>(owned->data(), shape, owner);
}

}  // namespace bindings
