#include "timing.h"

#include <algorithm>
#include <cmath>

#include "robot.h"

namespace clamber::fuzz {

void timing(Random& random, Outcome& outcome) {
    Model m = robot(random);
    const int n = random.between(0, 6);
    const bool wild = random.mood == Mood::WILD;
    std::vector<std::vector<Contact>> stances(2);
    std::vector<double> at = posture(random, m);
    if (random.one_in(2)) {
        const Answer answer = with_answer(random, m);
        stances[0] = answer.contacts;
        at = answer.q;
    }
    for (int i = random.below(4); i > 0; --i) stances[1].push_back(contact(random, m));
    std::vector<double> q, slope, inertia, velocity, length, u_max, x_max, u_slow, x_slow;
    std::vector<int> stance;
    const auto some = [&](double least, double most) {
        return wild ? random.size(most) : random.uniform(least, most);
    };
    for (int i = 0; i < n; ++i) {
        q.insert(q.end(), at.begin(), at.end());
        for (int d = 0; d < m.nv; ++d) {
            slope.push_back(random.number());
            inertia.push_back(random.number(20.0));
            velocity.push_back(random.number(20.0));
        }
        stance.push_back(random.below(2));
        length.push_back(some(0.01, 1.0));
        u_max.push_back(some(0.1, 50.0));
        x_max.push_back(some(0.1, 50.0));
        u_slow.push_back(some(1e-4, 1e-2));
        x_slow.push_back(some(1e-4, 1e-2));
    }
    std::vector<double> damping(m.nv);
    for (double& d : damping) d = some(0.0, 2.0);
    Course course;
    course.n = n;
    course.length = length.data();
    course.q = q.data();
    course.slope = slope.data();
    course.inertia = inertia.data();
    course.velocity = velocity.data();
    course.stance = stance.data();
    course.u_max = u_max.data();
    course.x_max = x_max.data();
    course.u_slow = u_slow.data();
    course.x_slow = x_slow.data();
    course.damping = damping.data();
    std::vector<double> x(n + 1);
    PathPlanner planner(m);
    const double share = wild ? random.size() : random.uniform(0.1, 1.0);
    TimeLaw(planner, m).fastest(course, stances, share, x.data());
    outcome.saw(x.data(), n + 1);
    for (int i = 1; i < n; ++i) outcome.solved = outcome.solved || x[i] > x_slow[i];
    if (wild) return;
    Outcome::expect(x[0] == 0.0 && x[n] == 0.0, "a law goes from rest to rest");
    for (int i = 0; i < n; ++i) {
        Outcome::expect(std::isfinite(x[i]) && x[i] >= 0.0, "a law is a law");
        Outcome::expect(i == 0 || x[i] > 0.0, "it does not rest on the way");
        Outcome::expect(x[i] <= std::max(x_max[i], x_slow[i]) * (1.0 + 1e-6),
                        "no interval begins faster than it may");
        const double u = (x[i + 1] - x[i]) / (2.0 * length[i]);
        Outcome::expect(u <= std::max(u_max[i], u_slow[i]) * (1.0 + 1e-6), "none speeds up more");
    }
}

}  // namespace clamber::fuzz
