#include "timing.h"

#include <algorithm>
#include <cmath>

namespace clamber {

namespace {

constexpr double RANK = 1e-4;  // of a regularisation against a direction of length one
constexpr int CONE_EDGES = 4;
constexpr int END = -2, BEGIN = -1;  // rows of constraints, from behind

}  // namespace

// Constraints in interval i: bounds of u and x, each in units of its own, and shares of a
// weight along the cones' edges; balance; torques; x at the end, and at the begin, which
// are bounded later.
void TimeLaw::pose(const Course& course, const std::vector<Contact>& contacts, int i,
                   double share) {
    const int nv = model_.nv, na = static_cast<int>(model_.dadr.size());
    const Holding& held = planner_.look(contacts, course.q + i * model_.nq);
    ContactPointsView points = held.points();
    points.cone_edges = CONE_EDGES;
    const TorqueView torque = held.torque();
    const LoadView load = held.load();
    const int nf = points.n * CONE_EDGES, rows = 6 + na + 2;
    n_ = 2 + nf;
    m_ = n_ + rows;
    edges_.resize(3 * nf);
    auto* const edges = reinterpret_cast<double(*)[3]>(edges_.data());
    cone_generators(points, edges);
    rows_.resize((6 + na) * nf);
    load_rows(points, load.com, torque, edges, CONE_EDGES, rows_.data());

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
        std::copy_n(&rows_[r * nf], nf, row + 2);
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
    const double step = course.length[i] * u_max / x_max;
    double* const ends = &A_[(6 + na) * n_];
    ends[0] = step;
    ends[n_] = -step;
    ends[1] = ends[n_ + 1] = 1.0;
    H_.assign(n_ * n_, 0.0);
    for (int k = 0; k < n_; ++k) H_[k * (n_ + 1)] = RANK;
}

// x as large as can be at the end of the interval (END), or at its begin (BEGIN).
bool TimeLaw::solve(int towards) {
    const double* const row = &A_[(m_ - n_ + towards) * n_];
    c_.assign(n_, 0.0);
    c_[0] = -row[0];
    c_[1] = -row[1];
    const double size = std::hypot(c_[0], c_[1]);
    c_[0] /= size;
    c_[1] /= size;
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
    return solver_.solve(qp) > 0;
}

void TimeLaw::fastest(const Course& course,
                      const std::vector<std::vector<Contact>>& stances, double share,
                      double* x) {
    const int n = course.n;
    std::vector<double> most(n + 1, 0.0), slowing(n, 0.0);  // x, and u / x at it
    // From how fast an interval can be begun so that rest can be reached at the end. So
    // slow that |u| / u_slow + x / x_slow <= 1, inertia is nothing, whatever is left.
    for (int i = n - 1; i >= 0; --i) {
        const double next = most[i + 1], length = course.length[i];
        const double slow = course.x_slow[i], brake = length * course.u_slow[i];
        const double least = std::max(slow - next, 0.0) / (slow + brake);
        for (const double r : {least, slow / (slow + brake)})
            most[i] = std::max(most[i], (1.0 - r) * slow + r * brake);
        pose(course, stances[course.stance[i]], i, share);
        upper_[m_ + END] = next / course.x_max[i];
        if (!solve(BEGIN)) continue;
        const double u = solver_.x()[0] * course.u_max[i];
        const double begin = solver_.x()[1] * course.x_max[i] - length * u;
        if (begin <= most[i]) continue;
        most[i] = begin;
        slowing[i] = u / begin;
    }
    // As fast as can be, within that.
    x[0] = 0.0;
    for (int i = 0; i < n; ++i) {
        const double length = course.length[i], slow = course.x_slow[i];
        pose(course, stances[course.stance[i]], i, share);
        upper_[m_ + END] = most[i + 1] / course.x_max[i];
        upper_[m_ + BEGIN] = lower_[m_ + BEGIN] = x[i] / course.x_max[i];
        sense_[m_ + BEGIN] = EQUALITY;
        double u = slowing[i] * x[i];  // between rest and the law above: only rounding
        if (x[i] <= slow)
            u = (1.0 - x[i] / slow) / (1.0 / course.u_slow[i] + length / slow);
        if (solve(END)) u = std::max(x[i] <= slow ? u : -UNBOUNDED, solver_.x()[0] * course.u_max[i]);
        x[i + 1] = std::min(std::max(x[i] + 2.0 * length * u, 0.0), most[i + 1]);
    }
}

}  // namespace clamber
