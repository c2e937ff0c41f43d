// Strictly convex (or regularised) quadratic programmes, by DAQP, in a workspace that is
// kept: nothing is allocated unless a problem is larger than all before it, and a result
// depends on the problem alone, not on what was solved before.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>

#include "daqp/include/api.h"
#include "daqp/include/utils.h"

namespace clamber {

constexpr double UNBOUNDED = 1e30;

// How a constraint is meant, in bits.
enum Sense : int {
    INEQUALITY = 0,
    ACTIVE = 1,         // at its upper bound where the search begins
    ACTIVE_LOWER = 3,   // at its lower one
    EQUALITY = 5,       // both bounds are equal
    SOFT = 8,           // may be broken by s, at a cost of s^2 / (2 rho)
};

// min 1/2 x'Hx + c'x over lower <= (x[:bounded]; A x) <= upper.
struct QP {
    int n = 0;        // variables
    int m = 0;        // constraints, bounds on variables included
    int bounded = 0;  // how many variables the first constraints are bounds on
    const double* H = nullptr;    // (n, n)
    const double* c = nullptr;    // (n,)
    const double* A = nullptr;    // (m - bounded, n)
    const double* upper = nullptr;  // (m,)
    const double* lower = nullptr;  // (m,)
    const int* sense = nullptr;   // (m,); none: all inequalities
    // (m,) of soft constraints in their own scale; none: `settings.rho_soft`, in the scale
    // in which DAQP makes the rows of A R^-1 unit vectors, H = R'R.
    const double* rho = nullptr;
};

class QPSolver {
public:
    // Not finite: H, c or A; or a bound that is no number.
    static constexpr int NOT_FINITE = -100;

    DAQPSettings settings;

    QPSolver() {
        daqp_default_settings(&settings);
        // An elimination of equalities would allocate in every solve.
        settings.eq_reduction = DAQP_EQ_REDUCTION_OFF;
    }
    QPSolver(const QPSolver&) = delete;
    QPSolver& operator=(const QPSolver&) = delete;

    // The flag of DAQP: positive where x is optimal (2: with a soft constraint broken),
    // else x and lam are zero. The arrays of `qp` are read until the next solve.
    int solve(const QP& qp) {
        if (!lay_out(qp)) return failed(qp, NOT_FINITE);
        constexpr int all = DAQP_UPDATE_Rinv | DAQP_UPDATE_M | DAQP_UPDATE_v | DAQP_UPDATE_d |
                            DAQP_UPDATE_sense | DAQP_UPDATE_unconstrained;
        return update_and_solve(qp, all);
    }

    // The problem of the last `solve` with another c: from its factors and active set.
    int solve_again(const double* c) {
        qp_.c = c;
        problem_.f = const_cast<double*>(c);
        if (!finite(c, static_cast<std::size_t>(qp_.n))) return failed(qp_, NOT_FINITE);
        return update_and_solve(qp_, DAQP_UPDATE_v | DAQP_UPDATE_d);
    }

    const double* x() const { return x_; }      // (n,)
    const double* lam() const { return lam_; }  // (m,) positive at upper bounds
    int iterations() const { return work_.iterations; }
    // (m,) to pass as the sense of a problem like this one, which then begins where this
    // one ended: with its active constraints.
    const int* active_set() const { return work_.sense; }

private:
    static bool finite(const double* v, std::size_t size) {
        double sum[4] = {0.0, 0.0, 0.0, 0.0};  // side by side: one chain would be slow
        std::size_t i = 0;
        for (; i + 4 <= size; i += 4)
            for (int k = 0; k < 4; ++k) sum[k] += 0.0 * v[i + k];
        for (; i < size; ++i) sum[0] += 0.0 * v[i];
        return sum[0] + sum[1] + sum[2] + sum[3] == 0.0;
    }

    template <typename T>
    static void reserve(std::unique_ptr<T[]>& array, std::size_t& room, std::size_t size) {
        if (room >= size) return;
        array.reset(new T[size]);
        room = size;
    }

