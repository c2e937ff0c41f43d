// Distances of round shapes and boxes in closed form, of the others by GJK [Gilbert88] on
// their cores: a sphere is a point and a radius, a capsule a segment and a radius. Where
// cores overlap, the expanding polytope [Bergen01] finds how to part them.
#include "geometry.h"

#include <limits>
#include <utility>

namespace clamber {

namespace {

constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
// Cores nearer than this share of their size have no direction from one to the other; on
// curved ones GJK finds it only to the root of rounding.
constexpr double kTouch = 1e-10, kTouchCurved = 1e-7;
// Shares of the size by which a distance and a depth may be wrong: faces of a polytope may
// be slivers.
constexpr double kGap = 1e-13, kDepthGap = 1e-10;
constexpr double kRounding = 1e-15;  // of vertices, as a share of the size
constexpr int kIterations = 100;
constexpr int kVertices = 200, kFaces = 2 * kVertices;

bool is_round(const Shape& s) {
    return s.kind == ShapeKind::Sphere || s.kind == ShapeKind::Capsule;
}
bool is_curved(const Shape& s) {
    return s.kind == ShapeKind::Ellipsoid || s.kind == ShapeKind::Cylinder;
}
double radius(const Shape& s) { return is_round(s) ? s.size.x : 0.0; }
// From the middle of a round shape's core to its end.
Vec3 half_axis(const Shape& s, const Mat3& R) {
    return s.kind == ShapeKind::Capsule ? s.size.y * R.col(2) : Vec3{};
}
double clamped(double t) { return std::min(std::max(t, -1.0), 1.0); }

// A unit vector at right angles to one that is not zero.
Vec3 perpendicular(const Vec3& v) {
    const double x = std::abs(v.x), y = std::abs(v.y), z = std::abs(v.z);
    const Vec3 n = x <= y && x <= z ? Vec3{0, v.z, -v.y}
                   : y <= z         ? Vec3{-v.z, 0, v.x}
                                    : Vec3{v.y, -v.x, 0};
    return n * (1.0 / norm(n));
}

// Of shapes whose cores have their nearest points a distance apart along a normal.
Nearest grown(const Shape& a, const Shape& b, double distance, const Vec3& first,
              const Vec3& normal) {
    const double d = distance - radius(a) - radius(b);
    const Vec3 on_a = first + radius(a) * normal;
    return {d, on_a, on_a + d * normal, normal};
}

// The core's farthest point along d, in the shape's frame.
Vec3 support(const Shape& s, const Vec3& d) {
    const Vec3& c = s.size;
    switch (s.kind) {
        case ShapeKind::Capsule: return {0, 0, std::copysign(c.y, d.z)};
        case ShapeKind::Ellipsoid: {
            const Vec3 e{c.x * d.x, c.y * d.y, c.z * d.z};
            const double n = norm(e);
            return n > 0 ? Vec3{c.x * e.x / n, c.y * e.y / n, c.z * e.z / n} : Vec3{};
        }
        case ShapeKind::Cylinder: {
            const double n = std::sqrt(d.x * d.x + d.y * d.y), r = n > 0 ? c.x / n : 0.0;
            return {r * d.x, r * d.y, std::copysign(c.y, d.z)};
        }
        case ShapeKind::Box:
            return {std::copysign(c.x, d.x), std::copysign(c.y, d.y), std::copysign(c.z, d.z)};
        case ShapeKind::Convex: {
            Vec3 best;
            double most = -kInf;
            for (const Vec3& v : s.vertices) {
                const double along = dot(v, d);
                if (along > most) most = along, best = v;
            }
            return best;
        }
        default: return {};
    }
}

Nearest from_plane(const Pose& A, const Shape& b, const Pose& B) {
    const Vec3 n = A.R.col(2);
    const Vec3 low = B.p + B.R * support(b, -tmul(B.R, n)) - radius(b) * n;
    const double d = dot(n, low - A.p);
    return {d, low - d * n, low, n};
}

// Where in [-1, 1] a convex, piecewise quadratic function is least, by its slope and the
// places where the slope bends.
template <int N, typename Slope>
double least(const Slope& slope, const std::array<double, N>& bends) {
    double lo = -1.0, hi = 1.0, at_lo = slope(lo), at_hi = slope(hi);
    if (at_lo >= 0) return lo;
    if (at_hi <= 0) return hi;
    for (double t : bends) {
        if (!(t > lo && t < hi)) continue;
        const double s = slope(t);
        if (s == 0) return t;
        if (s < 0)
            lo = t, at_lo = s;
        else
            hi = t, at_hi = s;
    }
    return lo + (hi - lo) * (at_lo / (at_lo - at_hi));
}

// Two round shapes, by the segments of their cores.
Nearest between_segments(const Shape& a, const Pose& A, const Shape& b, const Pose& B) {
    const Vec3 da = half_axis(a, A.R), db = half_axis(b, B.R), apart = A.p - B.p;
    const double aa = square(da), bb = square(db), ab = dot(da, db), ob = dot(db, apart);
    // Where on b is nearest to a's point at t.
    const auto across = [&](double t) { return bb > 0 ? clamped((ob + t * ab) / bb) : 0.0; };
    double t = 0.0;
    if (aa > 0) {
        const double oa = dot(da, apart);
        const auto slope = [&](double at) { return oa + at * aa - across(at) * ab; };
        t = least<2>(slope, {(bb - ob) / ab, (-bb - ob) / ab});
    }
    const Vec3 first = A.p + t * da, v = B.p + across(t) * db - first;
    const double distance = norm(v);
    if (distance > kTouch * (a.bound + b.bound))
        return grown(a, b, distance, first, v * (1.0 / distance));
    // Crossing segments: at right angles to both.
    Vec3 n = cross(da, db);
    const double sine = norm(n);
    if (sine * sine > 1e-20 * aa * bb)
        n *= 1.0 / sine;
    else
        n = perpendicular(aa > 0 ? da : bb > 0 ? db : Vec3{0, 0, 1});
    return grown(a, b, 0.0, first, n);
}

// The second of a pair is given in the frame of the first.
struct Pair {
    const Shape& a;
    const Shape& b;
    Vec3 p;
    Mat3 R;
};

// A point of the difference of the cores, and of which points it is the difference.
struct Vertex {
    Vec3 w, a, b;
};

Vertex support(const Pair& pair, const Vec3& d) {
    const Vec3 a = support(pair.a, d);
    const Vec3 b = pair.p + pair.R * support(pair.b, -tmul(pair.R, d));
    return {a - b, a, b};
}

// Convex combinations of vertices.
struct Simplex {
    Vertex v[4];
    double weight[4] = {1, 0, 0, 0};
    int n = 0;

