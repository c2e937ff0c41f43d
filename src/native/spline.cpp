// Cubic splines through postures: the paths that trajectories follow.
#include <nanobind/stl/tuple.h>

#include "bindings.h"
#include "linalg.h"

namespace clamber {

namespace {

// Of a spline through n nodes, coefficients (4, n - 1, width) from the third power down:
// value, slope and bend (width) at s. The end pieces go on beyond the nodes.
void look_along(const double* c, const double* nodes, std::size_t n, std::size_t width,
                double s, double* out, double* slope, double* bend) {
    const double* const after = std::upper_bound(nodes + 1, nodes + n - 1, s);
    const std::size_t i = std::size_t(after - nodes) - 1, degree = (n - 1) * width;
    const double x = s - nodes[i], xx = x * x;
    c += i * width;
    for (std::size_t j = 0; j < width; ++j) {
        const double c0 = c[j + 3 * degree], c1 = c[j + 2 * degree], c2 = c[j + degree];
        out[j] = c0 + c1 * x + c2 * xx + c[j] * (xx * x);
        slope[j] = c1 + c2 * x * 2.0 + c[j] * xx * 3.0;
        bend[j] = c2 * 2.0 + c[j] * x * 6.0;
    }
}

// Raw coordinates (n) of a free joint and hinges, brought onto the manifold in place, the
// tangent vector (n - 1) that goes with their slope, and its derivative with their bend.
void onto_manifold(const double* slope, const double* bend, std::size_t n, double* q,
                   double* v, double* dv) {
    const double *a = q + 3, *b = slope + 3, *c = bend + 3;
    const double size = std::sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3]);
    double unit[4], rate[4], rise[4], along = 0.0;
    for (int k = 0; k < 4; ++k) unit[k] = a[k] / size;
    for (int k = 0; k < 4; ++k) along += unit[k] * b[k];
    for (int k = 0; k < 4; ++k) {
        rate[k] = (b[k] - unit[k] * along) / size;
        rise[k] = c[k] / size;
    }
    const Quat back = conjugate(readq(unit));
    const Quat turn = back * readq(rate), more = back * readq(rise);
    const double stretch = 2.0 * along / size;
    std::copy(unit, unit + 4, q + 3);
    std::copy(slope, slope + 3, v);
    std::copy(bend, bend + 3, dv);
    v[3] = 2.0 * turn.x, v[4] = 2.0 * turn.y, v[5] = 2.0 * turn.z;
    dv[3] = 2.0 * more.x - stretch * v[3];
    dv[4] = 2.0 * more.y - stretch * v[4];
    dv[5] = 2.0 * more.z - stretch * v[5];
    std::copy(slope + 7, slope + n, v + 6);
    std::copy(bend + 7, bend + n, dv + 6);
}

// Slopes (n, width) at the nodes x (n) of the spline through y (n, width) without steps of
// its bend, those at both ends (2, width) given: three diagonals, the middle the largest.
void smooth_slopes(const double* x, const double* y, const double* ends, std::size_t n,
                   std::size_t width, double* out) {
    std::vector<double> middle(n, 1.0);
    std::copy(ends, ends + width, out);
    std::copy(ends + width, ends + 2 * width, out + (n - 1) * width);
    const auto h = [x](std::size_t i) { return x[i + 1] - x[i]; };
    for (std::size_t i = 1; i + 1 < n; ++i) {
        const double a = h(i - 1), b = h(i);
        middle[i] = 2.0 * (a + b);
        for (std::size_t j = 0; j < width; ++j) {
            const double* const at = y + i * width + j;
            const double before = (at[0] - *(at - width)) / a, after = (at[width] - at[0]) / b;
            out[i * width + j] = 3.0 * (b * before + a * after);
        }
    }
    for (std::size_t i = 1; i + 1 < n; ++i) {
        const double share = h(i) / middle[i - 1];
        middle[i] -= share * (i > 1 ? h(i - 2) : 0.0);
        for (std::size_t j = 0; j < width; ++j)
            out[i * width + j] -= share * out[(i - 1) * width + j];
    }
    for (std::size_t i = n - 2; i > 0 && i < n; --i)
        for (std::size_t j = 0; j < width; ++j)
            out[i * width + j] =
                (out[i * width + j] - h(i - 1) * out[(i + 1) * width + j]) / middle[i];
}

