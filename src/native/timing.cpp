#include "timing.h"

#include <algorithm>
#include <cmath>

namespace clamber {

namespace {

constexpr double RANK = 1e-4;  // of a regularisation against a direction of length one
constexpr double LEAST = 1e-4;  // of an x that is always borne
constexpr double SAME = 1e-9;   // a law goes on along the one above

constexpr double DEPENDENT = 1e-8;  // a row is of those before it, against the longest

double along(const double* a, const double* b, int n) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) sum += a[i] * b[i];
    return sum;
}

}  // namespace

void keep_closed(Kinematics& kin, const std::vector<Contact>& contacts, double* v) {
    const Model& model = kin.model();
    const int nv = model.nv;
    std::vector<double> rows;
    for (const Contact& c : contacts) {
        const Surface& s = model.surfaces[c.surface];
        const Vec3 p = kin.contact_point(c.surface, c.edge, model.supports[c.support].normal);
        const int axes = s.flat && c.edge < 0 ? 6 : 3;
        const std::size_t first = rows.size();
        rows.resize(first + static_cast<std::size_t>(axes * nv), 0.0);
        for (const int d : model.chain[s.body]) {
            const Twist& t = kin.twist(d);
            const Vec3 moves[2] = {t.v + cross(t.w, p), t.w};
            for (int k = 0; k < axes; ++k) rows[first + k * nv + d] = moves[k / 3][k % 3];
        }
    }
    const int n = static_cast<int>(rows.size()) / nv;
    double longest = 0.0;
    for (int i = 0; i < n; ++i) {
        const double* const row = &rows[i * nv];
        longest = std::max(longest, along(row, row, nv));
    }
    // Rows at right angles to each other, twice for rounding; v at right angles to them.
    for (int i = 0; i < n; ++i) {
        double* const row = &rows[i * nv];
        const auto less = [nv](double* x, const double* unit) {
            const double share = along(x, unit, nv);
            for (int d = 0; d < nv; ++d) x[d] -= share * unit[d];
        };
        for (int pass = 0; pass < 2; ++pass)
            for (int j = 0; j < i; ++j) less(row, &rows[j * nv]);
        const double size = std::sqrt(along(row, row, nv));
        const bool own = size > DEPENDENT * std::sqrt(longest);
        for (int d = 0; d < nv; ++d) row[d] = own ? row[d] / size : 0.0;
        less(v, row);
    }
}

// Constraints in interval i: bounds of u and x, each in units of its own, and shares of a
// weight along the cones' edges; balance; torques; x at the other end, to be bounded.
void TimeLaw::pose(const Course& course, const std::vector<Contact>& contacts, int i,
                   double share) {
    const int nv = model_.nv, na = static_cast<int>(model_.dadr.size());
    if (&contacts != posed_) active_.clear();
    posed_ = &contacts;
    const Holding& held = planner_.look(contacts, course.q + i * model_.nq);
    const ContactPointsView points = held.points();
    const TorqueView torque = held.torque();
    const LoadView load = held.load();
    const int nf = points.n * points.cone_edges, rows = 6 + na + 1;
    n_ = 2 + nf;
    m_ = n_ + rows;
    edges_.resize(3 * nf);
    auto* const edges = reinterpret_cast<double(*)[3]>(edges_.data());
    cone_generators(points, edges);
    rows_.resize((6 + na) * nf);
    load_rows(points, load.com, torque, edges, points.cone_edges, rows_.data());

    const double weight = model_.mass * GRAVITY;
    const double u_max = course.u_max[i], x_max = course.x_max[i];
    const double *inertia = course.inertia + i * nv, *velocity = course.velocity + i * nv;
    const double* slope = course.slope + i * nv;
    double moved[2][6];
    held.wrench_of(planner_.solver.kin, inertia, moved[0]);
    held.wrench_of(planner_.solver.kin, velocity, moved[1]);
    A_.assign(rows * n_, 0.0);
    upper_.assign(m_, UNBOUNDED);
    lower_.assign(m_, 0.0);
    sense_.assign(m_, INEQUALITY);
    upper_[0] = upper_[1] = 1.0;
    lower_[0] = -1.0;
    for (int r = 0; r < 6 + na; ++r) {
        double* const row = &A_[r * n_];
        std::copy_n(rows_.data() + r * nf, nf, row + 2);  // none where nothing bears
        const int at = n_ + r;
        if (r < 6) {
            row[0] = -moved[0][r] * u_max / share;
            row[1] = -moved[1][r] * x_max / share;
            upper_[at] = lower_[at] = load.wrench[r];
            sense_[at] = EQUALITY;
            continue;
        }
        const int d = model_.dadr[r - 6];
        // Damping grows with the root of x: its tangent at a quarter is above it everywhere.
        const double damping = course.damping[d] * slope[d] * std::sqrt(x_max);
        row[0] = -inertia[d] * u_max / share / weight;
        row[1] = -(velocity[d] * x_max + damping) / share / weight;
        const double rest = torque.gravity[d] + 0.25 * damping, most = torque.limits[r - 6];
        upper_[at] = (rest + most) / weight;
        lower_[at] = (rest - most) / weight;
    }
    A_[(6 + na) * n_ + 1] = 1.0;
    H_.assign(n_ * n_, 0.0);
    for (int k = 0; k < n_; ++k) H_[k * (n_ + 1)] = RANK;
}