    template <Vec3 Vertex::*point>
    Vec3 at() const {
        Vec3 out;
        for (int i = 0; i < n; ++i) out += weight[i] * (v[i].*point);
        return out;
    }
};

// Weights of the point of a segment that is nearest to the origin.
void nearest_on(const Vec3& a, const Vec3& b, double* weight) {
    const Vec3 e = b - a;
    const double ee = square(e);
    const double t = ee > 0 ? std::min(std::max(-dot(a, e) / ee, 0.0), 1.0) : 0.0;
    weight[0] = 1 - t, weight[1] = t;
}

// The same of a triangle [Ericson04, 5.1.5].
void nearest_on(const Vec3& a, const Vec3& b, const Vec3& c, double* weight) {
    const auto put = [&](double u, double v, double w) {
        weight[0] = u, weight[1] = v, weight[2] = w;
    };
    const auto share = [](double x, double y) { return x + y > 0 ? x / (x + y) : 0.0; };
    const Vec3 ab = b - a, ac = c - a, n = cross(ab, ac);
    const double ab_a = -dot(ab, a), ac_a = -dot(ac, a);
    if (ab_a <= 0 && ac_a <= 0) return put(1, 0, 0);
    const double ab_b = -dot(ab, b), ac_b = -dot(ac, b);
    if (ab_b >= 0 && ac_b <= ab_b) return put(0, 1, 0);
    const double w = dot(n, cross(a, b));
    if (w <= 0 && ab_a >= 0 && ab_b <= 0) {
        const double t = share(ab_a, -ab_b);
        return put(1 - t, t, 0);
    }
    const double ab_c = -dot(ab, c), ac_c = -dot(ac, c);
    if (ac_c >= 0 && ab_c <= ac_c) return put(0, 0, 1);
    const double v = dot(n, cross(c, a));
    if (v <= 0 && ac_a >= 0 && ac_c <= 0) {
        const double t = share(ac_a, -ac_c);
        return put(1 - t, 0, t);
    }
    const double u = dot(n, cross(b, c)), to_c = ac_b - ab_b, to_b = ab_c - ac_c;
    if (u <= 0 && to_c >= 0 && to_b >= 0) {
        const double t = share(to_c, to_b);
        return put(0, 1 - t, t);
    }
    const double sum = u + v + w;
    if (sum > 0) return put(u / sum, v / sum, w / sum);
    put(1, 0, 0);
}

// Weights of the simplex's point that is nearest to the origin; vertices without a weight
// go. False where the origin is inside. No face has an inner side where rounding
// may have made it.
bool reduce(Simplex& s, double scale) {
    if (s.n == 2) nearest_on(s.v[0].w, s.v[1].w, s.weight);
    if (s.n == 3) nearest_on(s.v[0].w, s.v[1].w, s.v[2].w, s.weight);
    if (s.n == 4) {
        constexpr int faces[4][4] = {{0, 1, 2, 3}, {0, 1, 3, 2}, {0, 2, 3, 1}, {1, 2, 3, 0}};
        double least = kInf, best[4] = {0, 0, 0, 0};
        for (const auto& f : faces) {
            const Vec3 &a = s.v[f[0]].w, &b = s.v[f[1]].w, &c = s.v[f[2]].w;
            const Vec3 ab = b - a, ac = c - a, ad = s.v[f[3]].w - a, n = cross(ab, ac);
            const double inner = dot(n, ad), origin = -dot(n, a);
            const double rounding = kRounding * scale * (square(ab) + square(ac) + square(ad));
            if (inner * origin > 0 && std::min(std::abs(inner), std::abs(origin)) > rounding)
                continue;
            double weight[3];
            nearest_on(a, b, c, weight);
            const double d = square(weight[0] * a + weight[1] * b + weight[2] * c);
            if (!(d < least)) continue;
            least = d;
            for (int i = 0; i < 3; ++i) best[f[i]] = weight[i];
            best[f[3]] = 0;
        }
        if (least == kInf) return false;
        std::copy(best, best + 4, s.weight);
    }
    int n = 0;
    for (int i = 0; i < s.n; ++i)
        if (s.weight[i] > 0) s.v[n] = s.v[i], s.weight[n++] = s.weight[i];
    s.n = n;
    return n > 0;
}

// The points of the cores that are nearest to each other, as a simplex; its size is put
// to `scale`. False where the cores overlap or touch.
bool gjk(const Pair& pair, Simplex& s, double& scale) {
    Vec3 v = -pair.p;
    if (!(square(v) > 0)) v = {1, 0, 0};
    s.v[0] = support(pair, -v);
    s.n = 1;
    v = s.v[0].w;
    const double touch = is_curved(pair.a) || is_curved(pair.b) ? kTouchCurved : kTouch;
    scale = norm(v);
    for (int i = 0; i < kIterations; ++i) {
        const double vv = square(v), away = std::sqrt(vv);
        if (!(away > touch * scale)) return false;
        const Vertex next = support(pair, -v);
        scale = std::max(scale, norm(next.w));
        if (vv - dot(v, next.w) <= kGap * scale * away) return true;
        Simplex grown = s;
        grown.v[grown.n++] = next;
        if (!reduce(grown, scale)) return false;
        const Vec3 nearer = grown.at<&Vertex::w>();
        if (!(square(nearer) < vv)) return true;  // as near as rounding lets
        s = grown;
        v = nearer;
    }
    return true;
}

// A polytope of the cores' difference whose nearest face to the origin is moved out until
// it lies on the surface.
class Polytope {
 public:
    explicit Polytope(const Pair& pair) : pair_(pair) {}