// Linear between rows (n, width); the first and the last beyond the nodes.
void look_between(const double* rows, const double* nodes, std::size_t n, std::size_t width,
                  double s, double* out) {
    const std::size_t next = std::size_t(std::upper_bound(nodes, nodes + n, s) - nodes);
    const double* const b = rows + std::min(next, n - 1) * width;
    if (next == 0 || next == n) {
        std::copy(b, b + width, out);
        return;
    }
    const double *a = b - width, span = nodes[next] - nodes[next - 1];
    for (std::size_t j = 0; j < width; ++j)
        out[j] = (b[j] - a[j]) / span * (s - nodes[next - 1]) + a[j];
}

}  // namespace

void bind_spline(nb::module_& m) {
    m.def("smooth_slopes",
          [](const Array1<>& x, const Array2<>& y, const Array2<>& ends) {
              const std::size_t n = x.size(), width = y.shape(1);
              check_size(y.shape(0), n, "nodes that increase, with finite points");
              check_size(ends.size(), 2 * width, "slopes at both ends");
              const auto finite = [](const auto& a) {
                  return std::all_of(a.data(), a.data() + a.size(),
                                     [](double v) { return std::isfinite(v); });
              };
              bool good = n > 1 && finite(x) && finite(y) && finite(ends);
              for (std::size_t i = 1; i < n; ++i) good = good && x(i) > x(i - 1);
              if (!good) throw nb::value_error("nodes that increase, with finite points");
              std::vector<double> out(n * width);
              smooth_slopes(x.data(), y.data(), ends.data(), n, width, out.data());
              return own(std::move(out), {n, width});
          },
          "(n, k) slopes at x (n,) of the spline through y (n, k) without steps of bend; "
          "those at both ends (2, k) given.");
    m.def("along_spline",
          [](const Array3<>& c, const Array1<>& nodes, const Array1<>& s) {
              const std::size_t n = s.size(), nq = c.shape(2), nv = nq - 1;
              if (nq < 7) throw std::invalid_argument("q begins with a free joint");
              if (nodes.size() < 2 || c.shape(0) != 4 || c.shape(1) + 1 != nodes.size())
                  throw std::invalid_argument("four coefficients between two nodes each");
              std::vector<double> q(n * nq), v(n * nv), dv(n * nv), slope(nq), bend(nq);
              for (std::size_t i = 0; i < n; ++i) {
                  double* const at = q.data() + i * nq;
                  look_along(c.data(), nodes.data(), nodes.size(), nq, s(i), at, slope.data(),
                             bend.data());
                  onto_manifold(slope.data(), bend.data(), nq, at, v.data() + i * nv,
                                dv.data() + i * nv);
              }
              return nb::make_tuple(own(std::move(q), {n, nq}), own(std::move(v), {n, nv}),
                                    own(std::move(dv), {n, nv}));
          },
          "Postures (n, nq) along a cubic spline at s (n,), their tangent vectors (n, nv) "
          "and the derivatives of those.");
    m.def("between_rows",
          [](const Array2<>& rows, const Array1<>& nodes, const Array1<>& s) {
              const std::size_t n = s.size(), width = rows.shape(1);
              check_size(rows.shape(0), nodes.size(), "a row for each node");
              if (nodes.size() < 1) throw std::invalid_argument("a node");
              std::vector<double> out(n * width);
              for (std::size_t i = 0; i < n; ++i)
                  look_between(rows.data(), nodes.data(), nodes.size(), width, s(i),
                               out.data() + i * width);
              return own(std::move(out), {n, width});
          },
          "Rows (n, k) at s (n,), linear between those of the nodes.");
}

}  // namespace clamber
