#include "qp.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "fuzz.h"

namespace clamber::fuzz {

namespace {

struct Problem {
    QP qp;
    std::vector<double> H, c, A, upper, lower, rho;
    std::vector<int> sense;
};

Problem make(Random& random) {
    Problem p;
    const int n = random.between(1, 12), bounded = random.one_in(2) ? random.between(0, n) : 0;
    const int rows = random.between(0, 20), m = bounded + rows;
    std::vector<double> G(n * n);
    for (double& g : G) g = random.number();
    p.H.assign(n * n, 0.0);
    const double ridge = random.mood == Mood::TAME ? 1e-3 : random.size(1e-3);
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) {
            for (int k = 0; k < n; ++k) p.H[i * n + j] += G[k * n + i] * G[k * n + j];
            if (i == j) p.H[i * n + j] += ridge;
        }
    for (int i = 0; i < n; ++i) p.c.push_back(random.number(10.0));
    for (int i = 0; i < rows * n; ++i) p.A.push_back(random.number());
    // Rows that are zero, or that say the same twice.
    for (int r = 1; r < rows; ++r)
        if (random.one_in(10))
            for (int j = 0; j < n; ++j)
                p.A[r * n + j] = random.one_in(2) ? 0.0 : p.A[(r - 1) * n + j];
    int equalities = 0;
    for (int i = 0; i < m; ++i) {
        const double a = random.number(), b = a + random.size(2.0);
        int sense = INEQUALITY;
        if (random.one_in(8) && equalities < n) sense = EQUALITY, ++equalities;
        else if (random.one_in(8)) sense = SOFT;
        else if (random.one_in(8)) sense = random.one_in(2) ? ACTIVE : ACTIVE_LOWER;
        p.sense.push_back(sense);
        p.lower.push_back(sense != EQUALITY && random.one_in(4) ? -UNBOUNDED : a);
        p.upper.push_back(sense == EQUALITY ? p.lower[i]
                          : random.one_in(4) ? UNBOUNDED : b);
        p.rho.push_back(random.mood == Mood::TAME ? random.uniform(1e-6, 1.0) : random.size());
    }
    p.qp.n = n;
    p.qp.m = m;
    p.qp.bounded = bounded;
    p.qp.H = p.H.data();
    p.qp.c = p.c.data();
    p.qp.A = p.A.data();
    p.qp.upper = p.upper.data();
    p.qp.lower = p.lower.data();
    p.qp.sense = random.one_in(4) ? nullptr : p.sense.data();
    p.qp.rho = random.one_in(2) ? p.rho.data() : nullptr;
    return p;
}

// The conditions of Karush, Kuhn and Tucker, of constraints that may not be broken.
void check(const QP& qp, const double* x, const double* lam) {
    std::vector<double> gradient(qp.c, qp.c + qp.n);
    double scale = 1.0;
    for (int i = 0; i < qp.n; ++i) {
        for (int j = 0; j < qp.n; ++j) gradient[i] += qp.H[i * qp.n + j] * x[j];
        scale = std::max({scale, std::abs(x[i]), std::abs(gradient[i])});
    }
    for (int i = 0; i < qp.m; ++i) {
        double value = i < qp.bounded ? x[i] : 0.0;
        if (i < qp.bounded) gradient[i] += lam[i];
        else
            for (int j = 0; j < qp.n; ++j) {
                const double a = qp.A[(i - qp.bounded) * qp.n + j];
                value += a * x[j];
                gradient[j] += a * lam[i];
            }
        scale = std::max(scale, std::abs(lam[i]));
        if (qp.sense != nullptr && (qp.sense[i] & SOFT)) continue;
        Outcome::expect(value <= qp.upper[i] + 1e-5 * scale && value >= qp.lower[i] - 1e-5 * scale,
                        "an optimal x satisfies its constraints");
    }
    for (int i = 0; i < qp.n; ++i)
        Outcome::expect(std::abs(gradient[i]) <= 1e-5 * scale, "the gradient is balanced");
}

}  // namespace

void qp(Random& random, Outcome& outcome) {
    static QPSolver kept;  // has solved all problems before this one
    const Problem p = make(random);
    QPSolver fresh;
    const int flag = fresh.solve(p.qp), again = kept.solve(p.qp);
    outcome.saw(flag);
    outcome.saw(fresh.x(), p.qp.n);
    outcome.saw(fresh.lam(), p.qp.m);
    outcome.solved = flag > 0;
    Outcome::expect(flag == again && std::equal(fresh.x(), fresh.x() + p.qp.n, kept.x()),
                    "a result depends on the problem alone");
    for (int i = 0; i < p.qp.n; ++i)
        Outcome::expect(std::isfinite(fresh.x()[i]), "x is finite");
    if (flag > 0 && random.mood == Mood::TAME) check(p.qp, fresh.x(), fresh.lam());

    // Another c with the factors of the first, and the second problem from the first's end.
    std::vector<double> c;
    for (int i = 0; i < p.qp.n; ++i) c.push_back(random.number(10.0));
    if (flag > 0) {
        const int next = fresh.solve_again(c.data());
        outcome.saw(next);
        outcome.saw(fresh.x(), p.qp.n);
        const std::vector<int> active(fresh.active_set(), fresh.active_set() + p.qp.m);
        QP warm = p.qp;
        warm.sense = active.data();
        const int end = kept.solve(warm);
        outcome.saw(end);
        outcome.saw(kept.x(), p.qp.n);
    }
}

}  // namespace clamber::fuzz
