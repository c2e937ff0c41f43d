#include <cmath>
#include <vector>

#include "fuzz.h"
#include "robot.h"

namespace clamber::fuzz {

namespace {

SurfaceTask task(Random& random, const Model& m) {
    SurfaceTask t;
    t.surface = random.below(static_cast<int>(m.surfaces.size()));
    t.support = random.below(2);
    const bool flat = m.surfaces[t.surface].flat;
    t.kind = static_cast<TaskKind>(random.below(4));
    if (t.kind == TaskKind::OnEdge && !flat) t.kind = TaskKind::Closed;
    t.edge = t.kind == TaskKind::OnEdge ? random.below(4) : -1;
    t.loaded = !random.one_in(3);
    t.has_link = random.one_in(2);
    t.position = vector(random, 0.5);
    t.rotation = turn(random);
    t.link = turn(random);
    t.reference = random.size(2.0);
    t.stability = random.size(5.0);
    t.weight = random.size(40.0);
    return t;
}

Problem question(Random& random, const Model& m) {
    Problem p;
    const int tasks = random.between(0, 4);
    for (int i = 0; i < tasks; ++i) p.tasks.push_back(task(random, m));
    const int bodies = static_cast<int>(m.bodies.size());
    for (int i = random.below(3); i > 0; --i) {
        PointingTask t;
        t.starts = random.between(1, 2);
        t.ends = random.between(1, 2);
        for (int k = 0; k < 2; ++k) {
            t.start_body[k] = random.below(bodies);
            t.end_body[k] = random.below(bodies);
            t.start[k] = vector(random, 0.1);
            t.end[k] = vector(random, 0.1);
        }
        t.direction = vector(random, 1.0);
        t.weight = random.size(1.0);
        p.pointing.push_back(t);
    }
    p.q_reference = posture(random, m);
    for (std::size_t i = 0; i < m.pairs.size(); ++i)
        p.clearance.push_back(random.one_in(4) ? -INFINITY : random.number(0.02));
    p.turned = random.one_in(2);
    p.base_rotation = turn(random);
    p.base_weight = random.size(1.0);
    p.over = random.one_in(2);
    for (double& x : p.com_target) x = random.number(0.5);
    p.com_weight = random.size(1.0);
    p.balance = !random.one_in(4);
    p.balance_margin = random.number(0.05);
    p.ellipse_weight = random.size(2.0);
    p.posture_weight = random.size(1.0);
    return p;
}

void saw(Outcome& outcome, const Solution& s) {
    outcome.saw(s.q.data(), static_cast<int>(s.q.size()));
    outcome.saw(s.iterations);
    outcome.saw(s.residuals.contact);
    outcome.saw(s.residuals.distance);
    outcome.saw(s.residuals.balance);
    outcome.saw(s.residuals.worst_pair);
}

}  // namespace

void posture(Random& random, Outcome& outcome) {
    Model m = robot(random);
    Problem p = question(random, m);
    std::vector<double> q = posture(random, m);
    if (random.mood == Mood::TAME && random.one_in(2)) {
        const Answer answer = with_answer(random, m);
        p = Problem{};
        for (const Contact& c : answer.contacts) p.tasks.push_back(closed_task(m, c));
        p.q_reference = answer.q;
        p.posture_weight = random.size(1.0);
        p.balance = false;
        for (int i = 0; i < m.nq; ++i) q[i] = answer.q[i] + 0.1 * q[i];
    }
    Solver solver(m), other(m);
    Solution found, again;
    solver.solve(p, q.data(), 6, 2e-3, found);
    other.residuals(question(random, m), q.data());  // asked something else before
    other.solve(p, q.data(), 6, 2e-3, again);
    Outcome second = outcome;
    saw(outcome, found);
    saw(second, again);
    // Bounds of distances are of shapes and turns that are some.
    if (random.mood != Mood::WILD)
        Outcome::expect(outcome.hash == second.hash,
                        "nothing depends on what was asked before");
    outcome.solved = found.residuals.solved();
    Outcome::expect(found.iterations <= 12, "a solve ends");
    bool finite = true;
    for (const double x : found.q) finite = finite && std::isfinite(x);
    Outcome::expect(finite || !outcome.solved, "what is solved is a posture");
    if (random.mood != Mood::WILD) Outcome::expect(finite, "postures stay finite");
}

void path(Random& random, Outcome& outcome) {
    Model m = robot(random);
    Transition t;
    for (auto* q : {&t.before, &t.shifted, &t.touching, &t.after}) *q = posture(random, m);
    // Postures of one motion are near each other.
    for (auto* q : {&t.shifted, &t.touching, &t.after})
        for (int i = 0; i < m.nq; ++i) (*q)[i] = t.before[i] + 0.1 * (*q)[i];
    for (int i = random.below(4); i > 0; --i) t.held.push_back(contact(random, m));
    for (int i = random.below(2); i > 0; --i) t.rolling.push_back(contact(random, m));
    t.makes = random.one_in(2);
    t.made = contact(random, m);
    t.made.edge = -1;
    t.margin = random.number(0.05);
    t.adapt = !random.one_in(4);
    if (random.mood == Mood::TAME && random.one_in(2)) {
        const Answer answer = with_answer(random, m);
        t.before = t.shifted = t.touching = t.after = answer.q;
        t.held = answer.contacts;
        t.rolling.clear();
        t.made = t.held.back();
        if (t.makes && t.held.size() > 1) t.held.pop_back();
    }
    Path found;
    PathPlanner(m).plan(t, found);
    outcome.saw(static_cast<int>(found.status));
    outcome.saw(found.depth);
    for (const Postures& nodes : found.phases)
        for (const auto& q : nodes) outcome.saw(q.data(), m.nq);
    outcome.solved = found.status == Path::Status::Solved;
}

}  // namespace clamber::fuzz
