// Signed distances between convex shapes.
#pragma once

#include <vector>

#include "linalg.h"

namespace clamber {

// Convex is the hull of a mesh's vertices.
enum class ShapeKind : int { Plane, Sphere, Capsule, Ellipsoid, Cylinder, Box, Convex };

// As MuJoCo has geoms: a plane is the half-space below z = 0 of its frame; capsules and
// cylinders lie along z.
struct Shape {
    ShapeKind kind = ShapeKind::Sphere;
    Vec3 size;                   // MuJoCo's geom_size: radii and half lengths
    std::vector<Vec3> vertices;  // of Convex, in the geom's frame
    double bound = 0.0;          // radius of a sphere about the geom's origin that holds it
};

// With the bound that belongs to it.
Shape make_shape(ShapeKind kind, const Vec3& size, std::vector<Vec3> vertices = {});

struct Pose {
    Vec3 p;
    Mat3 R;
};

// second = first + distance * normal. The normal is a unit vector from the first shape to
// the second, also where they touch or overlap; the distance is then minus the shortest
// translation that parts them. Where no answer is unique, one of them.
struct Nearest {
    double distance;
    Vec3 first, second, normal;
};

// The distance is NaN where a pose is not finite, infinite between planes.
Nearest nearest(const Shape& a, const Pose& A, const Shape& b, const Pose& B);

}  // namespace clamber
