// What binds each part of the core to Python, and how arrays come in.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstddef>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

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

// NumPy arrays that take a vector over.
template <typename T>
nb::ndarray<nb::numpy, T, nb::c_contig, nb::device::cpu> own(std::vector<T>&& data,
                                                             std::vector<std::size_t> shape) {
    auto* kept = new std::vector<T>(std::move(data));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
    return {kept->data(), shape.size(), shape.data(), owner};
}

using Matrix = nb::ndarray<nb::numpy, double, nb::c_contig, nb::device::cpu>;

inline Matrix own(std::vector<double>&& data, std::vector<std::size_t> shape) {
    return own<double>(std::move(data), std::move(shape));
}

inline Matrix own(std::vector<double>&& data) {
    const std::size_t n = data.size();
    return own(std::move(data), {n});
}

inline void check_size(std::size_t n, std::size_t expected, const char* what) {
    if (n != expected)
        throw std::invalid_argument(std::string(what) + ": " + std::to_string(n) +
                                    " numbers, expected " + std::to_string(expected));
}

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

inline void want(bool holds, const char* what) {
    if (!holds) throw nb::value_error(what);
}

void bind_polygon(nb::module_& m);
void bind_statics(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_planes(nb::module_& m);
void bind_model(nb::module_& m);
void bind_posture(nb::module_& m);
void bind_spline(nb::module_& m);
void bind_balance(nb::module_& m);
void bind_servo(nb::module_& m);

}  // namespace clamber