    // The direction in which the first has to go least, and that way. The simplex gets
    // the points of the cores; where their difference is flat, it keeps those it has.
    void part(Simplex& touching, Vec3& normal, double& depth) {
        depth = 0.0;
        if (!start(normal)) return;
        depth = kInf;
        while (true) {
            const int f = nearest_face();
            const Vertex w = support(pair_, face_[f].n);
            const double far = dot(face_[f].n, w.w);
            const bool is_reached = far - face_[f].h <= kDepthGap * scale_;
            if (is_reached || far < depth) depth = far, normal = face_[f].n;
            if (is_reached || vertices_ == kVertices || !expand(f, w)) break;
        }
        meet(depth * normal, normal, touching);
    }

 private:
    struct Face {
        int v[3], next[3];  // next[k] shares the edge from v[k] to v[k + 1]
        Vec3 n;
        double h;
        bool seen;
    };

    void set_face(int f, int i, int j, int k) {
        const Vec3 &a = v_[i].w, &b = v_[j].w, &c = v_[k].w;
        Vec3 n = cross(b - a, c - a);
        const double size = norm(n);
        n = size > 0 ? n * (1.0 / size) : Vec3{};
        face_[f] = {{i, j, k}, {0, 0, 0}, n, size > 0 ? dot(n, a) : kInf, false};
    }

    int nearest_face() const {
        int best = 0;
        for (int f = 1; f < faces_; ++f)
            if (face_[f].h < face_[best].h) best = f;
        return best;
    }

