#include "geometry.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "fuzz.h"
#include "proximity.h"

namespace clamber::fuzz {

namespace {

Vec3 vector(Random& random, double scale) {
    return {random.number(scale), random.number(scale), random.number(scale)};
}

Shape shape(Random& random) {
    const ShapeKind kind = static_cast<ShapeKind>(random.below(7));
    const Vec3 size{random.size(0.3), random.size(0.3), random.size(0.3)};
    std::vector<Vec3> vertices;
    if (kind == ShapeKind::Convex) {
        const int n = random.between(random.mood == Mood::TAME ? 4 : 1, 40);
        const bool flat = random.one_in(5);
        for (int i = 0; i < n; ++i) {
            vertices.push_back(vector(random, 0.3));
            if (flat) vertices.back().z = 0.0;
            if (random.one_in(10)) vertices.back() = vertices[random.below(i + 1)];
        }
    }
    return make_shape(kind, size, std::move(vertices));
}

Pose pose(Random& random) {
    Quat q{random.number(), random.number(), random.number(), random.number()};
    if (random.one_in(3)) q = {1.0, 0.0, 0.0, 0.0};  // faces parallel, edges along edges
    Pose X{vector(random, 0.5), matrix(normalized(q))};
    if (random.mood == Mood::WILD && random.one_in(8)) X.R(random.below(3), 0) = random.number();
    return X;
}

// How far a shape reaches along a direction of its own frame.
double reach(const Shape& s, const Vec3& d) {
    switch (s.kind) {
    case ShapeKind::Plane: return d.z > 1.0 - 1e-9 ? 0.0 : HUGE_VAL;
    case ShapeKind::Sphere: return s.size.x * norm(d);
    case ShapeKind::Capsule: return s.size.y * std::abs(d.z) + s.size.x * norm(d);
    case ShapeKind::Ellipsoid:
        return norm(Vec3{s.size.x * d.x, s.size.y * d.y, s.size.z * d.z});
    case ShapeKind::Cylinder: return s.size.y * std::abs(d.z) + s.size.x * std::hypot(d.x, d.y);
    case ShapeKind::Box:
        return s.size.x * std::abs(d.x) + s.size.y * std::abs(d.y) + s.size.z * std::abs(d.z);
    case ShapeKind::Convex: break;
    }
    double most = -HUGE_VAL;
    for (const Vec3& v : s.vertices) most = std::max(most, dot(d, v));
    return most;
}

// How far a point of its own frame is outside a shape, about.
double outside(const Shape& s, const Vec3& p) {
    const double along = std::max(std::abs(p.z) - s.size.y, 0.0);
    switch (s.kind) {
    case ShapeKind::Plane: return p.z;
    case ShapeKind::Sphere: return norm(p) - s.size.x;
    case ShapeKind::Capsule: return norm(Vec3{p.x, p.y, along}) - s.size.x;
    case ShapeKind::Cylinder: return std::max(along, std::hypot(p.x, p.y) - s.size.x);
    case ShapeKind::Box:
        return std::max({std::abs(p.x) - s.size.x, std::abs(p.y) - s.size.y,
                         std::abs(p.z) - s.size.z});
    default: return 0.0;
    }
}

void saw(Outcome& outcome, const Nearest& at) {
    outcome.saw(at.distance);
    for (const Vec3& v : {at.first, at.second, at.normal})
        for (int i = 0; i < 3; ++i) outcome.saw(v[i]);
}

// A plane across the normal has the first shape behind it and the second before it, and the
// points lie on both: no other pair of points can be nearer, no shorter way parts them.
void check(const Shape& a, const Pose& A, const Shape& b, const Pose& B, const Nearest& at) {
    // In one place, curved shapes may be parted as well in all directions round.
    const double TOL = norm(B.p - A.p) > 0.0 ? 1e-6 : 1e-3;
    if (a.kind == ShapeKind::Plane && b.kind == ShapeKind::Plane) {
        Outcome::expect(at.distance == HUGE_VAL, "planes are infinitely far");
        return;
    }
    Outcome::expect(std::isfinite(at.distance), "a distance is finite");
    Outcome::expect(std::abs(norm(at.normal) - 1.0) < TOL, "a normal is a unit vector");
    Outcome::expect(norm(at.second - at.first - at.distance * at.normal) < TOL,
                    "the second point is along the normal from the first");
    const Vec3 n = at.normal;
    const double behind = dot(n, A.p) + reach(a, tmul(A.R, n));
    const double before = dot(n, B.p) - reach(b, tmul(B.R, -n));
    Outcome::expect(behind <= dot(n, at.first) + TOL, "the first shape ends at its point");
    Outcome::expect(before >= dot(n, at.second) - TOL, "the second shape begins at its point");
    Outcome::expect(outside(a, tmul(A.R, at.first - A.p)) < TOL, "the first point is of the first");
    Outcome::expect(outside(b, tmul(B.R, at.second - B.p)) < TOL,
                    "the second point is of the second");
    const Nearest back = nearest(b, B, a, A);
    Outcome::expect(std::abs(back.distance - at.distance) < TOL, "a distance is the same back");
}

bool is_finite(const Pose& X) {
    double sum = 0.0 * (X.p.x + X.p.y + X.p.z);
    for (const double r : X.R.m) sum += 0.0 * r;
    return sum == 0.0;
}

}  // namespace

void geometry(Random& random, Outcome& outcome) {
    const Shape a = shape(random), b = random.one_in(10) ? a : shape(random);
    const Pose A = pose(random), B = random.one_in(10) ? A : pose(random);
    const Nearest at = nearest(a, A, b, B);
    saw(outcome, at);
    outcome.solved = std::isfinite(at.distance);
    if (random.mood == Mood::TAME) check(a, A, b, B, at);
    if (!is_finite(A) || !is_finite(B))
        Outcome::expect(std::isnan(at.distance), "a pose that is no pose gives NaN");
}

// Shapes that move: what was asked before must not change what is near.
void proximity(Random& random, Outcome& outcome) {
    std::vector<Shape> shapes;
    const int n = random.between(1, 8);
    for (int i = 0; i < n; ++i) shapes.push_back(shape(random));
    std::vector<std::array<int, 2>> pairs;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < i; ++j)
            if (!random.one_in(4)) pairs.push_back({i, j});
    std::vector<Pose> poses;
    for (int i = 0; i < n; ++i) poses.push_back(pose(random));
    std::vector<unsigned char> active(pairs.size(), 1);
    Proximity kept(shapes, pairs);
    for (int step = 0; step < 4; ++step) {
        for (Pose& X : poses) {
            if (random.one_in(10)) X = pose(random);
            else if (!random.one_in(3)) X.p += vector(random, 0.02);
        }
        for (unsigned char& a : active) a = !random.one_in(5);
        const unsigned char* const asked = random.one_in(2) ? active.data() : nullptr;
        const double reach = random.size(0.3);
        const auto& near = kept.query(poses.data(), reach, asked);
        Proximity fresh(shapes, pairs);
        const auto& truth = fresh.query(poses.data(), reach, asked);
        bool same = near.size() == truth.size();
        for (std::size_t i = 0; i < near.size(); ++i) {
            outcome.saw(near[i].pair);
            saw(outcome, near[i].at);
            if (same) {
                Outcome of_kept, of_fresh;
                saw(of_kept, near[i].at);
                saw(of_fresh, truth[i].at);
                same = near[i].pair == truth[i].pair && of_kept.hash == of_fresh.hash;
            }
            outcome.solved = true;
        }
        if (random.mood == Mood::WILD) continue;  // what is no rotation has no bound
        Outcome::expect(same, "what was asked before changes nothing");
        std::size_t count = 0;
        for (std::size_t i = 0; i < pairs.size(); ++i) {
            if (asked != nullptr && !asked[i]) continue;
            const auto [a, b] = pairs[i];
            count += nearest(shapes[a], poses[a], shapes[b], poses[b]).distance < reach;
        }
        Outcome::expect(count == near.size(), "all that are near are named");
    }
}

}  // namespace clamber::fuzz
