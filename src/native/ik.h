// Whole-body inverse kinematics: a sequence of QPs in a trust region on their merit.
#pragma once

#include <vector>

#include "qp.h"
#include "tasks.h"

namespace clamber {

constexpr double STEP_ROTATION = 0.15;    // [rad] largest joint step of one iteration
constexpr double STEP_TRANSLATION = 0.08;  // [m] largest step of the base
constexpr double RECOVERY_STEP = 0.05;  // [m, rad] of a violation that a step makes good
constexpr double ACTIVE_RANGE = 0.10;   // [m] farther pairs have no row
constexpr double DAMPING = 2e-4;        // mu
constexpr double NEAR_RANGE = 0.03;     // [m] pairs this near always have a row
constexpr double SLOW = 0.01;  // share of the merit; three steps that gain less end it
constexpr double MIN_RADIUS = 5e-3;    // of the trust region, where the solve has stalled
constexpr int MAX_ITERATIONS = 60;     // of a solve, unless it asks for fewer
constexpr double STEP_TOL = 2e-3;      // [rad, m] a shorter last step ends it
constexpr double PENALTY = 1e6;        // of violations against the soft cost
constexpr double CONTACT_TOL = 5e-4;   // [m, rad] a contact is closed
constexpr double LIMIT_TOL = 1e-6;     // [rad] beyond a joint's limit
constexpr double DISTANCE_TOL = 2e-3;  // [m] a distance may fall short by this
constexpr double MARGIN_TOL = 2e-3;   // [m]

// How well a configuration satisfies a problem, computed without the solver.
struct Residuals {
    double contact = 0.0, distance = 0.0, balance = 0.0, limits = 0.0;
    int worst_pair = -1;
    double com_margin = 0.0;

    double worst() const;
    bool solved() const;
};

struct Solution {
    std::vector<double> q;
    int iterations = 0;
    bool converged = false;
    Residuals residuals;
};

// Workspace of the solver: one for each thread, used again for every posture.
class Solver {
  public:
    explicit Solver(const Model& model);

    // Iterate from `q` until the step is below `tolerance`. The first step is taken even
    // where it raises the merit; where that has not paid off in the end, the solve
    // begins again without.
    void solve(const Problem& problem, const double* q, int iterations, double tolerance,
               Solution& out);
    // The same for postures far from `q`, with more than one way to get there; `hint`,
    // a posture that solves a similar problem, is tried first where there is one.
    void solve_hard(const Problem& problem, const double* q, const double* hint,
                    Solution& out);
    Residuals residuals(const Problem& problem, const double* q);

    // The merit at `q` of a problem that was not looked at before, and the QP there, of
    // which no constraint is active to begin with.
    double begin(const Problem& problem, const double* q, double reach);
    // The same at other postures, from what was active.
    double look(const Problem& problem, const double* q, double reach);
    void linearise(const Problem& problem, const double* q);
    // Solve the QP of `linearise`, with steps up to a share of the largest.
    void step(double radius, double* dq);

    const Model& model;
    Kinematics kin;
    Rows rows;
    Proximity near;
    // The QP: H and c without contacts, bounds on the step, then those of the kept rows.
    // The rows of a rejected trial are others: those of the QP are its own.
    std::vector<double> H, c, lower, upper;

    const std::vector<double>& closed_rows() const { return closed_; }
    const std::vector<double>& kept_rows() const { return kept_; }
    const std::vector<double>& errors() const { return errors_; }

  private:
    struct Descent {
        int iterations = 0;
        bool converged = false;
        double merit = 0.0;
    };
    double beyond_limits(std::size_t joint, const double* q) const;
    QP qp() const;  // of a step
    void forget_active();
    void remember_active();
    Descent descend(const Problem& problem, const double* q, double merit, int iterations,
                    double tolerance, bool leap, std::vector<double>& x);

    QPSolver qp_;
    bool factored_ = false;  // the QP as it was built last
    std::vector<double> largest_;  // step of each dof
    std::vector<double> kept_, closed_, errors_;  // Jacobians, and what is to be closed
    std::vector<double> heavy_, gradient_, low_, high_, dq_, trial_;
    std::vector<int> sense_, nonzero_;
    std::vector<int> keys_;  // of the kept rows of the QP, as `Rows` has them
    // Which bounds and rows were active in the QP solved last: the next begins with them.
    std::vector<int> bound_active_, row_active_;
};

}  // namespace clamber