    // A tetrahedron. False where the difference is flat; `normal` is at right angles to it.
    bool start(Vec3& normal) {
        // The farther of both ends along a direction from what is given.
        const auto add_farther = [&](const Vec3& d, const Vec3& from) {
            const Vertex one = support(pair_, d), other = support(pair_, -d);
            const double up = dot(d, one.w - from), down = dot(d, from - other.w);
            v_[vertices_++] = up > down ? one : other;
            return std::max(up, down);
        };
        double longest = -1.0;
        for (int i = 0; i < 3; ++i) {
            Vec3 d;
            d[i] = 1.0;
            const Vertex one = support(pair_, d), other = support(pair_, -d);
            const double length = one.w[i] - other.w[i];
            scale_ = std::max({scale_, norm(one.w), norm(other.w)});
            if (length > longest) longest = length, v_[0] = one, v_[1] = other;
        }
        vertices_ = 2;
        const double thin = kTouch * scale_;
        normal = {1, 0, 0};
        if (!(longest > thin)) return false;
        const Vec3 line = v_[1].w - v_[0].w;
        const Vec3 side = perpendicular(line), other = cross(line, side) * (1.0 / norm(line));
        normal = other;
        if (!(add_farther(side, v_[0].w) > thin)) {
            vertices_ = 2;
            normal = side;
            if (!(add_farther(other, v_[0].w) > thin)) return false;
        }
        const Vec3 n = cross(line, v_[2].w - v_[0].w);
        normal = n * (1.0 / norm(n));
        if (!(add_farther(normal, v_[0].w) > thin)) return false;
        const bool outward = dot(normal, v_[3].w - v_[0].w) < 0;
        if (!outward) std::swap(v_[1], v_[2]);
        set_face(0, 0, 1, 2);
        set_face(1, 0, 3, 1);
        set_face(2, 1, 3, 2);
        set_face(3, 2, 3, 0);
        const int next[4][3] = {{1, 2, 3}, {3, 2, 0}, {1, 3, 0}, {2, 1, 0}};
        for (int f = 0; f < 4; ++f) std::copy(next[f], next[f] + 3, face_[f].next);
        faces_ = 4;
        return true;
    }

    // Replaces what is seen from w by faces from the horizon to w. False where rounding
    // has broken the horizon.
    bool expand(int from, const Vertex& w) {
        int stack[kFaces], seen[kFaces], top = 0, n_seen = 0, n_rim = 0;
        struct {
            int face, edge;  // beyond the horizon
        } rim[kFaces];
        const double eps = 1e-15 * scale_;
        face_[from].seen = true;
        stack[top++] = from;
        while (top) {
            const int f = stack[--top];
            seen[n_seen++] = f;
            for (int k = 0; k < 3; ++k) {
                const int g = face_[f].next[k];
                if (face_[g].seen) continue;
                if (dot(face_[g].n, w.w - v_[face_[g].v[0]].w) > -eps) {
                    face_[g].seen = true;
                    stack[top++] = g;
                }
            }
        }
        for (int i = 0; i < n_seen; ++i)
            for (int k = 0; k < 3; ++k) {
                const int g = face_[seen[i]].next[k];
                if (face_[g].seen) continue;
                int e = 0;
                while (face_[g].next[e] != seen[i]) ++e;
                rim[n_rim++] = {g, e};
            }
        if (n_rim < 3 || n_rim > n_seen + 2) return false;
        const auto start = [&](int i) { return face_[rim[i].face].v[(rim[i].edge + 1) % 3]; };
        int starting[kVertices];  // the new face whose edge on the rim starts at a vertex
        std::fill(starting, starting + vertices_, -1);
        for (int i = 0; i < n_rim; ++i) {
            if (starting[start(i)] >= 0) return false;
            starting[start(i)] = i < n_seen ? seen[i] : faces_ + i - n_seen;
        }
        v_[vertices_] = w;
        for (int i = 0; i < n_rim; ++i) {
            const auto [g, e] = rim[i];
            const int p = start(i), q = face_[g].v[e], f = starting[p];
            set_face(f, p, q, vertices_);
            face_[f].next[0] = g;
            face_[f].next[1] = starting[q];
            face_[g].next[e] = f;
        }
        for (int i = 0; i < n_rim; ++i) {
            const int f = starting[start(i)];
            face_[face_[f].next[1]].next[2] = f;
        }
        for (int i = n_rim; i < n_seen; ++i) face_[seen[i]].n = {}, face_[seen[i]].h = kInf;
        faces_ += std::max(n_rim - n_seen, 0);
        ++vertices_;
        return true;
    }

