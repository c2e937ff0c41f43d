#include "holding.h"

namespace clamber {

namespace {

constexpr double SPARED_ARM = 0.004;  // [m] times the weight: torque not counted on
constexpr double HELD_SHARE = 0.5;  // of friction that is made use of, where that will do
constexpr double LEAST_SHARE = 0.25;  // of the effort limits that is, all the same

}  // namespace

Holding::Holding(const Model& model)
    : model_(model), gravity_(model.nv), limits_(model.dadr.size()) {}

void Holding::look(Kinematics& kin, const std::vector<Contact>& contacts) {
    points_.clear();
    normals_.clear();
    mu_.clear();
    owner_.clear();
    com_ = kin.com();
    const int nv = model_.nv, na = static_cast<int>(model_.dadr.size());
    std::size_t rows = 0;
    for (const Contact& c : contacts) rows += 3 * kin.touching(c.surface, c.edge).corners;
    jacobian_.assign(rows * nv, 0.0);
    double* row = jacobian_.data();
    std::vector<bool> bears(nv, false);
    for (std::size_t i = 0; i < contacts.size(); ++i) {
        const Contact& c = contacts[i];
        const Surface& s = model_.surfaces[c.surface];
        const Support& on = model_.supports[c.support];
        const Touching& touching = kin.touching(c.surface, c.edge);
        for (int k = 0; k < touching.corners; ++k, row += 3 * nv) {
            const Vec3 p = kin.point(s.body, touching.corner[k]) - on.normal * s.radius;
            points_.push_back({p.x, p.y, p.z});
            normals_.push_back({on.normal.x, on.normal.y, on.normal.z});
            mu_.push_back(on.friction);
            owner_.push_back(static_cast<int>(i));
            for (const int d : model_.chain[s.body]) {
                const Vec3 moves = kin.twist(d).v + cross(kin.twist(d).w, p);
                for (int axis = 0; axis < 3; ++axis) row[axis * nv + d] = moves[axis];
                bears[d] = bears[d] || square(moves) > 0.0;
            }
        }
    }
    const double weight = model_.mass * GRAVITY;
    const Vec3* jcom = kin.com_jacobian();
    for (int d = 0; d < nv; ++d) gravity_[d] = weight * jcom[d].z;
    for (int j = 0; j < na; ++j) {
        const double most = model_.tau_max[j];
        const double spared = bears[model_.dadr[j]] ? SPARED_ARM * weight : 0.0;
        limits_[j] = std::max(EFFORT_SHARE * most - spared, LEAST_SHARE * most);
    }
    std::copy_n(LoadView{}.wrench, 6, wrench_);
}

void Holding::wrench_of(const Kinematics& kin, const double* force, double* wrench) const {
    // The free joint: a force in the world, at the base's origin, a moment in its axes.
    const double scale = 1.0 / (model_.mass * GRAVITY);
    const Vec3 f = read3(force) * scale;
    const Vec3 m = matrix(kin.quat(model_.base)) * (read3(force + 3) * scale) +
                   cross(kin.pos(model_.base) - com_, f);
    write3(f, wrench);
    write3(m, wrench + 3);
}

void Holding::add(const Kinematics& kin, const double* force) {
    double more[6];
    wrench_of(kin, force, more);
    for (int i = 0; i < 6; ++i) wrench_[i] += more[i];
    for (int d = 0; d < model_.nv; ++d) gravity_[d] += force[d];
}

ContactPointsView Holding::points() const {
    ContactPointsView out;
    out.n = static_cast<int>(points_.size());
    out.points = reinterpret_cast<const double (*)[3]>(points_.data());
    out.normals = reinterpret_cast<const double (*)[3]>(normals_.data());
    out.mu = mu_.data();
    return out;
}

LoadView Holding::load() const {
    LoadView out;
    write3(com_, out.com);
    out.mass = model_.mass;
    std::copy_n(wrench_, 6, out.wrench);
    return out;
}

TorqueView Holding::torque() const {
    TorqueView out;
    out.jacobian = jacobian_.data();
    out.gravity = gravity_.data();
    out.dofs = model_.dadr.data();
    out.limits = limits_.data();
    out.na = static_cast<int>(limits_.size());
    out.nv = model_.nv;
    return out;
}

double Holding::residual() { return statics_.residual(points(), load(), torque()); }

bool Holding::has_room(double distance) {
    constexpr double ways[4][2] = {{1.0, 0.0}, {-1.0, 0.0}, {0.0, 1.0}, {0.0, -1.0}};
    for (const auto& way : ways) {
        LoadView moved = load();
        for (int i = 0; i < 2; ++i) moved.com[i] += distance * way[i];
        if (statics_.residual(points(), moved, torque()) > BALANCE_TOL) return false;
    }
    return true;
}

double Holding::strain() {
    tau_.resize(limits_.size());
    torques_with(torque(), nullptr, 1.0, tau_.data());
    double most = 0.0;
    for (std::size_t j = 0; j < limits_.size(); ++j)
        if (limits_[j] > 0.0) most = std::max(most, std::abs(tau_[j]) / limits_[j]);
    return most;
}

double Holding::room(double* outward) {
    return statics_.com_room(points(), load(), torque(), outward);
}

bool Holding::torques_with(const TorqueView& torque, const double* price, double share,
                           double* tau) {
    forces_.assign(points_.size(), {});
    used_.clear();
    for (const double mu : mu_) used_.push_back(share * mu);
    ContactPointsView points = this->points();
    points.mu = used_.data();
    const double left = statics_.contact_forces(
        points, load(), torque, price, reinterpret_cast<double (*)[3]>(forces_.data()));
    bool within = left < BALANCE_TOL;
    for (std::size_t j = 0; j < limits_.size(); ++j) {
        const int d = model_.dadr[j];
        tau[j] = gravity_[d];
        for (std::size_t i = 0; i < forces_.size(); ++i)
            for (int axis = 0; axis < 3; ++axis)
                tau[j] -= jacobian_[(3 * i + axis) * model_.nv + d] * forces_[i][axis];
        within = within && std::abs(tau[j]) <= limits_[j];
    }
    return within;
}

void Holding::torques(const double* price, double* tau) {
    const double* each = nullptr;
    if (price) {
        price_.clear();
        for (const int i : owner_) price_.push_back(price[i]);
        each = price_.data();
    }
    if (!torques_with(TorqueView{}, each, HELD_SHARE, tau) &&
        !torques_with(TorqueView{}, each, 1.0, tau))
        torques_with(torque(), each, 1.0, tau);
    for (std::size_t j = 0; j < limits_.size(); ++j)
        tau[j] = std::min(std::max(tau[j], -model_.tau_max[j]), model_.tau_max[j]);
}

}  // namespace clamber