    // Lays the workspace out for the problem; false where its numbers are no numbers.
    bool lay_out(const QP& qp) {
        qp_ = qp;
        const auto n = static_cast<std::size_t>(qp.n), m = static_cast<std::size_t>(qp.m);
        const std::size_t rows = m - static_cast<std::size_t>(qp.bounded);
        std::size_t soft = 0;
        if (qp.sense != nullptr)
            for (std::size_t i = 0; i < m; ++i) soft += (qp.sense[i] & SOFT) != 0;
        const std::size_t active = n + soft + 1;  // at most so many at a time

        const std::size_t size = 5 * active + active * (active + 1) / 2 + 4 * n +
                                 n * (n + 1) / 2 + rows * (n + 1) + 8 * m;
        reserve(numbers_, room_for_numbers_, size);
        reserve(whole_, room_for_whole_, active + n + m);
        double* next = numbers_.get();
        const auto take = [&next](std::size_t count) {
            double* const out = next;
            next += count;
            return out;
        };
        x_ = take(n);
        lam_ = take(m);

        work_ = DAQPWorkspace{};
        work_.settings = &settings;
        work_.n = qp.n;
        work_.m = qp.m;
        work_.ms = qp.bounded;
        work_.lam = take(active);
        work_.lam_star = take(active);
        work_.D = take(active);
        work_.xldl = take(active);
        work_.zldl = take(active);
        work_.L = take(active * (active + 1) / 2);
        work_.u = work_.x = take(n);
        work_.xold = take(n);
        work_.v = take(n);
        work_.Rinv = take(n * (n + 1) / 2);
        work_.M = take(rows * n);
        work_.Mu = rows > 0 ? take(rows) : nullptr;
        work_.scaling = take(m);
        work_.dupper = take(m);
        work_.dlower = take(m);
        work_.WS = whole_.get();
        work_.prox_mask = work_.WS + active;
        work_.sense = work_.prox_mask + n;
        work_.outer_iter = 1;
        reset_daqp_workspace(&work_);
        std::fill(work_.u, work_.u + n, 0.0);
        std::fill(work_.prox_mask, work_.prox_mask + n, 0);
        std::fill(work_.scaling, work_.scaling + qp.bounded, 1.0);
        if (qp.rho != nullptr && soft > 0) {
            work_.rho_ls = work_.rho_us = take(m);
            work_.w_ls = work_.w_us = take(m);
            std::copy(qp.rho, qp.rho + m, work_.rho_ls);
            std::fill(work_.w_ls, work_.w_ls + m, 0.0);
        }

        problem_ = DAQPProblem{};
        problem_.n = qp.n;
        problem_.m = qp.m;
        problem_.ms = qp.bounded;
        problem_.H = const_cast<double*>(qp.H);
        problem_.f = const_cast<double*>(qp.c);
        problem_.A = const_cast<double*>(qp.A);
        problem_.bupper = const_cast<double*>(qp.upper);
        problem_.blower = const_cast<double*>(qp.lower);
        problem_.sense = const_cast<int*>(qp.sense);

        bool bounds = true;
        for (std::size_t i = 0; i < m; ++i)
            bounds = bounds && !std::isnan(qp.upper[i]) && !std::isnan(qp.lower[i]);
        return bounds && finite(qp.H, n * n) && finite(qp.c, n) && finite(qp.A, rows * n);
    }

    int update_and_solve(const QP& qp, int mask) {
        DAQPResult result{};
        result.x = x_;
        result.lam = lam_;
        result.exitflag = daqp_update_ldp(mask, &work_, &problem_);
        if (result.exitflag < 0) return failed(qp, result.exitflag);
        std::fill(lam_, lam_ + qp.m, 0.0);
        daqp_solve(&result, &work_);
        if (result.exitflag <= 0 || !finite(x_, static_cast<std::size_t>(qp.n)))
            return failed(qp, std::min(result.exitflag, 0));
        return result.exitflag;
    }

    int failed(const QP& qp, int flag) {
        std::fill(x_, x_ + qp.n, 0.0);
        std::fill(lam_, lam_ + qp.m, 0.0);
        return flag;
    }

    QP qp_;
    DAQPProblem problem_{};
    DAQPWorkspace work_{};
    double *x_ = nullptr, *lam_ = nullptr;
    std::unique_ptr<double[]> numbers_;
    std::unique_ptr<int[]> whole_;
    std::size_t room_for_numbers_ = 0, room_for_whole_ = 0;
};

}  // namespace clamber
