// What a controller does at every physics step: sensing, filters, the servo law,
// positions in a reference, and what is recorded of a simulation.
//
// Sizes: nq of the configuration, na joints, nu actuators, ns surfaces. Nothing here
// decides: `Follower` asks its owner in Python where something is to be decided.
#pragma once

#include <array>
#include <cstdint>
#include <utility>
#include <vector>

#include "linalg.h"

namespace clamber {

using Reals = std::vector<double>;

// tau = kp (q_ref - q) + kd (qdot_ref - qdot) + ki int(q_ref - q) dt + tau_ff as the
// command u of servos tau = kp (u - q) - kd qdot, joint by joint.
class JointServo {
public:
    // Gains (na,), the bound of the integral [rad s] and the time of a step [s].
    JointServo(Reals kp, Reals damping, Reals ki, Reals limit, double dt);
    int size() const { return int(kp_.size()); }
    // `follow` in [0, 1]: the share to which a joint's reference is its measured angle.
    void command(const double* reference, const double* velocity, const double* torque,
                 const double* measured, const double* follow, double* out);

private:
    Reals kp_, damping_, ki_, limit_, integral_;
    double dt_;
};

// The share to which ankles of planted feet position themselves: eased in while all
// arms are loaded, and out before the foot steps.
class SelfPositioning {
public:
    using Ankle = std::pair<int, std::vector<int>>;  // surface of the foot, joints
    SelfPositioning(std::vector<std::vector<int>> arms, std::vector<Ankle> ankles, int na,
                    double rate);
    // Of a step later; flags (ns,): loaded, in contact now, in contact a little later.
    const Reals& share(const bool* loaded, const bool* closed, const bool* ahead);

private:
    std::vector<std::vector<int>> arms_;
    std::vector<Ankle> ankles_;
    Reals share_;
    double rate_;
};

// First-order low passes of the measured configuration and forces.
class Filter {
public:
    Filter(Reals q, int ns, double pose_share, double force_share)
        : q(std::move(q)), load(3 * ns, 0.0), pose_share_(pose_share),
          force_share_(force_share) {}
    void update(const double* q, const double* force);
    // Is one of the surfaces that are watched pressed along its normal so much [N]?
    bool is_pressed() const;
    // The least force along its normal on one of the surfaces that should bear [N].
    double least() const;
    int surfaces() const { return int(load.size()) / 3; }

    Reals q, load;  // (nq,), (ns, 3) [N]
    struct Watched { int surface; Vec3 normal; };
    std::vector<Watched> watched, bearing;
    double pressed = 0.0;

private:
    double pose_share_, force_share_;
};

// Whether forces (ns, 3) of the surfaces are less than the weight, by a share of it.
bool load_is_missing(const double* load, int ns, double weight, double share);
// Whether a force is sideways more than upwards, and than `least` [N].
bool is_sideways(const double* force, double least);

// Rows of a reference, one for each step. Rows that are given stay where they are, in
// memory of the caller; where there is one row for many steps, it is held.
class Track {
public:
    struct Rows {
        const double *q = nullptr, *velocity = nullptr, *torque = nullptr;
        const bool *closed = nullptr, *ahead = nullptr;
        int count = 0;  // 1, or as many as there are steps
    };
    Track(int nq, int na, int ns)
        : q(nq), velocity(na), torque(na), closed(ns), ahead(ns) {}
    void load(const Rows& rows, int steps) { rows_ = rows, steps_ = steps, done_ = 0; }
    bool advance();  // false at the end of the rows
    int done() const { return done_; }
    int left() const { return steps_ - done_; }

    // The present row.
    Reals q, velocity, torque;
    std::vector<std::uint8_t> closed, ahead;

private:
    Rows rows_;
    int steps_ = 0, done_ = 0;
};

// Readings through noise and delay. The noise of `block` steps is drawn at once.
class Sensors {
public:
    Sensors(int nq, int ns, int late, int force_stride, int block);
    struct Noise {
        Reals offset, tilt;  // (block, nq) and the turn of the base (block, 3) [rad]
        Reals gain, pull;    // on forces, (n, ns) and (n, ns, 3), for each reading of them
    };
    bool fits(size_t offset, size_t tilt, size_t gain, size_t pull) const {
        const size_t n = (block_ + force_stride_ - 1) / force_stride_;
        return offset == size_t(block_) * nq_ && tilt == size_t(3) * block_ &&
               gain >= n * ns_ && pull == 3 * gain;
    }
    void draw(Noise noise);
    bool feels() const { return step_ % force_stride_ == 0; }
    // `force` (ns, 3) is looked at where `feels`. Results are valid until the next call.
    void read(const double* qpos, const double* force);

    const double *q = nullptr, *force = nullptr;

private:
    int nq_, ns_, late_, force_stride_, block_;
    std::int64_t step_ = 0;
    Noise noise_;
    std::vector<Quat> turn_;
    bool turns_ = false;
    Reals now_, ring_;
};

// Contacts as physics lists them; strides in elements.
struct Contacts {
    int count = 0;
    const int *geom = nullptr, *address = nullptr;       // (count, 2), (count,)
    const double *frame = nullptr, *force = nullptr;     // (count, 9), rows of all constraints
    std::ptrdiff_t geom_stride = 0, address_stride = 0, frame_stride = 0;
};

// Contacts of the robot with the scene: of each the geoms of robot and scene, the
// normal force and the force on the robot in the world [N]. Elliptic cones.
class ContactForces {
public:
    static constexpr int kOther = -1, kScene = -2;  // rows of geoms that are no surface
    ContactForces(std::vector<int> row_of_geom, int ns)
        : surface(3 * ns, 0.0), row_(std::move(row_of_geom)) {}
    void update(const Contacts& contacts);
    int row(int geom) const {
        return geom >= 0 && geom < int(row_.size()) ? row_[geom] : kOther;
    }

    struct Touch { int robot, scene; double normal; Vec3 force; };
    std::vector<Touch> touches;
    Reals surface;      // (ns, 3) sums [N]
    double other = 0.0;  // sum of normal forces on what is no surface [N]

private:
    std::vector<int> row_;
};

}  // namespace clamber
