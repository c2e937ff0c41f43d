#include "statics.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "fuzz.h"

namespace clamber::fuzz {

namespace {

struct Stance {
    std::vector<std::array<double, 3>> points, normals;
    std::vector<double> mu, jacobian, gravity, limits;
    std::vector<int> dofs;
    ContactPointsView contacts;
    LoadView load;
    TorqueView torque;
};

void make(Random& random, Stance& s) {
    const int n = random.between(0, 10);
    for (int i = 0; i < n; ++i) {
        Vec3 p{random.number(0.5), random.number(0.5), random.number(0.5)};
        Vec3 normal{random.number(0.5), random.number(0.5), 1.0};
        if (random.one_in(2)) normal = {0.0, 0.0, 1.0};
        if (random.one_in(20)) normal = -normal;
        normal *= 1.0 / norm(normal);
        if (random.mood == Mood::WILD && random.one_in(8)) normal.y = random.number();
        s.points.push_back({p.x, p.y, p.z});
        if (i > 0 && random.one_in(8)) s.points.back() = s.points[random.below(i)];
        s.normals.push_back({normal.x, normal.y, normal.z});
        s.mu.push_back(random.mood == Mood::WILD ? random.number() : random.uniform(0.05, 1.2));
    }
    s.contacts.n = n;
    s.contacts.points = reinterpret_cast<const double(*)[3]>(s.points.data());
    s.contacts.normals = reinterpret_cast<const double(*)[3]>(s.normals.data());
    s.contacts.mu = s.mu.data();
    s.contacts.cone_edges = random.one_in(2) ? 4 : 8;
    for (double& x : s.load.com) x = random.number(0.3);
    s.load.mass = random.mood == Mood::WILD ? random.number() : random.uniform(1.0, 80.0);
    if (random.one_in(2)) return;
    const int nv = random.between(6, 14), na = random.between(0, nv - 6);
    for (int i = 0; i < 3 * n * nv; ++i) s.jacobian.push_back(random.number(0.5));
    for (int i = 0; i < nv; ++i) s.gravity.push_back(random.number(20.0));
    for (int i = 0; i < na; ++i) {
        s.dofs.push_back(6 + i);
        s.limits.push_back(random.size(60.0));
    }
    s.torque = {s.jacobian.data(), s.gravity.data(), s.dofs.data(), s.limits.data(), na, nv};
}

// Forces within their pyramids, and what they leave of the balance.
void check(const Stance& s, double residual, const double (*forces)[3]) {
    const double weight = s.load.mass * GRAVITY;
    Vec3 force{0.0, 0.0, -weight}, moment;
    const Vec3 com = read3(s.load.com);
    for (int i = 0; i < s.contacts.n; ++i) {
        const Vec3 f = read3(forces[i]), normal = read3(s.normals[i].data());
        const double pressed = dot(f, normal);
        Outcome::expect(pressed >= -1e-6 * weight, "contacts press");
        Outcome::expect(norm(f - pressed * normal) <= s.mu[i] * pressed + 1e-6 * weight,
                        "forces are within their friction cones");
        force += f;
        moment += cross(read3(s.points[i].data()) - com, f);
    }
    Outcome::expect(residual >= 0.0 && (s.torque.na > 0 || residual <= 1.0 + 1e-6),
                    "a residual is a share of the weight");
    if (residual > BALANCE_TOL) return;
    Outcome::expect(norm(force) <= 1e-5 * weight && norm(moment) <= 1e-5 * weight,
                    "forces without a residual balance the weight");
}

}  // namespace

void statics(Random& random, Outcome& outcome) {
    static Statics kept;  // was asked all problems before this one
    Stance s;
    make(random, s);
    const auto n = static_cast<std::size_t>(s.contacts.n);
    std::vector<double> price;
    for (std::size_t i = 0; i < n; ++i) price.push_back(1.0 + random.size(10.0));
    const double* const priced = random.one_in(2) ? price.data() : nullptr;
    std::vector<std::array<double, 3>> forces(n), again(n);
    const auto rows = [](auto& f) { return reinterpret_cast<double(*)[3]>(f.data()); };

    Statics fresh;
    const double residual =
        fresh.contact_forces(s.contacts, s.load, s.torque, priced, rows(forces));
    const double second = kept.contact_forces(s.contacts, s.load, s.torque, priced, rows(again));
    outcome.solved = residual <= BALANCE_TOL;
    Outcome of_kept = outcome;
    of_kept.saw(second);
    outcome.saw(residual);
    for (std::size_t i = 0; i < n; ++i) {
        outcome.saw(forces[i].data(), 3);
        of_kept.saw(again[i].data(), 3);
        for (const double f : forces[i]) Outcome::expect(std::isfinite(f), "forces are finite");
    }
    Outcome::expect(outcome.hash == of_kept.hash, "nothing depends on what was asked before");

    std::vector<double> yields(n + static_cast<std::size_t>(s.torque.na));
    const double margin = fresh.push_margin(s.contacts, s.load, s.torque, yields.data());
    const bool stable = fresh.is_stable(s.contacts, s.load.com);
    outcome.saw(margin);
    outcome.saw(static_cast<int>(stable));
    outcome.saw(yields.data(), static_cast<int>(yields.size()));
    Outcome::expect(margin >= -1.0 - 1e-6 && margin <= 1.0 + 1e-6, "a margin is within a weight");
    if (random.mood == Mood::WILD) return;
    check(s, residual, rows(forces));
    if (s.torque.na == 0 && residual <= 0.1 * BALANCE_TOL)
        Outcome::expect(stable, "what forces balance is stable");
    // Forces many times the weight cost as much as what they leave unbalanced.
    double most = 0.0;
    for (const auto& f : forces) most = std::max(most, norm(read3(f.data())));
    const bool light = priced == nullptr && most < 5.0 * s.load.mass * GRAVITY;
    if (margin > 1e-4 && light)
        Outcome::expect(residual < 1e-2, "what bears a push holds without");
    if (s.torque.na == 0 && stable && light)
        Outcome::expect(residual <= 100.0 * BALANCE_TOL,
                        "what is stable has forces that balance");
}

}  // namespace clamber::fuzz
