#include "proximity.h"

#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include "bindings.h"

namespace clamber {

namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kSlack = 1e-6;  // [m] by which distances and what is subtracted may be wrong
constexpr double kRounding = 1e-13;

// From a sphere's centre to a box.
double outside(const Shape& box, const Pose& B, const Vec3& centre) {
    const Vec3 x = tmul(B.R, centre - B.p);
    return norm({std::max(std::abs(x.x) - box.size.x, 0.0),
                 std::max(std::abs(x.y) - box.size.y, 0.0),
                 std::max(std::abs(x.z) - box.size.z, 0.0)});
}

}  // namespace

Proximity::Proximity(const std::vector<Shape>& shapes,
                     const std::vector<std::array<int, 2>>& pairs)
    : shapes_(shapes),
      pairs_(pairs),
      least_(pairs.size(), -kInf),
      seen_(shapes.size()),
      moved_(shapes.size(), 0.0) {
    near_.reserve(pairs.size());
}

// No point moves farther by a turn than the radius times its matrix's 2-norm: the
// Frobenius norm over the root of two.
void Proximity::note_moves(const Pose* poses) {
    for (size_t g = 0; g < shapes_.size(); ++g) {
        const double way = square(poses[g].p - seen_[g].p);
        double turn = 0.0;
        for (int i = 0; i < 9; ++i) {
            const double r = poses[g].R.m[i] - seen_[g].R.m[i];
            turn += r * r;
        }
        moved_[g] = 0.0;
        if (way == 0.0 && turn == 0.0) continue;
        moved_[g] = std::sqrt(way) + kRounding;
        if (turn != 0.0) moved_[g] += shapes_[g].bound * (std::sqrt(0.5 * turn) + kRounding);
        seen_[g] = poses[g];
    }
}

// No more than the distance, by bounding spheres and boxes; planes are as quickly asked.
double Proximity::gap(int a, int b, const Pose* poses) const {
    const Shape &s = shapes_[a], &t = shapes_[b];
    if (s.kind == ShapeKind::Plane || t.kind == ShapeKind::Plane) return -kInf;
    double gap = norm(poses[b].p - poses[a].p) - s.bound - t.bound;
    if (s.kind == ShapeKind::Box)
        gap = std::max(gap, outside(s, poses[a], poses[b].p) - t.bound);
    if (t.kind == ShapeKind::Box)
        gap = std::max(gap, outside(t, poses[b], poses[a].p) - s.bound);
    return gap - kSlack;
}

const std::vector<Proximity::Near>& Proximity::query(const Pose* poses, double reach,
                                                     const unsigned char* active) {
    note_moves(poses);
    near_.clear();
    for (size_t i = 0; i < pairs_.size(); ++i) {
        const auto [a, b] = pairs_[i];
        const double moved = moved_[a] + moved_[b];
        least_[i] -= moved;
        if (least_[i] >= reach || (active && !active[i])) continue;
        // Where a pose is not finite, nor is what it has moved.
        if (moved < kInf) {
            least_[i] = std::max(least_[i], gap(a, b, poses));
            if (least_[i] >= reach) continue;
        }
        const Nearest at = nearest(shapes_[a], poses[a], shapes_[b], poses[b]);
        least_[i] = at.distance - kSlack;
        if (!(at.distance >= reach)) near_.push_back({static_cast<int>(i), at});
    }
    return near_;
}

namespace {

std::vector<Shape> read_shapes(const Array1<int>& kinds, const Array2<>& sizes,
                               const std::vector<Array2<>>& vertices) {
    const size_t n = kinds.shape(0);
    if (sizes.shape(0) != n || sizes.shape(1) != 3 || vertices.size() != n)
        throw std::invalid_argument("a kind, three sizes and vertices for each shape");
    std::vector<Shape> shapes;
    for (size_t i = 0; i < n; ++i) {
        const int kind = kinds(i);
        if (kind < 0 || kind > static_cast<int>(ShapeKind::Convex))
            throw std::invalid_argument("a kind of shape that is not known");
        std::vector<Vec3> points(vertices[i].shape(0));
        if (!points.empty() && vertices[i].shape(1) != 3)
            throw std::invalid_argument("vertices have three coordinates");
        for (size_t k = 0; k < points.size(); ++k) points[k] = read3(&vertices[i](k, 0));
        shapes.push_back(make_shape(static_cast<ShapeKind>(kind), read3(&sizes(i, 0)), points));
    }
    return shapes;
}

std::vector<std::array<int, 2>> read_pairs(const Array2<int>& pairs, int shapes) {
    std::vector<std::array<int, 2>> out;
    if (pairs.shape(1) != 2) throw std::invalid_argument("pairs are of two shapes");
    for (size_t i = 0; i < pairs.shape(0); ++i) {
        for (int k = 0; k < 2; ++k)
            if (pairs(i, k) < 0 || pairs(i, k) >= shapes)
                throw std::invalid_argument("a pair names a shape that there is not");
        out.push_back({pairs(i, 0), pairs(i, 1)});
    }
    return out;
}

// As arrays: indices, distances, normals, first and second points.
nb::tuple query(Proximity& proximity, const Array2<>& xpos, const Array2<>& xmat, double reach,
                const std::optional<Array1<bool>>& active) {
    const size_t n = proximity.shapes();
    if (xpos.shape(0) != n || xpos.shape(1) != 3 || xmat.shape(0) != n || xmat.shape(1) != 9)
        throw std::invalid_argument("a position (3,) and a matrix (9,) for each shape");
    if (active && active->shape(0) != static_cast<size_t>(proximity.pairs()))
        throw std::invalid_argument("active says of each pair whether it counts");
    std::vector<Pose> poses(n);
    for (size_t i = 0; i < n; ++i) poses[i] = {read3(&xpos(i, 0)), read9(&xmat(i, 0))};
    const auto* mask = active ? reinterpret_cast<const unsigned char*>(active->data()) : nullptr;
    const std::vector<Proximity::Near>& near = proximity.query(poses.data(), reach, mask);
    const size_t m = near.size();
    std::vector<std::int64_t> pairs(m);
    std::vector<double> values(10 * m);
    double* const normals = values.data() + m;
    double *const first = normals + 3 * m, *const second = first + 3 * m;
    for (size_t i = 0; i < m; ++i) {
        pairs[i] = near[i].pair;
        values[i] = near[i].at.distance;
        write3(near[i].at.normal, normals + 3 * i);
        write3(near[i].at.first, first + 3 * i);
        write3(near[i].at.second, second + 3 * i);
    }
    return nb::make_tuple(new_array(pairs.data(), {m}), new_array(values.data(), {m}),
                          new_array(normals, {m, 3}), new_array(first, {m, 3}),
                          new_array(second, {m, 3}));
}

}  // namespace

void bind_geometry(nb::module_& m) {
    nb::class_<Proximity>(m, "Proximity")
        .def(
            "__init__",
            [](Proximity* self, const Array1<int>& kinds, const Array2<>& sizes,
               const std::vector<Array2<>>& vertices, const Array2<int>& pairs) {
                const auto shapes = read_shapes(kinds, sizes, vertices);
                new (self) Proximity(shapes, read_pairs(pairs, static_cast<int>(shapes.size())));
            },
            nb::arg("kinds"), nb::arg("sizes"), nb::arg("vertices"), nb::arg("pairs"))
        .def("query", query, nb::arg("xpos"), nb::arg("xmat"), nb::arg("reach"),
             nb::arg("active").none() = nb::none());
}

}  // namespace clamber
