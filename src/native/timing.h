// Path -> the fastest time law along it that joints and contacts can bear: reachability
// analysis [Pham18] with contact forces as variables of its linear programmes.
#pragma once

#include <vector>

#include "path.h"

namespace clamber {

// A path q(s) in n intervals. u = d2s/dt2 is constant in each, x = (ds/dt)^2 that of its
// faster end, and generalised forces are those of rest + inertia u + velocity x in its
// middle: where the path turns back its tangent is zero, and any u would do just there.
struct Course {
    int n = 0;
    const double* length = nullptr;    // (n,) of the intervals
    const double* q = nullptr;         // (n, nq)
    const double* slope = nullptr;     // (n, nv) dq/ds
    const double* inertia = nullptr;   // (n, nv)
    const double* velocity = nullptr;  // (n, nv)
    const int* stance = nullptr;       // (n,) which contacts may bear
    const double* u_max = nullptr;     // (n,) bound of |u|
    const double* x_max = nullptr;     // (n,) bound of x
    const double* u_slow = nullptr;    // (n,) |u|, and x, so slow that it is always borne
    const double* x_slow = nullptr;
    const double* damping = nullptr;   // (nv,) of the joints
};

// Take from the tangent vector v (nv) what moves contacts that are closed: their points,
// and of links that lie flat how they turn.
void keep_closed(Kinematics& kin, const std::vector<Contact>& contacts, double* v);

class TimeLaw {
  public:
    explicit TimeLaw(PathPlanner& planner, const Model& model)
        : planner_(planner), model_(model) {}

    // x (n + 1) between the intervals of the fastest law from rest to rest. `share`: of
    // what is left between rest and the border of what can be borne.
    void fastest(const Course& course, const std::vector<std::vector<Contact>>& stances,
                 double share, double* x);

  private:
    void pose(const Course& course, const std::vector<Contact>& contacts, int i,
              double share);
    bool solve(double u, double x);

    PathPlanner& planner_;
    const Model& model_;
    QPSolver solver_;
    std::vector<double> H_, c_, A_, upper_, lower_, edges_, rows_;
    std::vector<int> sense_, warm_, active_;
    const std::vector<Contact>* posed_ = nullptr;
    int n_ = 0, m_ = 0;  // variables u, x, shares of the cones' edges; constraints
};

}  // namespace clamber
