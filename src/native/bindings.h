// What binds each part of the core to Python, and how arrays come in.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace clamber {

namespace nb = nanobind;

// Read-only arrays as Python hands them over: C order, on the CPU.
template <typename T = double>
using Array1 = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <typename T = double>
using Array2 = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

void bind_statics(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_servo(nb::module_& m);

}  // namespace clamber
