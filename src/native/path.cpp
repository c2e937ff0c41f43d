#include "path.h"

namespace clamber {

namespace {

constexpr double SAFE_HEIGHT = 0.05;  // [m] h_safe of (4.29)
constexpr double TOP_RISE = 0.05;     // [m] both ends on top: the apex is so much higher
constexpr int ARC_POINTS = 12;        // control points of an arc, its ends included
constexpr int BRIDGE_POINTS = 3;      // at most, where nothing moves far
constexpr double BRIDGE_STEP = 0.1;   // [rad, m] of the way from one to the next
constexpr double ARC_WEIGHT = 20.0;            // of the arc ...
constexpr double SWING_POSTURE_WEIGHT = 3.0;  // ... against posture, and constraints
constexpr double SWING_COM_WEIGHT = 20.0;  // of the straight way of the centre of mass
constexpr double TURNED = 0.6;  // share of a swing after which a sole lies as it will
constexpr double LOOSE_ARC_WEIGHT = 1.0;  // ... where a gap is halved, against posture 1
constexpr int NODE_ITERATIONS = 25;
constexpr double NODE_STEP = 0.01;     // [rad] a shorter last step leaves nothing to mend
constexpr double BRIDGE_MARGIN = 0.025;  // [m] of the centre of mass on the way, as of a swing
constexpr double DRIFT_TOL = 0.002;     // [m] contacts that drift by more refine a gap
constexpr double OVERLAP_TOL = 0.001;   // [m] links that enter others by more refine it
constexpr int MAX_REFINEMENTS = 4;       // halvings between two postures
constexpr double ENDS = 5.0;  // a swing's first and last fifth: supports may be touched
constexpr double REACH_ANGLE = 25.0 * M_PI / 180.0;  // phi of (4.27)
constexpr double LEAN_WEIGHT = 0.5;                  // soft task (4.27)
constexpr double STANCE_WEIGHT = 0.08;               // of the preferred posture
constexpr double STRAINED = 0.6;  // share of a torque: it may give way on the way, too
constexpr int MAX_BORDERS = 4;  // of torques, about the centre of mass of a posture

// Contacts that stay closed in each phase: shift, swing, settle.
std::array<std::vector<Contact>, 3> closed_contacts(const Transition& t) {
    std::array<std::vector<Contact>, 3> out{t.held, t.held, t.held};
    out[0].insert(out[0].end(), t.rolling.begin(), t.rolling.end());
    if (t.makes) out[2].push_back(t.made);
    return out;
}

}  // namespace

double highest(const Support& s, const Vec3& p1, const Vec3& p2) {
    if (s.normal.z >= 1.0) return s.position.z;
    constexpr int n = 4 * ARC_POINTS;
    double out = -FAR;
    for (int i = 0; i < n; ++i) {
        Vec3 p = p1 + (p2 - p1) * (static_cast<double>(i) / (n - 1));
        p.z -= s.height(p) / s.normal.z;
        bool in = true;
        for (std::size_t k = 0; k < s.A.size(); ++k) in = in && dot(s.A[k], p) <= s.b[k];
        if (in) out = std::max(out, p.z);
    }
    return out > -FAR ? out : s.position.z;
}

SurfaceTask closed_task(const Model& model, const Contact& c) {
    SurfaceTask t;
    t.kind = c.edge < 0 ? TaskKind::Closed : TaskKind::OnEdge;
    t.surface = c.surface;
    t.support = c.support;
    t.edge = c.edge;
    t.has_link = c.has_link;
    t.position = c.position;
    t.link = c.link;
    t.rotation = quat_from_matrix(frame_from_normal(model.supports[c.support].normal,
                                                    matrix(c.quaternion).col(0)));
    return t;
}

void arc(const Vec3& p1, const Vec3& p2, double top, bool on_top, int points,
         double scale, std::vector<Vec3>& out) {
    double apex =
        std::max(0.5 * (p1.z + p2.z) + 0.5 * norm(p1 - p2), top + SAFE_HEIGHT * scale);
    if (on_top) apex = std::min(apex, std::max(p1.z, p2.z) + TOP_RISE * scale + SAFE_HEIGHT * scale);
    // Parabola with the given maximum: z = z1 (1-s) + z2 s + 4 c s (1-s). The limb leaves
    // and comes down upright, so that it meets a top that is higher or lower where it should.
    const double a = apex - p1.z, b = apex - p2.z;
    double c = 0.0;
    if (a > 0.0 && b > 0.0) {
        const double root = std::sqrt(a) + std::sqrt(b);
        c = 0.25 * root * root;
    }
    const int n = std::max(points, 5);
    out.resize(n);
    for (int i = 0; i < n; ++i) {
        const double s = static_cast<double>(i) / (n - 1);
        out[i] = p1 + (p2 - p1) * (s * s * (3.0 - 2.0 * s));
        out[i].z = p1.z + (p2.z - p1.z) * s + 4.0 * c * s * (1.0 - s);
    }
}

PathPlanner::PathPlanner(const Model& model)
    : solver(model), model_(model), holding_(model), tangent_(model.nv), reference_(model.nq) {}

void PathPlanner::ask_balance(const std::vector<Contact>& loaded,
                              const std::vector<Contact>& unloaded, double margin,
                              double posture_weight) {
    Problem& p = problem_;
    p = Problem{};
    p.balance_margin = margin;
    p.posture_weight = posture_weight;
    p.ellipse_weight = ELLIPSE_WEIGHT;
    p.com_weight = COM_WEIGHT;
    p.clearance.assign(model_.pairs.size(), CLEARANCE * model_.length_scale);
    const double nothing = -std::numeric_limits<double>::infinity();
    for (const auto* contacts : {&loaded, &unloaded}) {
        for (const Contact& c : *contacts) {
            p.tasks.push_back(closed_task(model_, c));
            p.tasks.back().loaded = contacts == &loaded;
            const auto& [planned, further] = model_.touching[c.surface][c.support];
            for (const int i : further) p.clearance[i] = FURTHER_CLEARANCE * model_.length_scale;
            for (const int i : planned) p.clearance[i] = c.edge >= 0 ? 0.0 : nothing;
        }
    }
}

void PathPlanner::between(const std::vector<double>& a, const std::vector<double>& b,
                          double share, std::vector<double>& out) {
    difference(model_, a.data(), b.data(), tangent_.data());
    for (double& d : tangent_) d *= share;
    out.resize(model_.nq);
    integrate(model_, a.data(), tangent_.data(), out.data());
}

void PathPlanner::solve_node(const std::vector<double>& from,
                             const std::vector<double>& other, std::vector<double>& q) {
    solver.solve(problem_, from.data(), NODE_ITERATIONS, NODE_STEP, first_);
    if (!first_.residuals.solved()) {
        solver.solve(problem_, other.data(), MAX_ITERATIONS, STEP_TOL, second_);
        if (second_.residuals.worst() < first_.residuals.worst()) std::swap(first_, second_);
    }
    q = first_.q;
}

void PathPlanner::bridge(const std::vector<double>& a, const std::vector<double>& b,
                         const std::vector<Contact>& contacts, Postures& out) {
    ask_balance(contacts, {}, BRIDGE_MARGIN * model_.length_scale, 1.0);
    problem_.ellipse_weight = problem_.com_weight = 0.0;
    difference(model_, a.data(), b.data(), tangent_.data());
    double way = 0.0;
    for (const double d : tangent_) way = std::max(way, std::abs(d));
    const int points = way < BRIDGE_STEP * BRIDGE_POINTS ? static_cast<int>(way / BRIDGE_STEP)
                                                         : BRIDGE_POINTS;
    std::vector<double> middle;
    const auto node = [&](double share, const std::vector<double>& last, bool halves,
                          std::vector<double>& q) {
        if (halves)
            middle = last;
        else
            between(a, b, share, middle);
        problem_.q_reference = middle;
        solve_node(middle, last, q);
    };
    fill(a, b, points + 2, contacts, {}, true, node, out);
}

// Let clearances grow from, and shrink to, what the end postures have: at lift-off and
// touch-down the limb is as near to the supports as they are, and asking for the full
// distance at once would tear it off them sideways.
void PathPlanner::near_ends(const Transition& t) {
    const double clearance = CLEARANCE * model_.length_scale;
    std::vector<unsigned char> counts(model_.pairs.size());
    for (std::size_t i = 0; i < counts.size(); ++i) counts[i] = std::isfinite(clearance_[i]);
    for (int k = 0; k < 2; ++k) {
        ends_[k].clear();
        solver.kin.update(k == 0 ? t.shifted.data() : t.touching.data());
        for (const auto& [pair, at] :
             solver.near.query(solver.kin.geom_poses(), clearance, counts.data()))
            ends_[k].push_back({pair, std::min(std::max(at.distance, 0.0), clearance)});
    }
}

void PathPlanner::swing_node(const Transition& t, const std::vector<Vec3>& control,
                             double share, const std::vector<double>& last, bool halves,
                             std::vector<double>& q) {
    const int n = static_cast<int>(control.size());
    const double x = share * (n - 1);
    const int i = std::min(static_cast<int>(x), n - 2);
    SurfaceTask& reach = problem_.tasks.back();
    reach.position = control[i] + (control[i + 1] - control[i]) * (x - i);
    reach.weight = halves ? LOOSE_ARC_WEIGHT : ARC_WEIGHT;
    const double left = std::max(1.0 - share / TURNED, 0.0) * norm(turn_);
    reach.rotation = left > 0.0 ? axis_angle(turn_ * (1.0 / norm(turn_)), -left) * made_rotation_
                                : made_rotation_;
    problem_.posture_weight = halves ? 1.0 : SWING_POSTURE_WEIGHT;
    for (int k = 0; k < 2; ++k)
        problem_.com_target[k] = com_[0][k] + share * (com_[1][k] - com_[0][k]);
    // From where the last posture is, not back to the way that the arc has left: joints
    // would turn to and fro, and a foot be drawn through an edge.
    const double step = 1.0 / (n - 1);
    if (halves)
        reference_ = last;
    else
        between(last, t.touching, step / (1.0 - share + step), reference_);
    problem_.q_reference = reference_;
    if (!t.adapt) {
        std::fill(problem_.clearance.begin(), problem_.clearance.end(),
                  -std::numeric_limits<double>::infinity());
        solver.solve(problem_, last.data(), NODE_ITERATIONS, STEP_TOL, first_);
        q = first_.q;
        return;
    }
    problem_.clearance = clearance_;
    const double ramp = std::min(1.0, std::min(ENDS * share, ENDS * (1.0 - share)));
    if (ramp < 1.0)
        for (const Eased& e : ends_[share < 0.5 ? 0 : 1]) {
            const double eased = e.distance * (1.0 - ramp) + ramp * CLEARANCE * model_.length_scale;
            problem_.clearance[e.pair] = std::min(problem_.clearance[e.pair], eased);
        }
    solve_node(last, reference_, q);
    if (!strained_ || static_cast<int>(problem_.borders.size()) >= MAX_BORDERS) return;
    if (look(t.held, q.data()).has_room(t.margin)) return;
    border();
    solve_node(q, reference_, q);
}

void PathPlanner::swing(const Transition& t, Path& out) {
    out.control.clear();
    if (!t.makes) {
        bridge(t.shifted, t.touching, t.held, out.phases[1]);
        return;
    }
    const Support& support = model_.supports[t.made.support];
    solver.kin.update(t.shifted.data());
    const Vec3 p1 = solver.kin.contact_point(t.made.surface, -1, support.normal);
    bool slides = false;
    for (const Contact& c : t.rolling)
        slides = slides || (c.surface == t.made.surface && c.support == t.made.support);
    arc(p1, t.made.position, highest(support, p1, t.made.position), slides, ARC_POINTS,
        model_.length_scale, out.control);
    ask_balance(t.held, {}, t.margin, SWING_POSTURE_WEIGHT);
    strained_ = false;
    for (const auto* q : {&t.shifted, &t.touching}) {
        strained_ = strained_ || look(t.held, q->data()).strain() > STRAINED;
        if (strained_ && !holding_.has_room(t.margin)) border();
    }
    SurfaceTask reach = closed_task(model_, t.made);
    reach.kind = TaskKind::Reaching;
    reach.edge = -1;
    problem_.tasks.push_back(reach);
    made_rotation_ = reach.rotation;
    problem_.over = true;
    problem_.com_weight = SWING_COM_WEIGHT;
    for (int k = 0; k < 2; ++k) {
        solver.kin.update(k == 0 ? t.shifted.data() : t.touching.data());
        com_[k] = solver.kin.com();
        if (k == 0 && model_.surfaces[t.made.surface].flat)
            turn_ = solver.kin.flat_error(t.made.surface, made_rotation_);
        else if (k == 0)
            turn_ = {};
    }
    clearance_ = problem_.clearance;
    near_ends(t);
    std::vector<Contact> moving = t.rolling;
    moving.push_back(t.made);
    const auto node = [&](double share, const std::vector<double>& last, bool halves,
                          std::vector<double>& q) {
        swing_node(t, out.control, share, last, halves, q);
    };
    fill(t.shifted, t.touching, static_cast<int>(out.control.size()), t.held, moving,
         t.adapt, node, out.phases[1]);
}

// Postures from a to b, closer together where it matters: a gap is halved while, in its
// middle, a contact has drifted or links overlap. The posture put there is the nearest to
// the middle that satisfies the constraints: where the limb must pause while the trunk
// rises, the way leaves the arc. No posture is mended later: the first of a swing that
// `check` will not pass ends it, and is followed by the last.
template <typename Fill>
void PathPlanner::fill(const std::vector<double>& a, const std::vector<double>& b,
                       int points, const std::vector<Contact>& contacts,
                       const std::vector<Contact>& moving, bool refine, Fill node,
                       Postures& out) {
    watch(contacts, {}, aloft_);
    watch(contacts, moving, low_);
    std::vector<Node> nodes{{0.0, a}}, finer;
    bool passes = true;
    const auto put = [&](double share, const std::vector<double>& last, bool halves,
                         std::vector<Node>& to) {
        Node next{share, {}};
        node(share, last, halves, next.q);
        // Where the solver is content, so is `check`.
        if (refine && !moving.empty() && !first_.residuals.solved())
            passes = overlap(next.q.data(), low_, nullptr) <= OVERLAP_LIMIT &&
                     drift(contacts) <= DRIFT_LIMIT;
        to.push_back(std::move(next));
    };
    for (int i = 1; i < points - 1 && passes; ++i)
        put(static_cast<double>(i) / (points - 1), nodes.back().q, false, nodes);
    nodes.push_back({1.0, b});
    std::vector<double> middle;
    for (int round = 0; refine && passes && round < MAX_REFINEMENTS; ++round) {
        finer.assign(1, nodes[0]);
        for (std::size_t i = 0; i + 1 < nodes.size() && passes; ++i) {
            between(nodes[i].q, nodes[i + 1].q, 0.5, middle);
            const double share = 0.5 * (nodes[i].share + nodes[i + 1].share);
            const bool inner = ENDS * std::min(share, 1.0 - share) >= 1.0;
            const double depth = overlap(middle.data(), inner ? aloft_ : low_, nullptr);
            if (drift(contacts) > DRIFT_TOL || depth > OVERLAP_TOL)
                put(share, middle, true, finer);
            finer.push_back(passes ? nodes[i + 1] : nodes.back());
        }
        if (finer.size() == nodes.size()) break;
        nodes.swap(finer);
    }
    out.clear();
    for (Node& n : nodes) out.push_back(std::move(n.q));
}

void PathPlanner::watch(const std::vector<Contact>& contacts,
                        const std::vector<Contact>& more,
                        std::vector<unsigned char>& out) const {
    out.assign(model_.pairs.size(), 1);
    for (const auto* list : {&contacts, &more})
        for (const Contact& c : *list)
            for (const auto& pairs : model_.touching[c.surface][c.support])
                for (const int i : pairs) out[i] = 0;
}

// Deepest overlap at q among the watched pairs; leaves the kinematics at q.
double PathPlanner::overlap(const double* q, const std::vector<unsigned char>& watched,
                            int* pair) {
    solver.kin.update(q);
    double deepest = 0.0;
    for (const auto& [i, at] :
         solver.near.query(solver.kin.geom_poses(), 0.0, watched.data()))
        if (-at.distance > deepest) {
            deepest = -at.distance;
            if (pair) *pair = i;
        }
    return deepest;
}

// Largest distance of a contact from its place, at the posture the kinematics are at.
double PathPlanner::drift(const std::vector<Contact>& contacts) {
    double out = 0.0;
    for (const Contact& c : contacts) {
        const Vec3& n = model_.supports[c.support].normal;
        Vec3 gap = solver.kin.contact_point(c.surface, c.edge, n) - c.position;
        if (c.has_link && model_.surfaces[c.surface].radius > 0.0)
            gap -= solver.kin.roll(c.surface, n, c.link);
        out = std::max(out, norm(gap));
    }
    return out;
}

Holding& PathPlanner::look(const std::vector<Contact>& contacts, const double* q) {
    solver.kin.update(q);
    holding_.look(solver.kin, contacts);
    return holding_;
}

bool PathPlanner::is_stable(const std::vector<Contact>& contacts, const double* q) {
    return look(contacts, q).residual() <= BALANCE_TOL;
}

void PathPlanner::holding_torques(const std::vector<Contact>& contacts,
                                  const double* price, const double* q,
                                  const double* inertia, double* tau) {
    Holding& held = look(contacts, q);
    if (inertia) held.add(solver.kin, inertia);
    held.torques(price, tau);
}

// Overlaps and contacts at all postures of a phase and half-way between, solver aside.
// Whether the contacts hold the robot at the postures of a swing, too: those at its ends
// have been looked at, and while weight shifts more contacts bear.
bool PathPlanner::check_phase(const Transition& t, const std::vector<Contact>& contacts,
                              int k, Path& out) {
    std::vector<Contact> moving = t.rolling;
    if (t.makes) moving.push_back(t.made);
    watch(contacts, moving, low_);
    std::vector<double> middle;
    const Postures& nodes = out.phases[k];
    for (std::size_t i = 0; i + 1 < nodes.size(); ++i) {
        between(nodes[i], nodes[i + 1], 0.5, middle);
        const double* const looked_at[2] = {middle.data(), nodes[i + 1].data()};
        for (const double* const q : looked_at) {
            int pair = -1;
            const double depth = overlap(q, low_, &pair);
            if (depth > out.depth) {
                out.depth = depth;
                out.pair = pair;
                out.phase = k;
            }
            const double open = drift(contacts);
            if (open > DRIFT_LIMIT) {
                out.status = Path::Status::Opens;
                out.depth = open;
                out.phase = k;
                return false;
            }
        }
        if (k == 1 && out.weak.empty() && !is_stable(t.held, nodes[i + 1].data()))
            out.weak = nodes[i + 1];
    }
    if (out.depth > OVERLAP_LIMIT)
        out.status = Path::Status::Overlaps;
    else if (!out.weak.empty())
        out.status = Path::Status::Weak;
    return out.status == Path::Status::Solved;
}

void PathPlanner::check(const Transition& t, Path& out) {
    out.forget();
    const auto contacts = closed_contacts(t);
    for (int k = 0; k < 3; ++k)
        if (!check_phase(t, contacts[k], k, out) && out.status == Path::Status::Opens) return;
}

Vec3 lean_direction(const Vec3& p1, const Vec3& p2, const Mat3& R_WB) {
    const Vec3 way = p1 - p2;
    const double length = norm(way);
    Vec3 angles;
    if (length > 1e-9) angles = tmul(R_WB, way * (1.0 / length)) * REACH_ANGLE;
    Vec3 lean = R_WB * Vec3{angles.x, angles.y, 0.0};
    lean.z = 0.0;
    const double angle = norm(lean);
    lean *= std::sin(angle) / std::max(angle, 1e-9);
    lean.z = std::sqrt(std::max(1.0 - square(lean), 0.0));
    return lean;
}

Contact PathPlanner::rolled(const Contact& c, const Vec3& towards, const double* q) {
    const Surface& s = model_.surfaces[c.surface];
    Contact out = c;
    if (s.edges.empty() || c.edge >= 0) return out;
    solver.kin.update(q);
    double farthest = -FAR;
    for (int i = 0; i < static_cast<int>(s.edges.size()); ++i) {
        const Vec3& normal = model_.supports[c.support].normal;
        const Vec3 p = solver.kin.contact_point(c.surface, i, normal);
        const double along = dot(p, towards - c.position);
        if (!(along > farthest)) continue;
        farthest = along;
        out.edge = i;
        out.position = p;
    }
    return out;
}

// Where the torques that are counted on give way first, at what was looked at last.
double PathPlanner::border() {
    double outward[2];
    const double room = holding_.room(outward);
    const Vec3 com = solver.kin.com();
    const double most = outward[0] * com.x + outward[1] * com.y + room;
    problem_.borders.push_back({outward[0], outward[1], most - problem_.balance_margin});
    return room;
}

bool PathPlanner::strengthen(const std::vector<Contact>& contacts, Solution& out) {
    if (!out.residuals.solved()) return false;
    const double margin = problem_.balance_margin;
    if (look(contacts, out.q.data()).has_room(margin)) return true;
    double room = border();
    for (int i = 0; i < MAX_BORDERS && room < margin - MARGIN_TOL && room > -1.0; ++i) {
        const int iterations = out.iterations;
        solver.solve(problem_, out.q.data(), MAX_ITERATIONS, STEP_TOL, first_);
        if (!first_.residuals.solved()) break;
        look(contacts, first_.q.data());
        const double other = border();
        if (other <= room) break;
        std::swap(out, first_);
        out.iterations += iterations;
        room = other;
    }
    return room >= LEAST_ROOM * model_.length_scale;
}

bool PathPlanner::shift(Transition& t, const double* hint, Solution& out) {
    Vec3 middle;
    for (const Contact& c : t.held) middle += c.position * (1.0 / t.held.size());
    for (Contact& c : t.rolling) c = rolled(c, middle, t.before.data());
    ask_balance(t.held, t.rolling, t.margin, STANCE_WEIGHT);
    problem_.q_reference = t.before;
    solver.solve_hard(problem_, t.before.data(), hint, out);
    const bool holds = strengthen(t.held, out);
    t.shifted = out.q;
    return holds;
}

bool PathPlanner::touch(Transition& t, const double* hint, Solution& out) {
    const Surface& s = model_.surfaces[t.made.surface];
    solver.kin.update(t.shifted.data());
    const Vec3 p1 = solver.kin.contact_point(t.made.surface, -1,
                                             model_.supports[t.made.support].normal);
    const Mat3 R_WB = solver.kin.rotation(model_.base);
    ask_balance(t.held, {t.made}, t.margin, STANCE_WEIGHT);
    problem_.q_reference.resize(model_.nq);
    for (int i = 0; i < model_.nq; ++i)
        problem_.q_reference[i] = 0.5 * (t.shifted[i] + t.after[i]);
    PointingTask lean;
    lean.start_body[0] = s.body;
    lean.start[0] = s.whole.centre;
    lean.end_body[0] = s.mass_body;
    lean.end[0] = s.mass_point;
    lean.direction = lean_direction(p1, t.made.position, R_WB);
    lean.weight = LEAN_WEIGHT;
    problem_.pointing.push_back(lean);
    solver.solve_hard(problem_, t.after.data(), hint, out);
    const bool holds = strengthen(t.held, out);
    t.touching = out.q;
    return holds;
}

void PathPlanner::plan(const Transition& t, Path& out) {
    out.forget();
    out.phases = {Postures{t.before, t.shifted}, {}, {t.touching, t.after}};
    // The swing first, which is hardest: where it fails, nothing else is asked.
    const auto contacts = closed_contacts(t);
    swing(t, out);
    if (!check_phase(t, contacts[1], 1, out)) return;
    bridge(t.before, t.shifted, contacts[0], out.phases[0]);
    if (!check_phase(t, contacts[0], 0, out)) return;
    bridge(t.touching, t.after, contacts[2], out.phases[2]);
    check_phase(t, contacts[2], 2, out);
}

}  // namespace clamber
