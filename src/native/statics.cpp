#include "statics.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>
#include <tuple>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "bindings.h"
#include "linalg.h"
#include "polygon.h"

namespace clamber {
namespace {

constexpr double TANGENTIAL_WEIGHT = 4.0;   // of a tangential against a normal force, squared
constexpr double SLACK_WEIGHT = 1e8;        // of what is unbalanced against a force, squared
constexpr double LP_WEIGHT = 1e-5;          // of the square of an LP's variables
constexpr double PUSH_LIMIT = 1.0;          // [weights] harder pushes are not looked at
constexpr double WEIGHT[6] = {0.0, 0.0, 1.0, 0.0, 0.0, 0.0};  // as a wrench

// Point k of so many on the unit circle, the first `start` steps on.
void circle_point(int k, int edges, double start, double* out) {
    const double angle = (k + start) * (2 * M_PI / edges);
    out[0] = std::cos(angle);
    out[1] = std::sin(angle);
}

}  // namespace

Mat3 contact_frame(const Vec3& normal) {
    const double x = normal.x, y = normal.y, z = normal.z;
    // Opposite to the world's x every half turn is a smallest rotation.
    if (x < 1e-9 - 1.0) return {{0.0, 0.0, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, 0.0}};
    const double scale = 1.0 / (1.0 + x);
    return {{-y, -z, x, x + scale * z * z, -scale * y * z, y, -scale * y * z,
             x + scale * y * y, z}};
}

void cone_generators(const ContactPointsView& contacts, double (*edges)[3]) {
    const int m = contacts.cone_edges;
    for (int k = 0; k < m; ++k) {
        double circle[2];
        circle_point(k, m, 0.0, circle);
        for (int i = 0; i < contacts.n; ++i) {
            const Mat3 R = contact_frame(read3(contacts.normals[i]));
            const double mu = contacts.mu[i];
            write3(R * Vec3{mu * circle[0], mu * circle[1], 1.0}, edges[i * m + k]);
        }
    }
}

void load_rows(const ContactPointsView& contacts, const double* com, const TorqueView& torque,
               const double (*directions)[3], int per, double* rows) {
    const int n = contacts.n * per;
    for (int i = 0; i < n; ++i) {
        const Vec3 e = read3(directions[i]);
        const Vec3 moment = cross(read3(contacts.points[i / per]) - read3(com), e);
        for (int c = 0; c < 3; ++c) {
            rows[c * n + i] = e[c];
            rows[(3 + c) * n + i] = moment[c];
        }
    }
    for (int j = 0; j < torque.na; ++j) {
        const double* column = torque.jacobian + torque.dofs[j];
        double* row = rows + (6 + j) * n;
        for (int p = 0; p < contacts.n; ++p, column += 3 * torque.nv) {
            const Vec3 J{column[0], column[torque.nv], column[2 * torque.nv]};
            for (int k = p * per; k < (p + 1) * per; ++k) row[k] = dot(J, read3(directions[k]));
        }
    }
}

void Statics::bound_rows(const LoadView& load, const TorqueView& torque, int first) {
    for (int i = first; i < first + 6; ++i) {
        upper_[i] = lower_[i] = load.wrench[i - first];
        sense_[i] = EQUALITY;
    }
    const double weight = load.mass * GRAVITY;
    for (int j = 0; j < torque.na; ++j) {
        const double g = torque.gravity[torque.dofs[j]];
        upper_[first + 6 + j] = (g + torque.limits[j]) / weight;
        lower_[first + 6 + j] = (g - torque.limits[j]) / weight;
    }
}

double Statics::left_over(const QP& qp, int row) const {
    double reached = 0.0;
    for (int k = 0; k < qp.n; ++k) reached += qp.A[row * qp.n + k] * solver_.x()[k];
    const int i = qp.bounded + row;
    return reached - std::min(std::max(reached, qp.lower[i]), qp.upper[i]);
}

double Statics::contact_forces(const ContactPointsView& contacts, const LoadView& load,
                               const TorqueView& torque, const double* price,
                               double (*forces)[3]) {
    const int n = 3 * contacts.n, na = torque.na, rows = 6 + na, edges = contacts.cone_edges;
    if (forces != nullptr) std::fill_n(&forces[0][0], n, 0.0);
    const double weight = load.mass * GRAVITY;
    if (n == 0 || !(weight > 0.0 && std::isfinite(weight))) return 1.0;
    // x: forces in contact frames [weights], at their price.
    double* const H = zeroed(H_, n * n);
    double* const c = zeroed(c_, n);
    directions_.resize(3 * n);
    auto* const axes = reinterpret_cast<double(*)[3]>(directions_.data());
    for (int i = 0; i < contacts.n; ++i) {
        const Mat3 R = contact_frame(read3(contacts.normals[i]));
        for (int k = 0; k < 3; ++k) {
            write3(R.col(k), axes[3 * i + k]);
            const double p = price == nullptr ? 1.0 : price[i];
            H[(3 * i + k) * (n + 1)] = k < 2 ? TANGENTIAL_WEIGHT * p : p;
        }
    }
    // Balance and torques, which may be left over at the weight of slack; then the facets
    // of the pyramids, whose normals lie between their edges.
    const int m = rows + contacts.n * edges;
    double* const A = zeroed(A_, m * n);
    double* const upper = zeroed(upper_, m);
    double* const lower = zeroed(lower_, m);
    sense_.assign(m, INEQUALITY);
    rho_.assign(m, 1.0 / SLACK_WEIGHT);
    load_rows(contacts, load.com, torque, axes, 3, A);
    bound_rows(load, torque, 0);
    for (int i = 0; i < rows; ++i) sense_[i] |= SOFT;
    const double inwards = -std::cos(M_PI / edges);
    for (int k = 0; k < edges; ++k) {
        double circle[2];
        circle_point(k, edges, 0.5, circle);
        for (int i = 0; i < contacts.n; ++i) {
            const int r = rows + i * edges + k;
            double* const facet = A + r * n + 3 * i;
            facet[0] = circle[0] / contacts.mu[i];
            facet[1] = circle[1] / contacts.mu[i];
            facet[2] = inwards;
            lower[r] = -UNBOUNDED;
        }
    }
    QP qp;
    qp.n = n;
    qp.m = m;
    qp.H = H;
    qp.c = c;
    qp.A = A;
    qp.upper = upper;
    qp.lower = lower;
    qp.sense = sense_.data();
    qp.rho = rho_.data();
    solver_.settings.primal_tol = DAQP_DEFAULT_PRIM_TOL;
    if (solver_.solve(qp) <= 0) return 1.0;
    const double* const x = solver_.x();
    if (forces != nullptr) {
        bool finite = true;
        for (int i = 0; i < contacts.n; ++i)
            for (int k = 0; k < 3; ++k) {
                forces[i][k] = weight * (axes[3 * i][k] * x[3 * i] +
                                         axes[3 * i + 1][k] * x[3 * i + 1] +
                                         axes[3 * i + 2][k] * x[3 * i + 2]);
                finite = finite && std::isfinite(forces[i][k]);
            }
        if (!finite) {
            std::fill_n(&forces[0][0], n, 0.0);
            return 1.0;
        }
    }
    double left = 0.0;
    for (int i = 0; i < rows; ++i) {
        const double over = left_over(qp, i);
        left += over * over;
    }
    return std::sqrt(left);
}

double Statics::least_room(const ContactPointsView& contacts, const LoadView& load,
                           const TorqueView& torque, bool moves, double* yields,
                           double* outward) {
    const int edges = contacts.cone_edges, n = contacts.n * edges, na = torque.na;
    const int rows = 6 + na;
    std::fill(yields, yields + contacts.n + na, 0.0);
    outward[0] = 1.0;
    outward[1] = 0.0;
    if (n == 0) return -PUSH_LIMIT;
    directions_.resize(3 * n);
    auto* const unit = reinterpret_cast<double(*)[3]>(directions_.data());
    cone_generators(contacts, unit);
    rows_.resize(rows * n);
    load_rows(contacts, load.com, torque, unit, edges, rows_.data());

    // min 1/2 |x|^2 weight - u'push over x = (shares of the cones' edges >= 0, push (2,)):
    // an LP, whose solution of least norm a small enough weight gives [Mangasarian79].
    const auto pose = [&](int pushes, double cost) {
        const int nv = n + pushes, m = nv + rows;
        double* const H = zeroed(H_, nv * nv);
        for (int i = 0; i < nv; ++i) H[i * (nv + 1)] = cost;
        double* const A = zeroed(A_, rows * nv);
        zeroed(c_, nv);
        upper_.assign(m, UNBOUNDED);
        lower_.assign(m, 0.0);
        sense_.assign(m, INEQUALITY);
        for (int i = 0; i < pushes; ++i) {
            // A push is one more force. A weight that lies at (x, y) from the centre of
            // mass has the moment (-y, x) about it, which the contacts have to make good.
            if (moves)
                A[(i == 0 ? 4 : 3) * nv + n + i] = i == 0 ? 1.0 : -1.0;
            else
                A[i * nv + n + i] = 1.0;
            upper_[n + i] = PUSH_LIMIT;
            lower_[n + i] = -PUSH_LIMIT;
        }
        for (int i = 0; i < rows; ++i) std::copy_n(&rows_[i * n], n, A + i * nv);
        bound_rows(load, torque, nv);
        QP qp;
        qp.n = nv;
        qp.m = m;
        qp.bounded = nv;
        qp.H = H;
        qp.c = c_.data();
        qp.A = A;
        qp.upper = upper_.data();
        qp.lower = lower_.data();
        qp.sense = sense_.data();
        return qp;
    };
    const auto point_yields = [&] {
        for (int i = 0; i < n; ++i)
            yields[i / edges] = std::max(yields[i / edges], std::fabs(solver_.lam()[i]));
    };

    // The polygon of pushes that the stance can bear, explored from inside, an LP for each
    // direction, until the nearest edge is a true one.
    const QP qp = pose(2, LP_WEIGHT);
    solver_.settings.primal_tol = 1e-8;
    constexpr double first[4][2] = {{1.0, 0.0}, {0.0, 1.0}, {-1.0, 0.0}, {0.0, -1.0}};
    double found[60][2], inner = -PUSH_LIMIT;
    Polygon polygon;
    for (int i = 0; i < 60; ++i) {
        const double u[2] = {i < 4 ? first[i][0] : outward[0], i < 4 ? first[i][1] : outward[1]};
        c_[n] = -u[0];
        c_[n + 1] = -u[1];
        int flag = i == 0 ? solver_.solve(qp) : solver_.solve_again(c_.data());
        if (flag <= 0 && i > 0) flag = solver_.solve(qp);
        if (flag <= 0) {
            // No push up to the weight helps. What limits: least squares instead of a push.
            QP least = pose(0, 1e-8);
            for (int r = 0; r < rows; ++r) sense_[n + r] |= SOFT;
            rho_.assign(least.m, 1.0);
            least.rho = rho_.data();
            solver_.settings.primal_tol = DAQP_DEFAULT_PRIM_TOL;
            if (solver_.solve(least) <= 0) return -PUSH_LIMIT;
            point_yields();
            // A soft row's multiplier, also of a joint that no contact loads.
            for (int j = 0; j < na; ++j)
                yields[contacts.n + j] = std::fabs(left_over(least, 6 + j));
            return -PUSH_LIMIT;
        }
        found[i][0] = solver_.x()[n];
        found[i][1] = solver_.x()[n + 1];
        if (i >= 4 && u[0] * found[i][0] + u[1] * found[i][1] <= inner + PUSH_TOL) break;
        support_polygon(found, i + 1, polygon);
        inner = nearest_border(0.0, 0.0, polygon, outward);
    }
    point_yields();
    for (int j = 0; j < na; ++j)
        yields[contacts.n + j] = std::fabs(solver_.lam()[qp.n + 6 + j]);
    return std::max(-PUSH_LIMIT, std::min(PUSH_LIMIT, inner));
}

bool Statics::is_stable(const ContactPointsView& contacts, const double* com) {
    // The wrench of the weight, w, lies in the cone of the contact wrenches W iff its
    // projection y on the polar cone, `min |y - w|^2  s.t.  W y <= 0`, is zero: a QP in six
    // variables however many contacts there are. y is the part of the weight that no
    // contact forces balance.
    const int n = contacts.n * contacts.cone_edges;
    if (n == 0) return false;
    directions_.resize(3 * n);
    auto* const unit = reinterpret_cast<double(*)[3]>(directions_.data());
    cone_generators(contacts, unit);
    rows_.resize(6 * n);
    load_rows(contacts, com, {}, unit, contacts.cone_edges, rows_.data());
    double* const W = zeroed(A_, 6 * n);
    for (int i = 0; i < n; ++i)
        for (int k = 0; k < 6; ++k) W[6 * i + k] = rows_[k * n + i];
    double* const H = zeroed(H_, 36);
    double* const c = zeroed(c_, 6);
    for (int k = 0; k < 6; ++k) {
        H[7 * k] = 1.0;
        c[k] = -WEIGHT[k];
    }
    lower_.assign(n, -UNBOUNDED);
    QP qp;
    qp.n = 6;
    qp.m = n;
    qp.H = H;
    qp.c = c;
    qp.A = W;
    qp.upper = zeroed(upper_, n);
    qp.lower = lower_.data();
    solver_.settings.primal_tol = 1e-8;
    if (solver_.solve(qp) != DAQP_EXIT_OPTIMAL) return false;
    double left = 0.0;
    for (int k = 0; k < 6; ++k) left += solver_.x()[k] * solver_.x()[k];
    return left <= BALANCE_TOL * BALANCE_TOL;
}

namespace {

using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const double, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Torque = std::optional<std::tuple<Array2<>, Array1<>, Array1<int>, Array1<>>>;

const double (*rows_of(const Points& p))[3] {
    return reinterpret_cast<const double(*)[3]>(p.data());
}

ContactPointsView contacts_of(const Points& points, const Points& normals, const Array1<>& mu,
                              int cone_edges) {
    if (points.shape(0) != normals.shape(0) || points.shape(0) != mu.shape(0))
        throw nb::value_error("points, but other numbers of normals or mu");
    if (cone_edges < 3) throw nb::value_error("a pyramid has at least three edges");
    return {static_cast<int>(points.shape(0)), rows_of(points), rows_of(normals), mu.data(),
            cone_edges};
}

TorqueView torque_of(const Torque& torque, int n) {
    if (!torque) return {};
    const auto& [jacobian, gravity, dofs, limits] = *torque;
    const std::size_t nv = gravity.shape(0), na = dofs.shape(0);
    if (jacobian.shape(0) != 3 * static_cast<std::size_t>(n) || jacobian.shape(1) != nv)
        throw nb::value_error("the jacobian's rows are not those of the points");
    if (limits.shape(0) != na) throw nb::value_error("dofs, but another number of limits");
    for (std::size_t j = 0; j < na; ++j)
        if (dofs.data()[j] < 0 || dofs.data()[j] >= static_cast<int>(nv))
            throw nb::value_error("dofs that the jacobian has not");
    return {jacobian.data(), gravity.data(), dofs.data(), limits.data(),
            static_cast<int>(na), static_cast<int>(nv)};
}

LoadView load_of(const Vector& com, double mass) {
    return {{com.data()[0], com.data()[1], com.data()[2]}, mass};
}

}  // namespace

void bind_statics(nb::module_& m) {
    m.attr("BALANCE_TOL") = BALANCE_TOL;
    m.attr("PUSH_TOL") = PUSH_TOL;
    m.def("contact_frames", [](const Points& normals) {
        std::vector<double> out;
        for (std::size_t i = 0; i < normals.shape(0); ++i) {
            const Mat3 R = contact_frame(read3(rows_of(normals)[i]));
            out.insert(out.end(), R.m, R.m + 9);
        }
        return new_array(out.data(), {normals.shape(0), 3, 3});
    });
    m.def("cone_generators", [](const Points& normals, const Array1<>& mu, int edges) {
        const ContactPointsView contacts = contacts_of(normals, normals, mu, edges);
        std::vector<double> out(3 * contacts.n * edges);
        cone_generators(contacts, reinterpret_cast<double(*)[3]>(out.data()));
        return new_array(out.data(), {normals.shape(0), static_cast<std::size_t>(edges), 3});
    });
    m.def("load_rows", [](const Points& points, const Points& normals, const Array1<>& mu,
                          int edges, const Vector& com, const Torque& torque) {
        const ContactPointsView contacts = contacts_of(points, normals, mu, edges);
        const TorqueView view = torque_of(torque, contacts.n);
        const auto n = static_cast<std::size_t>(contacts.n * edges);
        std::vector<double> unit(3 * n), rows((6 + view.na) * n);
        auto* const directions = reinterpret_cast<double(*)[3]>(unit.data());
        cone_generators(contacts, directions);
        load_rows(contacts, com.data(), view, directions, edges, rows.data());
        return new_array(rows.data(), {rows.size() / std::max<std::size_t>(n, 1), n});
    });
    m.def("contact_forces",
          [](const Points& points, const Points& normals, const Array1<>& mu, int edges,
             const Vector& com, double mass, const Torque& torque,
             const std::optional<Array1<>>& price) {
              const ContactPointsView contacts = contacts_of(points, normals, mu, edges);
              const TorqueView view = torque_of(torque, contacts.n);
              if (price && price->shape(0) != points.shape(0))
                  throw nb::value_error("points, but another number of prices");
              std::vector<double> forces(3 * points.shape(0));
              double residual;
              {
                  const nb::gil_scoped_release released;
                  residual = Statics().contact_forces(
                      contacts, load_of(com, mass), view, price ? price->data() : nullptr,
                      reinterpret_cast<double(*)[3]>(forces.data()));
              }
              return nb::make_tuple(new_array(forces.data(), {points.shape(0), 3}), residual);
          });
    m.def("push_margin",
          [](const Points& points, const Points& normals, const Array1<>& mu, int edges,
             const Vector& com, double mass, const Torque& torque) {
              const ContactPointsView contacts = contacts_of(points, normals, mu, edges);
              const TorqueView view = torque_of(torque, contacts.n);
              std::vector<double> yields(contacts.n + view.na);
              double margin;
              {
                  const nb::gil_scoped_release released;
                  margin = Statics().push_margin(contacts, load_of(com, mass), view,
                                                 yields.data());
              }
              return nb::make_tuple(margin, new_array(yields.data(), {yields.size()}));
          });
    m.def("com_room",
          [](const Points& points, const Points& normals, const Array1<>& mu, int edges,
             const Vector& com, double mass, const Torque& torque) {
              const ContactPointsView contacts = contacts_of(points, normals, mu, edges);
              const TorqueView view = torque_of(torque, contacts.n);
              const nb::gil_scoped_release released;
              double outward[2];
              return Statics().com_room(contacts, load_of(com, mass), view, outward);
          });
    m.def("is_statically_stable", [](const Points& points, const Points& normals,
                                     const Array1<>& mu, int edges, const Vector& com) {
        return Statics().is_stable(contacts_of(points, normals, mu, edges), com.data());
    });
}

}  // namespace clamber
