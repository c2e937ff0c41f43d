// What contacts ask of the joints at a posture: points that bear, what they load, and the
// torques that go with the least forces.
#pragma once

#include <vector>

#include "model.h"
#include "statics.h"

namespace clamber {

// As in `clamber.contact.contact`.
struct Contact {
    int surface = 0, support = 0, edge = -1;
    bool has_link = false;
    Vec3 position;
    Quat quaternion, link;
};

constexpr double EFFORT_SHARE = 0.9;  // of the effort limits: servos need the rest

class Holding {
  public:
    explicit Holding(const Model& model);

    // Look at contacts at the present posture.
    void look(Kinematics& kin, const std::vector<Contact>& contacts);
    // Of a generalised force (nv): its wrench about the centre of mass, in weights.
    void wrench_of(const Kinematics& kin, const double* force, double* wrench) const;
    // The robot moves: more than its weight is to be borne, by a generalised force (nv).
    void add(const Kinematics& kin, const double* force);
    // Wrench and torques left over by the least forces, in weights: within
    // `BALANCE_TOL` where friction cones and torques that are counted on hold the robot.
    double residual();
    // Whether that holds with the centre of mass a distance from where it is, along each
    // axis; and how far it may be in the worst direction, which is `outward` (2).
    bool has_room(double distance);
    double room(double* outward);
    // Of the joint that bears most, the share of what is counted on.
    double strain();
    // (na) torques that balance what is looked at with the least contact forces; where these ask
    // more of a joint than is counted on, with those that do not. `price` of a force at
    // each contact, or none.
    void torques(const double* price, double* tau);

    // What was looked at.
    ContactPointsView points() const;
    LoadView load() const;
    TorqueView torque() const;
    const std::vector<int>& owners() const { return owner_; }  // contact of each point

  private:
    bool torques_with(const TorqueView& torque, const double* price, double share, double* tau);

    const Model& model_;
    Statics statics_;
    Vec3 com_;
    double wrench_[6];
    std::vector<std::array<double, 3>> points_, normals_, forces_;
    std::vector<double> mu_, used_, jacobian_, gravity_, limits_, price_, tau_;
    std::vector<int> owner_;
};

}  // namespace clamber
