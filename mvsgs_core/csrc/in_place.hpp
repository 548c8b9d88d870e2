// Arrays of Python's that a kernel writes into.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <utility>

// As an ndarray, but taken as it lies in memory or refused with a TypeError that names what is expected: of an array of
// another dtype or order the binding would make a copy, and what is written into that is lost.
template <class... Traits>
struct InPlace : nanobind::ndarray<Traits...> {
    InPlace() = default;
    explicit InPlace(nanobind::ndarray<Traits...>&& array) : nanobind::ndarray<Traits...>(std::move(array)) {}
};

namespace nanobind::detail {

template <class... Traits>
struct type_caster<InPlace<Traits...>> {
    using Array = make_caster<ndarray<Traits...>>;
    NB_TYPE_CASTER(InPlace<Traits...>, Array::Name)

    template <class Flags>
    bool from_python(handle source, Flags flags, cleanup_list* cleanup) noexcept {
        Array array;
        if (!array.from_python(source, Flags(flags & ~Flags(cast_flags::convert)), cleanup)) return false;
        value = InPlace<Traits...>(std::move(array.value));
        return true;
    }
};

}  // namespace nanobind::detail
