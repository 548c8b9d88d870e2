// Python bindings of the sparse bundle adjustment.
#pragma once

#include <nanobind/nanobind.h>

void define_sparse_adjustment(nanobind::module_& m);
