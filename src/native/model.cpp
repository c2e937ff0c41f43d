#include "model.h"

#include <algorithm>

namespace clamber {

bool Model::finish() {
    const int n = static_cast<int>(bodies.size());
    chain.assign(n, {});
    dof_body.assign(nv, 0);
    for (int b = 0; b < n; ++b) {
        const Body& body = bodies[b];
        if (body.parent > b || body.parent < 0 || (b > 0 && body.parent == b)) return false;
        if (b > 0) chain[b] = chain[body.parent];
        for (int j = body.first_joint; j < body.first_joint + body.joints; ++j) {
            const Joint& joint = joints[j];
            const int dofs = joint.kind == JointKind::Free   ? 6
                             : joint.kind == JointKind::Ball ? 3
                                                             : 1;
            for (int d = joint.dadr; d < joint.dadr + dofs; ++d) {
                if (d < 0 || d >= nv) return false;
                chain[b].push_back(d);
                dof_body[d] = b;
            }
        }
    }
    return true;
}

Kinematics::Kinematics(const Model& model)
    : model_(model),
      xpos_(model.bodies.size()),
      moment_(model.bodies.size()),
      jcom_(model.nv),
      submass_(model.bodies.size()),
      xquat_(model.bodies.size()),
      xmat_(model.bodies.size()),
      twist_(model.nv),
      geom_(model.geoms.size()),
      geom_local_(model.geoms.size()) {
    for (std::size_t g = 0; g < model.geoms.size(); ++g)
        geom_local_[g] = matrix(model.geoms[g].quat);
    for (std::size_t b = 0; b < model.bodies.size(); ++b) submass_[b] = model.bodies[b].mass;
    for (std::size_t b = model.bodies.size(); b-- > 1;)
        submass_[model.bodies[b].parent] += submass_[b];
}

void Kinematics::update(const double* q) {
    has_jcom_ = has_geom_ = false;
    const int n = static_cast<int>(model_.bodies.size());
    xpos_[0] = {};
    xquat_[0] = {};
    xmat_[0] = {};
    for (int b = 1; b < n; ++b) {
        const Body& body = model_.bodies[b];
        const Joint* joint = model_.joints.data() + body.first_joint;
        Vec3 x;
        Quat r;
        if (body.joints == 1 && joint->kind == JointKind::Free) {
            x = read3(q + joint->qadr);
            r = normalized(readq(q + joint->qadr + 3));
            const Mat3 R = matrix(r);
            for (int k = 0; k < 3; ++k) {
                Vec3 e;
                e[k] = 1.0;
                twist_[joint->dadr + k] = {{}, e};
                const Vec3 w = R.col(k);
                twist_[joint->dadr + 3 + k] = {w, cross(x, w)};
            }
        } else {
            x = xpos_[body.parent] + xmat_[body.parent] * body.pos;
            r = xquat_[body.parent] * body.quat;
            for (int j = 0; j < body.joints; ++j, ++joint) {
                const Mat3 R = matrix(r);
                const Vec3 anchor = x + R * joint->anchor, axis = R * joint->axis;
                if (joint->kind == JointKind::Slide) {
                    x += axis * (q[joint->qadr] - joint->zero);
                    twist_[joint->dadr] = {{}, axis};
                    continue;
                }
                if (joint->kind == JointKind::Hinge) {
                    r = r * axis_angle(joint->axis, q[joint->qadr] - joint->zero);
                    twist_[joint->dadr] = {axis, cross(anchor, axis)};
                } else {
                    r = r * normalized(readq(q + joint->qadr));
                }
                const Mat3 turned = matrix(r);
                x = anchor - turned * joint->anchor;
                if (joint->kind == JointKind::Ball)
                    for (int k = 0; k < 3; ++k) {
                        const Vec3 w = turned.col(k);
                        twist_[joint->dadr + k] = {w, cross(anchor, w)};
                    }
            }
            r = normalized(r);
        }
        xpos_[b] = x;
        xquat_[b] = r;
        xmat_[b] = matrix(r);
    }
    // Mass times position, summed over subtrees.
    for (int b = 0; b < n; ++b) {
        const Body& body = model_.bodies[b];
        moment_[b] = (xpos_[b] + xmat_[b] * body.ipos) * body.mass;
    }
    for (int b = n - 1; b > 0; --b) moment_[model_.bodies[b].parent] += moment_[b];
    com_ = moment_[model_.base] * (1.0 / submass_[model_.base]);
}

const Vec3* Kinematics::com_jacobian() {
    if (!has_jcom_) {
        has_jcom_ = true;
        const double share = 1.0 / submass_[model_.base];
        for (int d = 0; d < model_.nv; ++d) {
            const int b = model_.dof_body[d];
            const Twist& t = twist_[d];
            jcom_[d] = (t.v * submass_[b] + cross(t.w, moment_[b])) * share;
        }
    }
    return jcom_.data();
}

const Pose* Kinematics::geom_poses() {
    if (!has_geom_) {
        has_geom_ = true;
        for (std::size_t g = 0; g < geom_.size(); ++g) {
            const Geom& geom = model_.geoms[g];
            geom_[g] = {point(geom.body, geom.pos), xmat_[geom.body] * geom_local_[g]};
        }
    }
    return geom_.data();
}

const Touching& Kinematics::touching(int surface, int edge) const {
    const Surface& s = model_.surfaces[surface];
    return edge < 0 ? s.whole : s.edges[edge];
}

Vec3 Kinematics::contact_point(int surface, int edge, const Vec3& normal) const {
    const Surface& s = model_.surfaces[surface];
    return point(s.body, touching(surface, edge).centre) - normal * s.radius;
}

Vec3 Kinematics::flat_error(int surface, const Quat& R_WC) const {
    const Surface& s = model_.surfaces[surface];
    return rotation_vector(R_WC * conjugate(xquat_[s.body] * s.rotation));
}

Vec3 Kinematics::roll(int surface, const Vec3& normal, const Quat& link) const {
    const Surface& s = model_.surfaces[surface];
    const Vec3 turn = rotation_vector(conjugate(link) * xquat_[s.body]);
    return cross(xmat_[s.body] * turn, normal) * s.radius;
}

void integrate(const Model& model, const double* q, const double* v, double* out) {
    std::copy(q, q + model.nq, out);
    for (const Joint& j : model.joints) {
        const double* u = v + j.dadr;
        double* x = out + j.qadr;
        if (j.kind == JointKind::Hinge || j.kind == JointKind::Slide) {
            x[0] += u[0];
            continue;
        }
        if (j.kind == JointKind::Free) {
            for (int k = 0; k < 3; ++k) x[k] += u[k];
            x += 3;
            u += 3;
        }
        const Vec3 w = read3(u);
        const double angle = norm(w);
        const Quat turn = angle > 1e-15 ? axis_angle(w * (1.0 / angle), angle) : Quat{};
        const Quat r = normalized(readq(x) * turn);
        x[0] = r.w, x[1] = r.x, x[2] = r.y, x[3] = r.z;
    }
}

void difference(const Model& model, const double* a, const double* b, double* out) {
    for (const Joint& j : model.joints) {
        const double *p = a + j.qadr, *q = b + j.qadr;
        double* u = out + j.dadr;
        if (j.kind == JointKind::Hinge || j.kind == JointKind::Slide) {
            u[0] = q[0] - p[0];
            continue;
        }
        if (j.kind == JointKind::Free) {
            for (int k = 0; k < 3; ++k) u[k] = q[k] - p[k];
            p += 3, q += 3, u += 3;
        }
        write3(rotation_vector(conjugate(readq(p)) * readq(q)), u);
    }
}

Quat quat_from_matrix(const Mat3& R) {
    const double trace = R(0, 0) + R(1, 1) + R(2, 2);
    Quat q;
    if (trace > 0.0) {
        const double s = 0.5 / std::sqrt(trace + 1.0);
        q = {0.25 / s, (R(2, 1) - R(1, 2)) * s, (R(0, 2) - R(2, 0)) * s,
             (R(1, 0) - R(0, 1)) * s};
    } else if (R(0, 0) > R(1, 1) && R(0, 0) > R(2, 2)) {
        const double s = 2.0 * std::sqrt(1.0 + R(0, 0) - R(1, 1) - R(2, 2));
        q = {(R(2, 1) - R(1, 2)) / s, 0.25 * s, (R(0, 1) + R(1, 0)) / s,
             (R(0, 2) + R(2, 0)) / s};
    } else if (R(1, 1) > R(2, 2)) {
        const double s = 2.0 * std::sqrt(1.0 + R(1, 1) - R(0, 0) - R(2, 2));
        q = {(R(0, 2) - R(2, 0)) / s, (R(0, 1) + R(1, 0)) / s, 0.25 * s,
             (R(1, 2) + R(2, 1)) / s};
    } else {
        const double s = 2.0 * std::sqrt(1.0 + R(2, 2) - R(0, 0) - R(1, 1));
        q = {(R(1, 0) - R(0, 1)) / s, (R(0, 2) + R(2, 0)) / s, (R(1, 2) + R(2, 1)) / s,
             0.25 * s};
    }
    return normalized(q);
}

Mat3 frame_from_normal(const Vec3& normal, const Vec3& heading) {
    int least = 0;
    for (int k = 1; k < 3; ++k)
        if (std::abs(normal[k]) < std::abs(normal[least])) least = k;
    Vec3 axis, x = heading - normal * dot(heading, normal);
    axis[least] = 1.0;
    if (!(norm(x) >= 1e-9)) x = axis - normal * dot(axis, normal);
    x *= 1.0 / norm(x);
    const Vec3 y = cross(normal, x);
    return {{x.x, y.x, normal.x, x.y, y.y, normal.y, x.z, y.z, normal.z}};
}

}  // namespace clamber