    // The points of the cores that meet near a point of the surface with that normal.
    void meet(const Vec3& point, const Vec3& normal, Simplex& s) const {
        double least = kInf;
        for (int f = 0; f < faces_; ++f) {
            if (dot(face_[f].n, normal) < 0.9) continue;
            Simplex on;
            on.n = 3;
            for (int k = 0; k < 3; ++k) on.v[k] = v_[face_[f].v[k]];
            nearest_on(on.v[0].w - point, on.v[1].w - point, on.v[2].w - point, on.weight);
            const double off = square(on.at<&Vertex::w>() - point);
            if (off < least) least = off, s = on;
        }
    }

    Pair pair_;
    Vertex v_[kVertices];
    Face face_[kFaces];
    int vertices_ = 0, faces_ = 0;
    double scale_ = 0.0;
};

Nearest by_cores(const Shape& a, const Pose& A, const Shape& b, const Pose& B) {
    const Pair pair{a, b, tmul(A.R, B.p - A.p), transposed(A.R) * B.R};
    Simplex s;
    double scale, distance;
    Vec3 n;
    if (gjk(pair, s, scale)) {
        const Vec3 v = s.at<&Vertex::w>();
        distance = norm(v);
        n = v * (-1.0 / distance);
    } else {
        double depth;
        Polytope(pair).part(s, n, depth);
        distance = -depth;
    }
    return grown(a, b, distance, A.p + A.R * s.at<&Vertex::a>(), A.R * n);
}

// A round shape and a box, by the segment of its core.
Nearest to_box(const Shape& a, const Pose& A, const Shape& b, const Pose& B) {
    const Vec3 middle = tmul(B.R, A.p - B.p), half = tmul(B.R, half_axis(a, A.R)), c = b.size;
    const auto inside = [&](double t) {
        const Vec3 x = middle + t * half;
        return Vec3{std::min(std::max(x.x, -c.x), c.x), std::min(std::max(x.y, -c.y), c.y),
                    std::min(std::max(x.z, -c.z), c.z)};
    };
    double t = 0.0;
    if (a.kind == ShapeKind::Capsule) {
        const auto slope = [&](double at) { return dot(half, middle + at * half - inside(at)); };
        t = least<6>(slope, {(c.x - middle.x) / half.x, (-c.x - middle.x) / half.x,
                             (c.y - middle.y) / half.y, (-c.y - middle.y) / half.y,
                             (c.z - middle.z) / half.z, (-c.z - middle.z) / half.z});
    }
    const Vec3 first = middle + t * half, v = inside(t) - first;
    const double distance = norm(v);
    if (!(distance > kTouch * (a.bound + b.bound))) return by_cores(a, A, b, B);
    return grown(a, b, distance, B.p + B.R * first, B.R * (v * (1.0 / distance)));
}

bool is_finite(const Pose& X) {
    double sum = X.p.x + X.p.y + X.p.z;
    for (double r : X.R.m) sum += r;
    return sum - sum == 0.0;
}

}  // namespace

Shape make_shape(ShapeKind kind, const Vec3& size, std::vector<Vec3> vertices) {
    Shape s{kind, size, std::move(vertices), 0.0};
    switch (kind) {
        case ShapeKind::Plane: s.bound = kInf; break;
        case ShapeKind::Sphere: s.bound = size.x; break;
        case ShapeKind::Capsule: s.bound = size.x + size.y; break;
        case ShapeKind::Ellipsoid: s.bound = std::max({size.x, size.y, size.z}); break;
        case ShapeKind::Cylinder: s.bound = std::hypot(size.x, size.y); break;
        case ShapeKind::Box: s.bound = norm(size); break;
        case ShapeKind::Convex:
            for (const Vec3& v : s.vertices) s.bound = std::max(s.bound, norm(v));
    }
    return s;
}

Nearest nearest(const Shape& a, const Pose& A, const Shape& b, const Pose& B) {
    if (!(is_finite(A) && is_finite(B))) return {kNaN, {}, {}, {0, 0, 1}};
    if (a.kind > b.kind) {
        const Nearest n = nearest(b, B, a, A);
        return {n.distance, n.second, n.first, -n.normal};
    }
    if (b.kind == ShapeKind::Plane) return {kInf, {}, {}, A.R.col(2)};
    if (a.kind == ShapeKind::Plane) return from_plane(A, b, B);
    if (is_round(b)) return between_segments(a, A, b, B);
    if (is_round(a) && b.kind == ShapeKind::Box) return to_box(a, A, b, B);
    return by_cores(a, A, b, B);
}

}  // namespace clamber
