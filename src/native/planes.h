// Planar regions of a surface that is given as many small elements and their neighbours.
#pragma once

#include <cstdint>

#include "linalg.h"

namespace clamber {

struct Elements {
    int n = 0, k = 0;                     // elements, corners of each
    const double* corners = nullptr;      // (n, k, 3)
    const double* normals = nullptr;      // (n, 3)
    const double* weights = nullptr;      // (n,)
    const std::int32_t* first = nullptr;  // (n + 1,) where neighbours of each begin
    const std::int32_t* next = nullptr;   // those
    const std::int32_t* order = nullptr;  // (n,) in which elements begin a region
};

// Labels (n,): elements of one number are connected and lie within `reach` of one plane,
// their normals within the angle of that cosine.
void grow_planes(const Elements& of, double reach, double cosine, std::int32_t* label);

}  // namespace clamber
