// The support polygon: where the centre of mass may be, and how far it is from there.
// In the horizontal plane, by sums, products and square roots alone: the same bits
// everywhere.
#pragma once

namespace clamber {

// Convex, counter-clockwise, without collinear vertices; a segment or a point too.
struct Polygon {
    static constexpr int CAPACITY = 64;
    int n = 0;
    double v[CAPACITY][2];
};

// The convex hull of n points, exact on a grid of 2^-30 m to which they are rounded. False,
// and a polygon without vertices, where it has more than `CAPACITY` of them or a coordinate
// is no number below 2^31 m.
bool support_polygon(const double (*points)[2], int n, Polygon& out);

// Half-planes `A p <= b` with unit outward normals, one of each edge; of a segment or a
// point four that only it satisfies. A and b have room for `CAPACITY`. The number of rows,
// 0 without vertices.
int halfplanes(const Polygon& polygon, double (*A)[2], double* b);

// Distance to the border, positive inside: -inf without vertices, NaN from no number.
// `outward` (2,) is the unit direction that leads out the shortest way.
double nearest_border(double x, double y, const Polygon& polygon, double* outward);

double com_margin(double x, double y, const Polygon& polygon);

// Inside a polygon, as a string around two foci draws it.
struct Ellipse {
    double centre[2], semi_axes[2], foci[2][2];  // the longer axis first
    double string_length;                        // summed distance of the border to the foci
};

// From inside, with the centre of area and the second moments' axes, as large as fits;
// without area of a segment or a point. The polygon has vertices.
Ellipse support_ellipse(const Polygon& polygon);

// Summed distance to the foci less the string length, negative inside; its gradient (2,).
double excess(const Ellipse& ellipse, double x, double y, double* gradient);

}  // namespace clamber
