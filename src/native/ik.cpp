#include "ik.h"

namespace clamber {

namespace {

constexpr std::size_t OTHER_ROWS = 256;  // besides distances, that are remembered

std::vector<Shape> shapes_of(const Model& model) {
    std::vector<Shape> out;
    for (const Geom& g : model.geoms) out.push_back(g.shape);
    return out;
}

// H += w J'J of one row, upper triangle, over its entries that are not zero.
void add_square(const double* row, int n, double w, double* H, std::vector<int>& nonzero) {
    int m = 0;
    for (int d = 0; d < n; ++d)
        if (row[d] != 0.0) nonzero[m++] = d;
    for (int i = 0; i < m; ++i) {
        const double s = w * row[nonzero[i]];
        double* out = H + static_cast<std::size_t>(nonzero[i]) * n;
        for (int j = i; j < m; ++j) out[nonzero[j]] += s * row[nonzero[j]];
    }
}

}  // namespace

double Residuals::worst() const {
    return std::max(std::max(contact, distance), std::max(balance, limits));
}

bool Residuals::solved() const {
    return contact <= CONTACT_TOL && limits <= LIMIT_TOL && distance <= DISTANCE_TOL &&
           balance <= MARGIN_TOL;
}

Solver::Solver(const Model& model)
    : model(model),
      kin(model),
      rows(model),
      near(shapes_of(model), model.pairs),
      H(model.nv * model.nv),
      c(model.nv),
      largest_(model.nv, STEP_ROTATION),
      heavy_(model.nv * model.nv),
      gradient_(model.nv),
      dq_(model.nv),
      trial_(model.nq),
      nonzero_(model.nv),
      bound_active_(model.nv, 0),
      row_active_(model.pairs.size() + OTHER_ROWS, 0) {
    std::fill(largest_.begin(), largest_.begin() + std::min(3, model.nv), STEP_TRANSLATION);
    qp_.settings.rho_soft = 1.0 / PENALTY;
    // H is as convex as its damping; where numbers are so large that it is lost, no step.
    qp_.settings.eps_prox = 0.0;
    qp_.settings.iter_limit = 1000;
}

// How far a joint is beyond its limits, negative within.
double Solver::beyond_limits(std::size_t j, const double* q) const {
    const double now = q[model.qadr[j]];
    return std::max(model.q_min[j] - now, now - model.q_max[j]);
}

double Solver::look(const Problem& problem, const double* q, double reach) {
    kin.update(q);
    rows.look(kin, near, problem, reach);
    double cost = 0.0, posture = 0.0;
    for (int i = 0; i < rows.soft.n; ++i) cost += rows.soft.lo[i] * rows.soft.lo[i];
    if (problem.posture_weight > 0.0)
        for (const int a : model.qadr) {
            const double off = q[a] - problem.q_reference[a];
            posture += off * off;
        }
    double beyond = 0.0;
    for (std::size_t j = 0; j < model.qadr.size(); ++j) {
        const double over = beyond_limits(j, q);
        if (over > 0.0) beyond += over * over;
    }
    return 0.5 * (cost + problem.posture_weight * problem.posture_weight * posture +
                  PENALTY * (rows.violation + beyond));
}

double Solver::begin(const Problem& problem, const double* q, double reach) {
    rows.ask(problem);
    forget_active();
    const double merit = look(problem, q, reach);
    linearise(problem, q);
    return merit;
}

void Solver::linearise(const Problem& problem, const double* q) {
    rows.fill(kin);
    const int nv = model.nv;
    std::fill(H.begin(), H.end(), 0.0);
    std::fill(c.begin(), c.end(), 0.0);
    for (int i = 0; i < rows.soft.n; ++i) {
        const double* row = rows.soft.row(i);
        add_square(row, nv, 1.0, H.data(), nonzero_);
        for (int d = 0; d < nv; ++d) c[d] += row[d] * rows.soft.lo[i];
    }
    const double weight = problem.posture_weight * problem.posture_weight;
    for (int d = 0; d < nv; ++d) H[d * nv + d] += DAMPING;
    for (std::size_t j = 0; j < model.dadr.size(); ++j) {
        const int d = model.dadr[j], a = model.qadr[j];
        H[d * nv + d] += weight;
        c[d] += weight * (q[a] - problem.q_reference[a]);
    }
    const std::size_t m = nv + rows.kept.n;
    lower.assign(m, -FAR);
    upper.assign(m, FAR);
    for (std::size_t j = 0; j < model.dadr.size(); ++j) {
        const int d = model.dadr[j];
        const double now = q[model.qadr[j]];
        lower[d] = std::max(model.q_min[j], -FAR) - now;
        upper[d] = std::min(model.q_max[j], FAR) - now;
    }
    std::copy(rows.kept.lo.begin(), rows.kept.lo.begin() + rows.kept.n, lower.begin() + nv);
    std::copy(rows.kept.hi.begin(), rows.kept.hi.begin() + rows.kept.n, upper.begin() + nv);
    factored_ = false;
    kept_.swap(rows.kept.J);
    closed_.swap(rows.closed.J);
    errors_.assign(rows.closed.lo.begin(), rows.closed.lo.begin() + rows.closed.n);
    // What is closed weighs as much as what is kept, as a penalty in the cost: as
    // equalities, contacts would close at the cost of distances.
    heavy_ = H;
    for (std::size_t i = 0; i < errors_.size(); ++i)
        add_square(closed_.data() + i * nv, nv, PENALTY, heavy_.data(), nonzero_);
    for (int i = 0; i < nv; ++i)
        for (int j = 0; j < i; ++j) {
            H[i * nv + j] = H[j * nv + i];
            heavy_[i * nv + j] = heavy_[j * nv + i];
        }
    sense_.assign(m, SOFT);
    keys_ = rows.keys;
    for (int d = 0; d < nv; ++d) sense_[d] = bound_active_[d];
    for (std::size_t i = 0; i < keys_.size(); ++i)
        if (keys_[i] < static_cast<int>(row_active_.size()))
            sense_[nv + i] |= row_active_[keys_[i]];
}

QP Solver::qp() const {
    QP out;
    out.n = out.bounded = model.nv;
    out.m = static_cast<int>(lower.size());
    out.H = heavy_.data();
    out.c = gradient_.data();
    out.A = kept_.data();
    out.upper = high_.data();
    out.lower = low_.data();
    out.sense = sense_.data();
    return out;
}

void Solver::step(double radius, double* dq) {
    const int nv = model.nv, m = static_cast<int>(lower.size());
    // What is violated is asked to recover only as far as such a step can reach: then
    // every step, however short, points the right way.
    const double reach = radius * RECOVERY_STEP;
    low_.resize(m);
    high_.resize(m);
    for (int i = 0; i < m; ++i) {
        low_[i] = std::min(lower[i], reach);
        high_[i] = std::max(upper[i], -reach);
    }
    for (int d = 0; d < nv; ++d) {
        low_[d] = std::max(low_[d], -radius * largest_[d]);
        high_[d] = std::min(high_[d], radius * largest_[d]);
    }
    gradient_ = c;
    for (std::size_t i = 0; i < errors_.size(); ++i) {
        const double e = PENALTY * std::min(std::max(errors_[i], -reach), reach);
        const double* row = closed_.data() + i * nv;
        for (int d = 0; d < nv; ++d) gradient_[d] -= row[d] * e;
    }
    // Where a step is tried again shorter, the factors are those of the longer one.
    factored_ = factored_ && qp_.solve_again(gradient_.data()) > 0;
    if (!factored_) factored_ = qp_.solve(qp()) > 0;  // where it fails, x is zero
    for (int d = 0; d < nv; ++d) dq[d] = std::min(std::max(qp_.x()[d], low_[d]), high_[d]);
    remember_active();
}

void Solver::forget_active() {
    std::fill(bound_active_.begin(), bound_active_.end(), 0);
    std::fill(row_active_.begin(), row_active_.end(), 0);
}

void Solver::remember_active() {
    const int* const sense = qp_.active_set();
    const auto bits = [sense](std::size_t i) {
        return sense[i] & ACTIVE ? sense[i] & ACTIVE_LOWER : 0;
    };
    forget_active();
    if (!factored_) return;  // it failed
    for (int d = 0; d < model.nv; ++d) bound_active_[d] = bits(d);
    for (std::size_t i = 0; i < keys_.size(); ++i)
        if (keys_[i] < static_cast<int>(row_active_.size()))
            row_active_[keys_[i]] = bits(model.nv + i);
}

Solver::Descent Solver::descend(const Problem& problem, const double* q, double merit,
                                int iterations, double tolerance, bool leap,
                                std::vector<double>& x) {
    Descent out;
    out.merit = merit;
    x.assign(q, q + model.nq);
    double radius = 1.0;
    int slow = 0;
    for (int n = 1; n <= iterations; ++n) {
        out.iterations = n;
        step(radius, dq_.data());
        double size = 0.0;
        for (const double d : dq_) size = std::max(size, std::abs(d));
        integrate(model, x.data(), dq_.data(), trial_.data());
        // The next step will hardly be much longer than this one.
        const double reach = std::min(NEAR_RANGE + size, ACTIVE_RANGE);
        const double there = look(problem, trial_.data(), reach);
        if ((leap && n == 1) || there <= out.merit) {
            slow = out.merit - there < SLOW * there ? slow + 1 : 0;
            const bool small = size < tolerance && size < 0.9 * radius * STEP_ROTATION;
            out.converged = small || slow >= 3;
            x.swap(trial_);
            out.merit = there;
            if (out.converged) break;
            if (n < iterations) linearise(problem, x.data());
            radius = std::min(2.0 * radius, 1.0);
        } else {
            radius *= 0.25;
        }
        if (radius < MIN_RADIUS) break;
    }
    return out;
}

void Solver::solve(const Problem& problem, const double* q, int iterations,
                   double tolerance, Solution& out) {
    const double start = begin(problem, q, ACTIVE_RANGE);
    if (!std::isfinite(start)) {  // nothing to descend from
        out.q.assign(q, q + model.nq);
        out.iterations = 0;
        out.converged = false;
        out.residuals = residuals(problem, q);
        return;
    }
    Descent found = descend(problem, q, start, iterations, tolerance, true, out.q);
    out.iterations = found.iterations;
    if (found.merit > start) {
        begin(problem, q, ACTIVE_RANGE);
        found = descend(problem, q, start, iterations, tolerance, false, out.q);
        out.iterations += found.iterations;
    }
    out.converged = found.converged;
    out.residuals = residuals(problem, out.q.data());
}

void Solver::solve_hard(const Problem& problem, const double* q, const double* hint,
                        Solution& out) {
    solve(problem, hint ? hint : q, MAX_ITERATIONS, STEP_TOL, out);
    int iterations = out.iterations;
    // Distances make the problem non-convex: from `q`, a limb may be on the wrong side
    // of an edge. Then from where it stalled, and from the posture that would do if
    // nothing could collide.
    Solution trial;
    std::vector<double> start;
    for (int attempt = hint ? 0 : 1; attempt < 3 && !out.residuals.solved(); ++attempt) {
        if (attempt == 0) {
            start.assign(q, q + model.nq);
        } else if (attempt == 1) {
            start = out.q;
        } else {
            Problem free = problem;
            std::fill(free.clearance.begin(), free.clearance.end(),
                      -std::numeric_limits<double>::infinity());
            solve(free, q, MAX_ITERATIONS, STEP_TOL, trial);
            iterations += trial.iterations;
            start = trial.q;
        }
        solve(problem, start.data(), MAX_ITERATIONS, STEP_TOL, trial);
        iterations += trial.iterations;
        if (trial.residuals.worst() < out.residuals.worst()) std::swap(out, trial);
    }
    out.iterations = iterations;
}

Residuals Solver::residuals(const Problem& problem, const double* q) {
    Residuals out;
    rows.ask(problem);
    for (int i = 0; i < model.nq; ++i)
        if (!std::isfinite(q[i])) {  // no posture at all
            out.contact = FAR;
            out.com_margin = -FAR;
            return out;
        }
    kin.update(q);
    for (const SurfaceTask& t : problem.tasks)
        if (t.kind != TaskKind::Reaching) out.contact = std::max(out.contact, opened(kin, t));
    for (const auto& [pair, at] :
         near.query(kin.geom_poses(), rows.farthest, rows.counts.data())) {
        const double lacking = problem.clearance[pair] - at.distance;
        if (!(lacking <= out.distance)) out.distance = lacking, out.worst_pair = pair;
    }
    rows.bearing(kin, problem);
    out.com_margin = com_margin(kin.com().x, kin.com().y, rows.polygon);
    if (problem.balance)
        out.balance = std::max(problem.balance_margin - out.com_margin, 0.0);
    for (std::size_t j = 0; j < model.qadr.size(); ++j)
        out.limits = std::max(out.limits, beyond_limits(j, q));
    return out;
}

}  // namespace clamber
