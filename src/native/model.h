// A robot in a scene: constants once, and kinematics of one configuration.
#pragma once

#include <array>
#include <limits>
#include <vector>

#include "geometry.h"
#include "linalg.h"

namespace clamber {

enum class JointKind : int { Free = 0, Ball = 1, Slide = 2, Hinge = 3 };

struct Joint {
    JointKind kind;
    int body, qadr, dadr;
    Vec3 axis, anchor;  // in the body's frame
    double zero;        // angle or way at which the body is where the model puts it
};

struct Body {
    int parent;
    Vec3 pos;  // in the parent's frame
    Quat quat;
    double mass;
    Vec3 ipos;  // centre of mass in its own frame
    int first_joint, joints;
};

struct Geom {
    int body;
    Vec3 pos;  // in the body's frame
    Quat quat;
    Shape shape;
};

// What touches a support: a ball, a face or an edge of it, in its body's frame.
struct Touching {
    Vec3 centre;
    int corners = 0;
    std::array<Vec3, 4> corner{};
};

struct Surface {
    int body;
    double radius;  // 0 for a flat surface
    bool flat;
    Quat rotation;  // of a flat surface in contact
    Touching whole;
    std::vector<Touching> edges;
    int mass_body;  // what its limb supports
    Vec3 mass_point;
};

struct Support {
    Vec3 position, normal, x, y;  // x, y span its plane
    double friction;
    int geom;
    std::vector<Vec3> A;  // half-planes A p <= b of its border, outward unit normals
    std::vector<double> b;

    double height(const Vec3& p) const { return dot(p - position, normal); }
};

struct Model {
    int nq = 0, nv = 0, base = 0;
    double mass = 0.0;
    double length_scale = 1.0;  // of planning's clearances and margins
    std::vector<Body> bodies;
    std::vector<Joint> joints;
    std::vector<Geom> geoms;
    std::vector<Surface> surfaces;
    std::vector<Support> supports;
    std::vector<std::array<int, 2>> pairs;
    // By surface and support: pairs of its planning geom, and of its further ones.
    std::vector<std::vector<std::array<std::vector<int>, 2>>> touching;
    std::vector<int> qadr, dadr;  // of the actuated joints
    std::vector<double> q_min, q_max, tau_max;
    std::vector<std::vector<int>> chain;  // by body: dofs that move it, ascending
    std::vector<int> dof_body;

    // Fill what follows from the rest; false where indices make no sense.
    bool finish();
};

// Dofs as twists about the world's origin: what moves a point p is v + w x p.
struct Twist {
    Vec3 w, v;
};

class Kinematics {
  public:
    explicit Kinematics(const Model& model);

    void update(const double* q);
    const Vec3& pos(int body) const { return xpos_[body]; }
    const Quat& quat(int body) const { return xquat_[body]; }
    const Mat3& rotation(int body) const { return xmat_[body]; }
    Vec3 point(int body, const Vec3& p) const { return xpos_[body] + xmat_[body] * p; }
    const Vec3& com() const { return com_; }
    const Twist& twist(int dof) const { return twist_[dof]; }
    // Column of the centre of mass's Jacobian; asks for all of them at first.
    const Vec3* com_jacobian();
    // Poses of all geoms, for distances.
    const Pose* geom_poses();
    // Where a surface, or an edge of it, touches a support with that normal.
    Vec3 contact_point(int surface, int edge, const Vec3& normal) const;
    const Touching& touching(int surface, int edge) const;
    // World rotation vector from a surface's frame to a contact frame.
    Vec3 flat_error(int surface, const Quat& R_WC) const;
    // How far a round surface's contact has rolled from where its link was.
    Vec3 roll(int surface, const Vec3& normal, const Quat& link) const;

    const Model& model() const { return model_; }

  private:
    const Model& model_;
    std::vector<Vec3> xpos_, moment_, jcom_;
    std::vector<double> submass_;
    std::vector<Quat> xquat_;
    std::vector<Mat3> xmat_;
    std::vector<Twist> twist_;
    std::vector<Pose> geom_;
    std::vector<Mat3> geom_local_;
    Vec3 com_;
    bool has_jcom_ = false, has_geom_ = false;
};

// (nq) q moved along the tangent vector v for unit time, and the vector from a to b.
void integrate(const Model&, const double* q, const double* v, double* out);
void difference(const Model&, const double* a, const double* b, double* out);
Quat quat_from_matrix(const Mat3& R);
// z along the normal, x along the heading as far as it can.
Mat3 frame_from_normal(const Vec3& normal, const Vec3& heading);

}  // namespace clamber
