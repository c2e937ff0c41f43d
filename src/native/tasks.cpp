#include "tasks.h"

#include <algorithm>

namespace clamber {

namespace {

constexpr double UNEVEN = 0.02;  // [m] more than what is kept from a top that was measured
const Vec3 UNIT[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};

// Whether a pair is as near as a contact is: that of its surface; over a support that is
// hardly uneven, of its whole link. Elsewhere what is beside the surface touches first.
bool is_at_contact(const Model& model, int pair, const SurfaceTask& t, bool uneven) {
    for (const auto& own : model.touching[t.surface][t.support])
        if (std::find(own.begin(), own.end(), pair) != own.end()) return true;
    const auto [a, b] = model.pairs[pair];
    const int support = model.supports[t.support].geom, body = model.surfaces[t.surface].body;
    if (uneven || (a != support && b != support)) return false;
    return model.geoms[a].body == body || model.geoms[b].body == body;
}

}  // namespace

Rows::Rows(const Model& model)
    : rough(model.pairs.size(), 0.0),
      told(model.pairs.size(), 0),
      soft(model.nv),
      closed(model.nv),
      kept(model.nv),
      model_(model) {}

void Rows::ask(const Problem& problem) {
    const std::size_t n = model_.pairs.size();
    counts.assign(n, 0);
    farthest = 0.02;
    for (std::size_t i = 0; i < n; ++i) {
        if (!std::isfinite(problem.clearance[i])) continue;
        counts[i] = 1;
        farthest = std::max(farthest, problem.clearance[i]);
    }
    apart_.assign(n, 0);
    apart_reach_ = 0.0;
    for (std::size_t i = 0; i < n; ++i) {
        if (!counts[i] || !(rough[i] > 0.0)) continue;
        bool touching = false;  // what was told keeps apart all the same
        for (const SurfaceTask& t : problem.tasks)
            touching = touching || (t.kind != TaskKind::Reaching && !told[i] &&
                                    is_at_contact(model_, int(i), t, rough[i] > UNEVEN));
        if (touching) continue;
        apart_[i] = 1;
        apart_reach_ = std::max(apart_reach_, problem.clearance[i] + rough[i]);
    }
}

void Rows::look(Kinematics& kin, Proximity& near, const Problem& problem, double reach) {
    soft.n = closed.n = kept.n = 0;
    soft.source_.clear();
    closed.source_.clear();
    kept.source_.clear();
    levers_.clear();
    keys.clear();
    violation = 0.0;
    for (const SurfaceTask& t : problem.tasks) contact(kin, t);
    for (const PointingTask& t : problem.pointing) point(kin, t);
    if (problem.turned && problem.base_weight > 0.0) {
        const Vec3 turn =
            rotation_vector(problem.base_rotation * conjugate(kin.quat(model_.base)));
        for (int k = 0; k < 3; ++k) {
            want(-turn[k], problem.base_weight);
            push(model_.base, {}, UNIT[k] * problem.base_weight);
        }
    }
    if (problem.over && problem.com_weight > 0.0)
        for (int k = 0; k < 2; ++k)
            want(kin.com()[k] - problem.com_target[k], problem.com_weight, UNIT[k]);
    if (problem.balance) balance(kin, problem);
    distances(kin, near, problem, reach);
}

void Rows::fill(Kinematics& kin) {
    const int nv = model_.nv;
    const Vec3* jcom = nullptr;
    for (Block* block : {&soft, &closed, &kept}) {
        block->J.resize(static_cast<std::size_t>(block->n) * nv);
        std::fill(block->J.begin(), block->J.end(), 0.0);
        for (int i = 0; i < block->n; ++i) {
            const Block::Source& s = block->source_[i];
            double* row = block->row(i);
            if (s.com.x != 0.0 || s.com.y != 0.0 || s.com.z != 0.0) {
                if (!jcom) jcom = kin.com_jacobian();
                for (int d = 0; d < nv; ++d) row[d] = dot(s.com, jcom[d]);
            }
            for (int k = s.first; k < s.first + s.count; ++k) {
                const Lever& l = levers_[k];
                for (const int d : model_.chain[l.body]) {
                    const Twist& t = kin.twist(d);
                    row[d] += dot(l.f, t.v) + dot(l.t, t.w);
                }
            }
        }
    }
}

void Rows::add(Block& block, double lo, double hi, const Vec3& com) {
    const std::size_t n = ++block.n;
    if (block.lo.size() < n) {
        block.lo.resize(2 * n);
        block.hi.resize(2 * n);
    }
    block.lo[n - 1] = lo;
    block.hi[n - 1] = hi;
    block.source_.push_back({static_cast<int>(levers_.size()), 0, com});
    open_ = &block;
}

void Rows::push(int body, const Vec3& f, const Vec3& t) {
    levers_.push_back({body, f, t});
    ++open_->source_.back().count;
}

void Rows::want(double e, double weight, const Vec3& com) {
    add(soft, e * weight, 0.0, com * weight);
}

void Rows::close(double e) {
    violation += e * e;
    add(closed, e, e);
}

void Rows::at_most(double room, const Vec3& com) {
    const double over = std::min(room, 0.0);
    violation += over * over;
    keys.push_back(static_cast<int>(model_.pairs.size() + keys.size()));
    add(kept, -FAR, room, com);
}

void Rows::inside(int support, const Vec3& p, int body, const Vec3& moves, const Vec3* at) {
    const Support& s = model_.supports[support];
    for (std::size_t i = 0; i < s.A.size(); ++i) {
        double border = s.b[i] - EDGE_INSET * model_.length_scale;
        if (at != nullptr) border = std::max(border, dot(s.A[i], *at));
        const double room = border - dot(s.A[i], p);
        if (!(room < EDGE_RANGE)) continue;
        at_most(room);
        pull(body, moves, s.A[i]);
    }
}

Vec3 edge_axis(const Model& model, const SurfaceTask& task) {
    const Surface& s = model.surfaces[task.surface];
    const Touching& edge = s.edges[task.edge];
    const Vec3 along =
        matrix(task.rotation) * tmul(matrix(s.rotation), edge.corner[1] - edge.corner[0]);
    return along * (1.0 / norm(along));
}

void Rows::contact(const Kinematics& kin, const SurfaceTask& task) {
    const Surface& s = model_.surfaces[task.surface];
    const Support& on = model_.supports[task.support];
    const Vec3& n = on.normal;
    const Vec3 p = kin.contact_point(task.surface, task.edge, n);
    const Vec3 centre = p + n * s.radius;
    const Vec3 turn = s.flat ? kin.flat_error(task.surface, task.rotation) : Vec3{};
    switch (task.kind) {
        case TaskKind::Closed: {
            Vec3 e = task.position - p, moves = centre;
            if (!s.flat && task.has_link) {
                e += kin.roll(task.surface, n, task.link);
                moves = p;  // it rolls: the material point moves with the link
            }
            for (int k = 0; k < 3; ++k) {
                close(e[k]);
                pull(s.body, moves, UNIT[k]);
            }
            for (int k = 0; s.flat && k < 3; ++k) {
                close(turn[k]);
                push(s.body, {}, UNIT[k]);
            }
            // One that lies near the border, as it slipped there, has no need to roll back.
            if (!s.flat && task.has_link)
                inside(task.support, p, s.body, centre, &task.position);
            break;
        }
        case TaskKind::OnEdge: {
            const Vec3 axis = edge_axis(model_, task);
            const Vec3 e = task.position - p;
            for (int k = 0; k < 3; ++k) {
                close(e[k]);
                pull(s.body, p, UNIT[k]);
            }
            for (const Vec3& across : {n, cross(n, axis)}) {
                close(dot(across, turn));
                push(s.body, {}, across);
            }
            want(-dot(axis, turn), FLAT_WEIGHT);  // it would rather lie flat
            push(s.body, {}, axis * FLAT_WEIGHT);
            break;
        }
        case TaskKind::Sliding: {
            close(-on.height(p));
            pull(s.body, centre, n);
            if (s.flat) {
                for (const Vec3& t : {on.x, on.y}) {
                    close(dot(t, turn));
                    push(s.body, {}, t);
                }
                want(-dot(n, turn), FLAT_WEIGHT);
                push(s.body, {}, n * FLAT_WEIGHT);
                for (int k = 0; k < s.whole.corners; ++k) {
                    const Vec3 corner = kin.point(s.body, s.whole.corner[k]);
                    inside(task.support, corner, s.body, corner);
                }
            } else {
                inside(task.support, p, s.body, centre);
                // As a task, room to slip before it is over the border.
                for (std::size_t i = 0; i < on.A.size(); ++i) {
                    const double room = on.b[i] - EDGE_ROOM * model_.length_scale - dot(on.A[i], p);
                    if (!(room < 0.0)) continue;
                    want(-room, EDGE_WEIGHT);
                    pull(s.body, centre, on.A[i] * EDGE_WEIGHT);
                }
            }
            if (task.reference > 0.0)
                for (const Vec3& t : {on.x, on.y}) {
                    want(dot(t, p - task.position), task.reference);
                    pull(s.body, centre, t * task.reference);
                }
            if (task.stability > 0.0) {
                const Vec3 mass = kin.point(s.mass_body, s.mass_point);
                const double weight = std::sqrt(2.0 * task.stability);
                for (int k = 0; k < 2; ++k) {
                    want(p[k] - mass[k], weight);
                    pull(s.body, centre, UNIT[k] * weight);
                    pull(s.mass_body, mass, UNIT[k] * -weight);
                }
            }
            break;
        }
        case TaskKind::Reaching: {
            for (int k = 0; k < 3; ++k) {
                want(p[k] - task.position[k], task.weight);
                pull(s.body, centre, UNIT[k] * task.weight);
            }
            for (int k = 0; s.flat && k < 3; ++k) {
                want(-turn[k], FLAT_WEIGHT * task.weight);
                push(s.body, {}, UNIT[k] * (FLAT_WEIGHT * task.weight));
            }
            break;
        }
    }
}

double opened(const Kinematics& kin, const SurfaceTask& task) {
    const Model& model = kin.model();
    const Surface& s = model.surfaces[task.surface];
    const Support& on = model.supports[task.support];
    const Vec3& n = on.normal;
    const Vec3 p = kin.contact_point(task.surface, task.edge, n);
    Vec3 turn = s.flat ? kin.flat_error(task.surface, task.rotation) : Vec3{};
    if (task.kind == TaskKind::Sliding) {
        double out = std::abs(on.height(p));
        for (std::size_t i = 0; i < on.A.size(); ++i)
            for (int k = 0; k < s.whole.corners; ++k) {
                const Vec3 corner = kin.point(s.body, s.whole.corner[k]) - n * s.radius;
                out = std::max(out, dot(on.A[i], corner) - on.b[i]);
            }
        return std::max(out, norm(turn - n * dot(turn, n)));
    }
    Vec3 gap = p - task.position;
    if (task.kind == TaskKind::OnEdge) {
        const Vec3 axis = edge_axis(model, task);
        turn -= axis * dot(turn, axis);
    } else if (!s.flat && task.has_link) {
        gap -= kin.roll(task.surface, n, task.link);
    }
    return std::max(norm(gap), norm(turn));
}

void Rows::point(const Kinematics& kin, const PointingTask& task) {
    Vec3 start[2], end[2], way;
    for (int k = 0; k < task.starts; ++k) {
        start[k] = kin.point(task.start_body[k], task.start[k]);
        way -= start[k] * (1.0 / task.starts);
    }
    for (int k = 0; k < task.ends; ++k) {
        end[k] = kin.point(task.end_body[k], task.end[k]);
        way += end[k] * (1.0 / task.ends);
    }
    const double length = norm(way);
    if (!(length > 0.0)) return;
    // The length is held still while a step is taken.
    const double scale = task.weight / length;
    for (int k = 0; k < 3; ++k) {
        want(way[k] / length - task.direction[k], task.weight);
        for (int i = 0; i < task.ends; ++i)
            pull(task.end_body[i], end[i], UNIT[k] * (scale / task.ends));
        for (int i = 0; i < task.starts; ++i)
            pull(task.start_body[i], start[i], UNIT[k] * (-scale / task.starts));
    }
}

void Rows::bearing(const Kinematics& kin, const Problem& problem) {
    bearing_.clear();
    places_.clear();
    for (const SurfaceTask& t : problem.tasks) {
        if (t.kind == TaskKind::Reaching || !t.loaded) continue;
        const Surface& s = model_.surfaces[t.surface];
        const Vec3& n = model_.supports[t.support].normal;
        const Touching& touching = kin.touching(t.surface, t.edge);
        const bool stays = s.flat && t.kind != TaskKind::Sliding;
        for (int k = 0; k < touching.corners; ++k) {
            // A ball's contact stays under its centre.
            const Vec3 centre = kin.point(s.body, touching.corner[k]);
            const Vec3 p = centre - n * s.radius;
            bearing_.push_back({stays ? -1 : s.body, centre});
            places_.push_back({p.x, p.y});
        }
    }
    support_polygon(reinterpret_cast<const double (*)[2]>(places_.data()),
                    static_cast<int>(places_.size()), polygon);
}

void Rows::balance(Kinematics& kin, const Problem& problem) {
    bearing(kin, problem);
    if (polygon.n == 0) return;
    const Vec3 com = kin.com();
    double A[Polygon::CAPACITY + 4][2], b[Polygon::CAPACITY + 4];
    const int edges = halfplanes(polygon, A, b);
    bool moves = false;
    for (const Bearing& x : bearing_) moves = moves || x.body >= 0;
    // The polygon's edges move with contacts that slide or roll: the distance of c from
    // the line through p and q changes by n'((1 - t) dp + t dq - dc), t the share of the
    // edge at which c lies abreast.
    const bool follows = moves && polygon.n == edges;
    int owner[Polygon::CAPACITY];
    for (int k = 0; follows && k < polygon.n; ++k) {
        double least = FAR;
        for (std::size_t i = 0; i < places_.size(); ++i) {
            const double gap = std::abs(polygon.v[k][0] - places_[i][0]) +
                               std::abs(polygon.v[k][1] - places_[i][1]);
            if (gap < least) least = gap, owner[k] = static_cast<int>(i);
        }
    }
    for (int k = 0; k < edges; ++k) {
        const Vec3 a{A[k][0], A[k][1], 0.0};
        at_most(b[k] - problem.balance_margin - dot(a, com), a);
        if (!follows) continue;
        const int next = (k + 1) % polygon.n;
        const double *p = polygon.v[k], *q = polygon.v[next];
        const double ex = q[0] - p[0], ey = q[1] - p[1];
        const double t = ((com.x - p[0]) * ex + (com.y - p[1]) * ey) / (ex * ex + ey * ey);
        const Bearing &from = bearing_[owner[k]], &to = bearing_[owner[next]];
        if (from.body >= 0) pull(from.body, from.centre, a * (t - 1.0));
        if (to.body >= 0) pull(to.body, to.centre, a * -t);
    }
    for (const Problem::Border& x : problem.borders) {
        const Vec3 a{x.x, x.y, 0.0};
        const double off = dot(a, com) - x.b;
        if (off > 0.0) want(off, BORDER_WEIGHT, a);
    }
    if (!problem.over && problem.com_weight > 0.0) {
        double middle[2] = {0.0, 0.0};
        for (int k = 0; k < polygon.n; ++k)
            for (int i = 0; i < 2; ++i) middle[i] += polygon.v[k][i];
        for (int i = 0; i < 2; ++i)
            want(com[i] - middle[i] / polygon.n, problem.com_weight, UNIT[i]);
    }
    if (problem.ellipse_weight > 0.0) {
        double gradient[2];
        const double off = excess(support_ellipse(polygon), com.x, com.y, gradient);
        if (off > 0.0) want(off, problem.ellipse_weight, {gradient[0], gradient[1], 0.0});
    }
}

void Rows::distances(Kinematics& kin, Proximity& near, const Problem& problem,
                     double reach) {
    const double farther = std::max(reach, apart_reach_);
    for (const auto& [pair, at] : near.query(kin.geom_poses(), farther, counts.data())) {
        const auto [a, b] = model_.pairs[pair];
        const int first = model_.geoms[a].body, second = model_.geoms[b].body;
        // The nearest points lie on one normal, about which turning moves neither along
        // it: one wrench serves both.
        const Vec3 t = cross(at.first, at.normal);
        if (at.distance < reach) {
            const double lacking = problem.clearance[pair] - at.distance;
            if (lacking > 0.0) violation += lacking * lacking;
            keys.push_back(pair);
            add(kept, lacking, FAR);
            push(second, at.normal, t);
            push(first, -at.normal, -t);
        }
        if (!apart_[pair]) continue;
        const double lacking = problem.clearance[pair] + rough[pair] - at.distance;
        if (!(lacking > 0.0)) continue;
        want(-lacking, ROUGHNESS_WEIGHT);
        push(second, at.normal * ROUGHNESS_WEIGHT, t * ROUGHNESS_WEIGHT);
        push(first, at.normal * -ROUGHNESS_WEIGHT, t * -ROUGHNESS_WEIGHT);
    }
}

}  // namespace clamber
