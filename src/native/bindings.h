// What binds each part of the core to Python, and how arrays come in.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstddef>
#include <initializer_list>

namespace clamber {

namespace nb = nanobind;

// Read-only arrays as Python hands them over: C order, on the CPU.
template <typename T = double>
using Array1 = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <typename T = double>
using Array2 = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <typename T = double>
using Array3 = nb::ndarray<const T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

// A NumPy array of its own, filled from `data`.
template <typename T>
nb::ndarray<nb::numpy, T> new_array(const T* data, std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t s : shape) size *= s;
    T* const copy = new T[size];
    std::copy(data, data + size, copy);
    nb::capsule owner(copy, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return {copy, shape, owner};
}

void bind_polygon(nb::module_& m);
void bind_statics(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_planes(nb::module_& m);
void bind_model(nb::module_& m);
void bind_posture(nb::module_& m);
void bind_servo(nb::module_& m);

}  // namespace clamber
