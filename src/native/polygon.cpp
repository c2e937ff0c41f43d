#include "polygon.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "bindings.h"

namespace clamber {
namespace {

constexpr double GRID = 1073741824.0;   // 2^30: vertices lie about a nanometre apart
constexpr double FAR = 2147483648.0;    // 2^31 [m]: differences on the grid fit 64 bits
constexpr double INF = std::numeric_limits<double>::infinity();

using Point = std::pair<std::int64_t, std::int64_t>;
__extension__ using Wide = __int128;

// Sorts n points and puts those on their hull first: how many. `hull` has room for n + 1.
int hull_of(Point* points, int n, Point* hull) {
    std::sort(points, points + n);
    n = static_cast<int>(std::unique(points, points + n) - points);
    if (n < 3) return n;
    int size = 0;
    for (int chain = 0; chain < 2; ++chain) {  // the lower, then the upper one
        const int first = size;
        for (int i = 0; i < n; ++i) {
            const Point& p = points[chain == 0 ? i : n - 1 - i];
            while (size - first >= 2) {
                const Point &a = hull[size - 2], &b = hull[size - 1];
                if (Wide(b.first - a.first) * (p.second - a.second) >
                    Wide(b.second - a.second) * (p.first - a.first))
                    break;
                --size;
            }
            hull[size++] = p;
        }
        --size;  // the next chain begins with it
    }
    std::copy(hull, hull + size, points);
    return size;
}

double length_of(double x, double y) { return std::sqrt(x * x + y * y); }

Ellipse ellipse_of(double x, double y, double major, double minor, double fx, double fy) {
    return {{x, y}, {major, minor}, {{x - fx, y - fy}, {x + fx, y + fy}}, 2 * major};
}

}  // namespace

bool support_polygon(const double (*points)[2], int n, Polygon& out) {
    // A hull is that of its vertices and whatever comes next: so few points at a time.
    constexpr int MOST = 2 * Polygon::CAPACITY;
    Point held[MOST], hull[MOST + 1];
    int size = 0;
    out.n = 0;
    for (int i = 0; i < n;) {
        for (; i < n && size < MOST; ++i) {
            const double x = points[i][0], y = points[i][1];
            if (!(std::fabs(x) < FAR && std::fabs(y) < FAR)) return false;
            // To the nearest, halves to the even one, as the default mode rounds.
            held[size++] = {std::llrint(x * GRID), std::llrint(y * GRID)};
        }
        size = hull_of(held, size, hull);
        if (size > Polygon::CAPACITY) return false;
    }
    out.n = size;
    for (int i = 0; i < size; ++i) {
        out.v[i][0] = static_cast<double>(held[i].first) / GRID;
        out.v[i][1] = static_cast<double>(held[i].second) / GRID;
    }
    return true;
}

int halfplanes(const Polygon& polygon, double (*A)[2], double* b) {
    const int n = polygon.n;
    int rows = 0;
    const auto add = [&](double nx, double ny, double bound) {
        A[rows][0] = nx;
        A[rows][1] = ny;
        b[rows++] = bound;
    };
    if (n == 1) {
        const double x = polygon.v[0][0], y = polygon.v[0][1];
        add(1.0, 0.0, x);
        add(-1.0, 0.0, -x);
        add(0.0, 1.0, y);
        add(0.0, -1.0, -y);
        return rows;
    }
    for (int i = 0; i < n; ++i) {
        const double *p = polygon.v[i], *q = polygon.v[i + 1 < n ? i + 1 : 0];
        double ex = q[0] - p[0], ey = q[1] - p[1];
        const double length = length_of(ex, ey);
        ex = length > 0.0 ? ex / length : 1.0;
        ey = length > 0.0 ? ey / length : 0.0;
        add(ey, -ex, ey * p[0] - ex * p[1]);
        if (n < 3) add(ex, ey, ex * q[0] + ey * q[1]);  // the cap at the far end
    }
    return rows;
}

double nearest_border(double x, double y, const Polygon& polygon, double* outward) {
    const int n = polygon.n;
    outward[0] = 1.0;
    outward[1] = 0.0;
    if (std::isnan(x) || std::isnan(y)) return std::numeric_limits<double>::quiet_NaN();
    if (n >= 3) {
        double edge = -INF;
        for (int i = 0; i < n; ++i) {
            const double *p = polygon.v[i], *q = polygon.v[i + 1 < n ? i + 1 : 0];
            const double ex = q[0] - p[0], ey = q[1] - p[1], length = length_of(ex, ey);
            const double s = ((x - p[0]) * ey - (y - p[1]) * ex) / length;
            if (s > edge) {
                edge = s;
                outward[0] = ey / length;
                outward[1] = -ex / length;
            }
        }
        if (edge <= 0.0 && edge > -INF) return -edge;  // -INF: all vertices coincide
    }
    double nearest = -INF;
    for (int i = 0; i < n; ++i) {
        const double *p = polygon.v[i], *q = polygon.v[i + 1 < n ? i + 1 : 0];
        const double ex = q[0] - p[0], ey = q[1] - p[1], square = ex * ex + ey * ey;
        double t = square > 0.0 ? ((x - p[0]) * ex + (y - p[1]) * ey) / square : 0.0;
        t = std::min(std::max(t, 0.0), 1.0);
        const double dx = x - p[0] - t * ex, dy = y - p[1] - t * ey;
        const double distance = length_of(dx, dy);
        if (-distance > nearest) {
            nearest = -distance;
            if (distance > 0.0) {
                outward[0] = dx / distance;
                outward[1] = dy / distance;
            } else if (square > 0.0) {
                outward[0] = ey / std::sqrt(square);
                outward[1] = -ex / std::sqrt(square);
            }
        }
    }
    return nearest;
}

double com_margin(double x, double y, const Polygon& polygon) {
    double outward[2];
    return nearest_border(x, y, polygon, outward);
}

Ellipse support_ellipse(const Polygon& polygon) {
    const int n = polygon.n;
    double r[Polygon::CAPACITY][2], mx = 0.0, my = 0.0;
    for (int i = 0; i < n; ++i) {
        mx += polygon.v[i][0];
        my += polygon.v[i][1];
    }
    mx /= n;
    my /= n;
    for (int i = 0; i < n; ++i) {
        r[i][0] = polygon.v[i][0] - mx;
        r[i][1] = polygon.v[i][1] - my;
    }
    // Area, first and second moments about the middle, triangle by triangle.
    double area = 0, square = 0, cx = 0, cy = 0, xx = 0, xy = 0, yy = 0;
    for (int i = 0; i < n; ++i) {
        const double *a = r[i], *b = r[i + 1 < n ? i + 1 : 0];
        const double cross = a[0] * b[1] - a[1] * b[0];
        const double sx = a[0] + b[0], sy = a[1] + b[1];
        area += cross;
        square += a[0] * a[0] + a[1] * a[1];
        cx += cross * sx;
        cy += cross * sy;
        xx += cross * (a[0] * a[0] + b[0] * b[0] + sx * sx);
        xy += cross * (a[0] * a[1] + b[0] * b[1] + sx * sy);
        yy += cross * (a[1] * a[1] + b[1] * b[1] + sy * sy);
    }
    area *= 0.5;
    // What is slimmer has a second moment across it that rounding may make negative.
    if (area <= 1e-6 * square) {
        // From the vertex farthest from the middle to the one farthest from that.
        double end[2][2] = {};
        for (auto& e : end) {
            const double from[2] = {end[0][0], end[0][1]};
            double most = -1.0;
            for (int i = 0; i < n; ++i) {
                const double d = length_of(r[i][0] - from[0], r[i][1] - from[1]);
                if (d > most) most = d, e[0] = r[i][0], e[1] = r[i][1];
            }
        }
        const double hx = 0.5 * (end[0][0] - end[1][0]), hy = 0.5 * (end[0][1] - end[1][1]);
        return ellipse_of(mx + end[1][0] + hx, my + end[1][1] + hy, length_of(hx, hy), 0.0, hx, hy);
    }
    cx /= 6 * area;
    cy /= 6 * area;
    xx = xx / (24 * area) - cx * cx;
    xy = xy / (24 * area) - cx * cy;
    yy = yy / (24 * area) - cy * cy;
    // With E the second moments, k E touches the nearest edge: n'(k E) n = (b - n'c)^2.
    double k = INF;
    for (int i = 0; i < n; ++i) {
        const double *a = r[i], *b = r[i + 1 < n ? i + 1 : 0];
        const double nx = b[1] - a[1], ny = a[0] - b[0];  // the ratio minds no length
        const double room = nx * (a[0] - cx) + ny * (a[1] - cy);
        k = std::min(k, room * room / (nx * nx * xx + 2 * nx * ny * xy + ny * ny * yy));
    }
    // Eigenvalues of the symmetric 2 x 2 matrix, and (ux, uy) along the larger, by half
    // angles: tan(2 angle) = xy / across.
    const double half = 0.5 * (xx + yy), across = 0.5 * (xx - yy);
    const double skew = length_of(across, xy);
    const double major = std::sqrt(k * (half + skew));
    const double minor = std::sqrt(k * std::max(half - skew, 0.0));
    const double focal = std::sqrt(std::max(major * major - minor * minor, 0.0));
    double ux = 1.0, uy = 0.0;
    if (skew > 0.0) {
        const double large = std::sqrt(0.5 * (1.0 + std::fabs(across) / skew));
        const double small = std::fabs(xy) / (2 * skew * large);
        ux = across >= 0.0 ? large : small;
        uy = std::copysign(across >= 0.0 ? small : large, xy);
    }
    return ellipse_of(mx + cx, my + cy, major, minor, focal * ux, focal * uy);
}

double excess(const Ellipse& ellipse, double x, double y, double* gradient) {
    double total = -ellipse.string_length;
    gradient[0] = gradient[1] = 0.0;
    for (const auto& focus : ellipse.foci) {
        const double dx = x - focus[0], dy = y - focus[1], d = length_of(dx, dy);
        total += d;
        gradient[0] += dx / std::max(d, 1e-12);  // a focus itself adds nothing
        gradient[1] += dy / std::max(d, 1e-12);
    }
    return total;
}

namespace {

using Points = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

const double (*rows_of(const Points& p))[2] {
    return reinterpret_cast<const double(*)[2]>(p.data());
}

Polygon polygon_of(const Points& vertices) {
    Polygon out;
    if (vertices.shape(0) > Polygon::CAPACITY)
        throw nb::value_error("a polygon has at most 64 vertices");
    out.n = static_cast<int>(vertices.shape(0));
    std::copy(vertices.data(), vertices.data() + vertices.size(), &out.v[0][0]);
    return out;
}

}  // namespace

void bind_polygon(nb::module_& m) {
    m.def("support_polygon", [](const Points& points) {
        Polygon out;
        if (!support_polygon(rows_of(points), static_cast<int>(points.shape(0)), out))
            throw nb::value_error("a support polygon needs finite points, and has at most 64 vertices");
        return new_array(&out.v[0][0], {static_cast<std::size_t>(out.n), 2});
    });
    m.def("polygon_halfplanes", [](const Points& vertices) {
        double A[Polygon::CAPACITY][2], b[Polygon::CAPACITY];
        const auto rows = static_cast<std::size_t>(halfplanes(polygon_of(vertices), A, b));
        if (rows == 0) throw nb::value_error("a polygon without vertices has no half-planes");
        return nb::make_tuple(new_array(&A[0][0], {rows, 2}), new_array(b, {rows}));
    });
    m.def("com_margin", [](double x, double y, const Points& vertices) {
        return com_margin(x, y, polygon_of(vertices));
    });
    m.def("com_margins", [](const Points& coms, const Points& vertices) {
        const Polygon polygon = polygon_of(vertices);
        std::vector<double> out;
        for (std::size_t i = 0; i < coms.shape(0); ++i)
            out.push_back(com_margin(rows_of(coms)[i][0], rows_of(coms)[i][1], polygon));
        return new_array(out.data(), {out.size()});
    });
    m.def("support_ellipse", [](const Points& vertices) {
        const Polygon polygon = polygon_of(vertices);
        if (polygon.n == 0) throw nb::value_error("a polygon without vertices has no ellipse");
        const Ellipse e = support_ellipse(polygon);
        return nb::make_tuple(new_array(e.centre, {2}), new_array(e.semi_axes, {2}),
                              new_array(&e.foci[0][0], {2, 2}), e.string_length);
    });
    m.def("ellipse_excess", [](const Points& foci, double string_length, double x, double y) {
        Ellipse e{};
        if (foci.shape(0) != 2) throw nb::value_error("an ellipse has two foci");
        std::copy(foci.data(), foci.data() + 4, &e.foci[0][0]);
        e.string_length = string_length;
        double gradient[2];
        const double d = excess(e, x, y, gradient);
        return nb::make_tuple(d, new_array(gradient, {2}));
    });
}

}  // namespace clamber