// As far as can be in a direction of u and x.
bool TimeLaw::solve(double u, double x) {
    c_.assign(n_, 0.0);
    c_[0] = -u;
    c_[1] = -x;
    QP qp;
    qp.n = n_;
    qp.m = m_;
    qp.bounded = n_;
    qp.H = H_.data();
    qp.c = c_.data();
    qp.A = A_.data();
    qp.upper = upper_.data();
    qp.lower = lower_.data();
    qp.sense = sense_.data();
    // From where the last one ended: the next interval's is much like it.
    warm_ = sense_;
    const bool known = active_.size() == sense_.size();
    for (int i = 0; known && i < m_; ++i)
        if (sense_[i] == INEQUALITY) warm_[i] = active_[i];
    if (known) qp.sense = warm_.data();
    int flag = solver_.solve(qp);
    if (flag <= 0 && known) {
        qp.sense = sense_.data();
        flag = solver_.solve(qp);
    }
    active_.clear();
    if (flag > 0)
        for (int i = 0; i < m_; ++i) {
            const int sense = solver_.active_set()[i];
            active_.push_back(sense & ACTIVE ? sense & ACTIVE_LOWER : INEQUALITY);
        }
    return flag > 0;
}

void TimeLaw::fastest(const Course& course,
                      const std::vector<std::vector<Contact>>& stances, double share,
                      double* x) {
    const int n = course.n;
    std::vector<double> most(n + 1, 0.0), slowing(n, 0.0);  // x, and u / x at it
    // With x at the begin (way 1) or at the end (-1); that of the other end, within bounds.
    const auto other = [&](int i, int way, double lower, double upper) {
        A_[(m_ - n_ - 1) * n_] = way * 2.0 * course.length[i] * course.u_max[i] / course.x_max[i];
        upper_[m_ - 1] = upper / course.x_max[i];
        lower_[m_ - 1] = lower / course.x_max[i];
        sense_[m_ - 1] = lower == upper ? EQUALITY : INEQUALITY;
    };
    // From how fast an interval can be begun so that rest can be reached at the end. So
    // slow that |u| / u_slow + x / x_slow <= 1, inertia is nothing, whatever is left.
    for (int i = n - 1; i >= 0; --i) {
        const double slow = course.x_slow[i], brake = 2.0 * course.length[i] * course.u_slow[i];
        most[i] = std::min(slow, (most[i + 1] + brake) / (1.0 + brake / slow));
        pose(course, stances[course.stance[i]], i, share);
        other(i, 1, 0.0, most[i + 1]);
        if (!solve(0.0, 1.0)) continue;
        const double fast = solver_.x()[1] * course.x_max[i];
        if (fast <= most[i]) continue;
        most[i] = fast;
        slowing[i] = solver_.x()[0] * course.u_max[i] / fast;
    }
    // As fast as can be, within that.
    x[0] = 0.0;
    for (int i = 0; i < n; ++i) {
        const double along = x[i] + 2.0 * course.length[i] * slowing[i] * x[i];
        if (x[i] == most[i] && along >= (1.0 - SAME) * most[i + 1]) {
            x[i + 1] = most[i + 1];
            continue;
        }
        const double slow = course.u_slow[i] * (1.0 - x[i] / course.x_slow[i]);
        // Between rest and the law above, where rounding leaves nothing else.
        double u = slow >= 0.0 ? slow : slowing[i] * x[i];
        pose(course, stances[course.stance[i]], i, share);
        upper_[1] = std::min(most[i + 1] / course.x_max[i], 1.0);
        other(i, -1, x[i], x[i]);
        bool solved = solve(1.0, 0.0) && solver_.x()[0] >= 0.0;
        if (!solved) {  // slower at the end
            upper_[1] = lower_[1] = std::min(x[i] / course.x_max[i], 1.0);
            sense_[1] = EQUALITY;
            other(i, 1, 0.0, std::min(most[i + 1], x[i]));
            solved = solve(1.0, 0.0);
        }
        if (solved) u = std::max(slow, solver_.x()[0] * course.u_max[i]);
        // Never quite at rest on the way: it would not end.
        const double next = std::max(x[i] + 2.0 * course.length[i] * u, LEAST * course.x_slow[i]);
        x[i + 1] = std::min(next, most[i + 1]);
    }
}

}  // namespace clamber
