#include "robot.h"

#include <cmath>

namespace clamber::fuzz {

Vec3 vector(Random& random, double scale) {
    return {random.number(scale), random.number(scale), random.number(scale)};
}

Quat turn(Random& random) {
    const Quat q{random.number(), random.number(), random.number(), random.number()};
    return random.mood == Mood::WILD ? q : normalized(q);
}

namespace {

void add_body(Random& random, Model& m) {
    const bool is_base = m.bodies.size() == 1;
    const JointKind kind = is_base               ? JointKind::Free
                           : random.one_in(12)   ? JointKind::Ball
                           : random.one_in(8)    ? JointKind::Slide
                                                 : JointKind::Hinge;
    const int parent = is_base ? 0 : random.between(1, static_cast<int>(m.bodies.size()) - 1);
    const int body = static_cast<int>(m.bodies.size());
    m.bodies.push_back({parent, vector(random, 0.3), turn(random), random.size(5.0),
                        vector(random, 0.1), static_cast<int>(m.joints.size()), 1});
    Vec3 axis = vector(random, 1.0);
    if (random.mood != Mood::WILD) axis = axis * (1.0 / std::max(norm(axis), 1e-9));
    m.joints.push_back({kind, body, m.nq, m.nv, axis, vector(random, 0.05), random.number(0.5)});
    if (kind == JointKind::Hinge) {
        m.qadr.push_back(m.nq);
        m.dadr.push_back(m.nv);
        const double low = random.number(2.0);
        m.q_min.push_back(low);
        m.q_max.push_back(random.mood == Mood::WILD ? random.number(2.0)
                                                    : low + random.size(3.0));
        m.tau_max.push_back(random.size(80.0));
    }
    m.nq += kind == JointKind::Free ? 7 : kind == JointKind::Ball ? 4 : 1;
    m.nv += kind == JointKind::Free ? 6 : kind == JointKind::Ball ? 3 : 1;
}

void add_geom(Random& random, Model& m, int body, ShapeKind kind) {
    std::vector<Vec3> hull;
    for (int i = 0; kind == ShapeKind::Convex && i < random.between(0, 9); ++i)
        hull.push_back(vector(random, 0.1));
    const Vec3 size{random.size(0.1), random.size(0.1), random.size(0.1)};
    m.geoms.push_back({body, body ? vector(random, 0.1) : Vec3{}, body ? turn(random) : Quat{},
                       make_shape(kind, size, std::move(hull))});
}

void add_support(Random& random, Model& m, double height) {
    Support s;
    s.position = {0.0, 0.0, height};
    s.normal = {0.0, 0.0, 1.0};
    if (random.one_in(3)) s.normal = vector(random, 1.0);
    if (random.mood != Mood::WILD) s.normal = s.normal * (1.0 / std::max(norm(s.normal), 1e-9));
    const Mat3 R = frame_from_normal(s.normal, {1.0, 0.0, 0.0});
    s.x = R.col(0);
    s.y = R.col(1);
    s.friction = random.size(1.2);
    s.geom = static_cast<int>(m.supports.size());
    const int edges = random.between(0, 5);
    for (int k = 0; k < edges; ++k) {
        const double a = 2.0 * M_PI * k / edges;
        s.A.push_back(s.x * std::cos(a) + s.y * std::sin(a));
        s.b.push_back(random.size(0.6));
    }
    m.supports.push_back(std::move(s));
}

void add_surface(Random& random, Model& m) {
    Surface s{};
    s.body = random.between(1, static_cast<int>(m.bodies.size()) - 1);
    s.flat = random.one_in(2);
    s.radius = s.flat ? 0.0 : random.size(0.05);
    s.whole.centre = vector(random, 0.1);
    s.whole.corners = s.flat ? 4 : 1;
    for (int k = 0; k < s.whole.corners; ++k) s.whole.corner[k] = vector(random, 0.1);
    if (!s.flat) s.whole.corner[0] = s.whole.centre;
    for (int k = 0; s.flat && k < 4; ++k) {
        Touching edge;
        edge.corners = 2;
        edge.corner[0] = s.whole.corner[k];
        edge.corner[1] = s.whole.corner[(k + 1) % 4];
        edge.centre = (edge.corner[0] + edge.corner[1]) * 0.5;
        s.edges.push_back(edge);
    }
    s.rotation = turn(random);
    s.mass_body = random.between(1, static_cast<int>(m.bodies.size()) - 1);
    s.mass_point = vector(random, 0.1);
    m.surfaces.push_back(std::move(s));
}

}  // namespace

Model robot(Random& random) {
    Model m;
    m.bodies.push_back({0, {}, {}, 0.0, {}, 0, 0});
    const int bodies = random.between(1, 8);
    for (int i = 0; i < bodies; ++i) add_body(random, m);
    m.base = 1;
    m.mass = random.size(40.0);
    add_geom(random, m, 0, ShapeKind::Plane);
    add_geom(random, m, 0, ShapeKind::Box);
    for (int b = 1; b <= bodies; ++b)
        add_geom(random, m, b, static_cast<ShapeKind>(random.between(1, 6)));
    const int geoms = static_cast<int>(m.geoms.size());
    for (int a = 0; a < geoms; ++a)
        for (int b = std::max(a + 1, 2); b < geoms; ++b)
            if (random.one_in(2)) m.pairs.push_back({a, b});
    for (int k = 0; k < 2; ++k) add_support(random, m, 0.3 * k);
    const int surfaces = random.between(1, 4);
    for (int k = 0; k < surfaces; ++k) add_surface(random, m);
    m.touching.assign(surfaces, std::vector<std::array<std::vector<int>, 2>>(2));
    for (int i = 0; i < static_cast<int>(m.pairs.size()); ++i)
        for (int k = 0; k < surfaces; ++k)
            if (m.pairs[i][0] < 2 && m.geoms[m.pairs[i][1]].body == m.surfaces[k].body)
                m.touching[k][m.pairs[i][0]][random.below(2)].push_back(i);
    Outcome::expect(m.finish(), "a tree of bodies is one");
    return m;
}

std::vector<double> posture(Random& random, const Model& m) {
    std::vector<double> q(m.nq);
    for (double& x : q) x = random.number();
    return q;
}

Answer with_answer(Random& random, Model& m) {
    Answer answer{posture(random, m), {}};
    Quat turned = normalized({answer.q[3], answer.q[4], answer.q[5], answer.q[6]});
    for (int i = 0; i < 4; ++i) answer.q[3 + i] = (&turned.w)[i];
    for (std::size_t i = 0; i < m.qadr.size(); ++i) {
        answer.q[m.qadr[i]] = random.uniform(m.q_min[i], m.q_max[i]);
        m.tau_max[i] += 1e4;
    }
    m.pairs.clear();
    m.touching.assign(m.surfaces.size(), std::vector<std::array<std::vector<int>, 2>>(2));
    Kinematics kin(m);
    kin.update(answer.q.data());
    for (int k = 0; k < 2 && k < static_cast<int>(m.surfaces.size()); ++k) {
        const Surface& surface = m.surfaces[k];
        Support& support = m.supports[k];
        const Mat3 R = surface.flat ? matrix(kin.quat(surface.body) * surface.rotation)
                                    : frame_from_normal({0.0, 0.0, 1.0}, {1.0, 0.0, 0.0});
        support = {{}, R.col(2), R.col(0), R.col(1), 1.0, support.geom, {}, {}};
        support.position = kin.contact_point(k, -1, support.normal);
        Contact c;
        c.surface = c.support = k;
        c.has_link = !surface.flat;
        c.position = support.position;
        c.quaternion = quat_from_matrix(R);
        c.link = kin.quat(surface.body);
        answer.contacts.push_back(c);
    }
    return answer;
}

Contact contact(Random& random, const Model& m) {
    Contact c;
    c.surface = random.below(static_cast<int>(m.surfaces.size()));
    c.support = random.below(2);
    if (m.surfaces[c.surface].flat && random.one_in(4)) c.edge = random.below(4);
    c.has_link = random.one_in(2);
    c.position = vector(random, 0.5);
    c.quaternion = turn(random);
    c.link = turn(random);
    return c;
}

}  // namespace clamber::fuzz
