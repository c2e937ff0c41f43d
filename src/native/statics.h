// Static stability by forces: whether contacts within friction cones, and joints within
// torque limits, hold a posture, and how firmly. Friction cones are pyramids from inside.
#pragma once

#include <vector>

#include "linalg.h"
#include "qp.h"

namespace clamber {

constexpr double GRAVITY = 9.81;      // [m/s^2]
constexpr double BALANCE_TOL = 1e-6;  // wrench left over, in weights (and times a metre)
constexpr double PUSH_TOL = 1e-6;     // [weights] accuracy of the margin

struct ContactPointsView {
    int n = 0;
    const double (*points)[3] = nullptr;   // [m]
    const double (*normals)[3] = nullptr;  // unit, out of the supports
    const double* mu = nullptr;            // (n,) positive
    int cone_edges = 4;                    // of a pyramid
};

struct LoadView {
    double com[3] = {0.0, 0.0, 0.0};  // [m]
    double mass = 0.0;                // [kg]
    // Of the contacts about `com` [weights, and times a metre]; more where the robot moves.
    double wrench[6] = {0.0, 0.0, 1.0, 0.0, 0.0, 0.0};
};

// |g - J'f| <= limits, joint by joint; none where na is 0.
struct TorqueView {
    const double* jacobian = nullptr;  // (3 n, nv) of the contact points
    const double* gravity = nullptr;   // (nv,) holds the robot against gravity
    const int* dofs = nullptr;         // (na,) columns of the joints
    const double* limits = nullptr;    // (na,) [N m]
    int na = 0, nv = 0;
};

// Rotation whose last column is a unit normal: the smallest that takes the world's x there.
Mat3 contact_frame(const Vec3& normal);

// Edges (n * cone_edges) of the pyramids inside the friction cones, normal part 1.
void cone_generators(const ContactPointsView& contacts, double (*edges)[3]);

// What unit forces do: (6 + na, n * per) of their wrenches about `com` and torques of the
// joints, forces being `per` directions (n * per) of each point.
void load_rows(const ContactPointsView& contacts, const double* com, const TorqueView& torque,
               const double (*directions)[3], int per, double* rows);

// A workspace. Nothing it returns depends on what it was asked before. From no contacts, or
// what is no number, come no forces, a residual of 1 and a margin of -1.
class Statics {
public:
    // The least contact forces that hold the robot against gravity: see `contact_forces`
    // in statics.py. `price` (n,) or none; `forces` (n, 3) [N] or none. The norm of what
    // is left of the balance, in weights.
    double contact_forces(const ContactPointsView& contacts, const LoadView& load,
                          const TorqueView& torque, const double* price,
                          double (*forces)[3]);

    double residual(const ContactPointsView& contacts, const LoadView& load,
                    const TorqueView& torque) {
        return contact_forces(contacts, load, torque, nullptr, nullptr);
    }

    // The largest horizontal push [weights] that the stance holds in every direction, at
    // most 1; negative: the least without which it falls, -1 where none helps. `yields`
    // (n + na): how fast points and joints give way to the weakest push.
    double push_margin(const ContactPointsView& contacts, const LoadView& load,
                       const TorqueView& torque, double* yields) {
        double outward[2];
        return least_room(contacts, load, torque, false, yields, outward);
    }

    // How far the centre of mass may lie elsewhere [m], horizontally, in every direction;
    // negative: how far it has to, -1 where no place would do. `outward` (2): unit vector
    // in the direction in which that is least.
    double com_room(const ContactPointsView& contacts, const LoadView& load,
                    const TorqueView& torque, double* outward) {
        std::vector<double> yields(contacts.n + torque.na);
        return least_room(contacts, load, torque, true, yields.data(), outward);
    }

    // Whether forces within the friction cones balance gravity.
    bool is_stable(const ContactPointsView& contacts, const double* com);

private:
    // The largest push [weights], or displacement of the weight [m], in the worst direction.
    double least_room(const ContactPointsView& contacts, const LoadView& load,
                      const TorqueView& torque, bool moves, double* yields, double* outward);
    static double* zeroed(std::vector<double>& buffer, std::size_t size) {
        buffer.assign(size, 0.0);
        return buffer.data();
    }
    // Balance and torques in weights: constraints from `first` on, in the order of
    // `load_rows`.
    void bound_rows(const LoadView& load, const TorqueView& torque, int first);
    // How far the solution is beyond the bounds of a row of A.
    double left_over(const QP& qp, int row) const;

    QPSolver solver_;
    std::vector<double> H_, c_, A_, upper_, lower_, rho_, directions_, rows_;
    std::vector<int> sense_;
};

}  // namespace clamber
