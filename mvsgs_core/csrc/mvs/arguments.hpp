// What Python hands over to stereo and fusion, as the kernels take it.
#pragma once

#include "bindings.hpp"
#include "mvs/warp.hpp"

namespace bindings {

using Image = Array<float, nb::ndim<2>>;
using Stack = Array<float, nb::ndim<3>>;
using Warps = Array<float, nb::shape<-1, 12>>;

inline void same_size(const Image& a, const Image& b) {
    require(a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1), "maps of the reference must have its size");
}

inline void one_warp_each(const Stack& neighbors, const Warps& warps) {
    require(neighbors.shape(0) == warps.shape(0), "one warp per neighbor");
}

inline const mvs::Warp* data_of(const Warps& warps) { return reinterpret_cast<const mvs::Warp*>(warps.data()); }

template <typename Values>
int extent(const Values& values, std::size_t axis) {
    return static_cast<int>(values.shape(axis));
}

// A copy of a kernel's options with `threads` decided.
template <typename Options>
Options with_threads(Options options) {
    options.threads = thread_count(options.threads);
    return options;
}

}  // namespace bindings
