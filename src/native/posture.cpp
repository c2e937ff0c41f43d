// Model, Solver and paths for Python: arrays in, arrays out.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <mutex>
#include <stdexcept>

#include "bindings.h"
#include "path.h"
#include "timing.h"

namespace clamber {

namespace {

// Rows of contacts: whole numbers, and real ones.
using Packed = std::tuple<Array2<int>, Array2<>>;
Matrix stacked(const Postures& q, std::size_t nq) {
    std::vector<double> out;
    out.reserve(q.size() * nq);
    for (const auto& x : q) out.insert(out.end(), x.begin(), x.end());
    return own(std::move(out), {q.size(), nq});
}

int index(int i, std::size_t n, const char* what) {
    if (i < 0 || static_cast<std::size_t>(i) >= n)
        throw std::invalid_argument(std::string("no such ") + what);
    return i;
}

// Rows (surface, support, edge, has link) and (position, quaternion, link).
std::vector<Contact> read_contacts(const Model& m, const Array2<int>& what,
                                   const Array2<>& where) {
    check_size(where.shape(0), what.shape(0), "contacts");
    if (what.shape(0)) check_size(what.shape(1) + where.shape(1), 4 + 11, "a contact");
    std::vector<Contact> out(what.shape(0));
    for (std::size_t i = 0; i < out.size(); ++i) {
        const int* w = what.data() + 4 * i;
        const double* x = where.data() + 11 * i;
        Contact& c = out[i];
        c.surface = index(w[0], m.surfaces.size(), "surface");
        c.support = index(w[1], m.supports.size(), "support");
        c.edge = w[2] < 0 ? -1 : index(w[2], m.surfaces[c.surface].edges.size(), "edge");
        c.has_link = w[3] != 0;
        c.position = read3(x);
        c.quaternion = readq(x + 3);
        c.link = readq(x + 7);
    }
    return out;
}

// Rows (kind, surface, support, edge, loaded, has link) and (position, rotation, link,
// reference, stability, weight).
void read_tasks(const Model& m, const Array2<int>& what, const Array2<>& where, Problem& p) {
    check_size(where.shape(0), what.shape(0), "tasks");
    if (what.shape(0)) check_size(what.shape(1) + where.shape(1), 6 + 19, "a task");
    for (std::size_t i = 0; i < what.shape(0); ++i) {
        const int* w = what.data() + 6 * i;
        const double* x = where.data() + 19 * i;
        SurfaceTask t;
        t.kind = static_cast<TaskKind>(index(w[0], 4, "task"));
        t.surface = index(w[1], m.surfaces.size(), "surface");
        t.support = index(w[2], m.supports.size(), "support");
        const std::size_t edges = m.surfaces[t.surface].edges.size();
        t.edge = t.kind == TaskKind::OnEdge ? index(w[3], edges, "edge") : -1;
        t.loaded = w[4] != 0;
        t.has_link = w[5] != 0;
        t.position = read3(x);
        t.rotation = quat_from_matrix(read9(x + 3));
        t.link = readq(x + 12);
        t.reference = x[16];
        t.stability = x[17];
        t.weight = x[18];
        p.tasks.push_back(t);
    }
}

// Rows (first start, second start or -1, first end, second end or -1) of bodies, and the
// four points in their frames, the direction and the weight.
void read_pointing(const Model& m, const Array2<int>& what, const Array2<>& where,
                   Problem& p) {
    check_size(where.shape(0), what.shape(0), "directions");
    if (what.shape(0)) check_size(what.shape(1) + where.shape(1), 4 + 16, "a direction");
    for (std::size_t i = 0; i < what.shape(0); ++i) {
        const int* w = what.data() + 4 * i;
        const double* x = where.data() + 16 * i;
        PointingTask t;
        t.starts = w[1] < 0 ? 1 : 2;
        t.ends = w[3] < 0 ? 1 : 2;
        for (int k = 0; k < t.starts; ++k) {
            t.start_body[k] = index(w[k], m.bodies.size(), "body");
            t.start[k] = read3(x + 3 * k);
        }
        for (int k = 0; k < t.ends; ++k) {
            t.end_body[k] = index(w[2 + k], m.bodies.size(), "body");
            t.end[k] = read3(x + 6 + 3 * k);
        }
        t.direction = read3(x + 12);
        t.weight = x[15];
        p.pointing.push_back(t);
    }
}

nb::tuple as_tuple(const Residuals& r) {
    return nb::make_tuple(r.contact, r.distance, r.balance, r.limits, r.worst_pair,
                          r.com_margin);
}

nb::tuple as_tuple(Solution& s) {
    return nb::make_tuple(own(std::move(s.q)), s.iterations, s.converged,
                          as_tuple(s.residuals));
}

nb::tuple as_tuple(Path& p) {
    return nb::make_tuple(static_cast<int>(p.status), p.phase, p.depth, p.pair,
                          own(std::move(p.weak)));
}

// A planner with the model that it refers to, for one caller at a time.
struct Workspace {
    std::shared_ptr<const Model> model;
    PathPlanner planner;
    std::mutex busy;

    Workspace(std::shared_ptr<const Model> m, const Array1<>& rough,
              const Array1<unsigned char>& told)
        : model(std::move(m)), planner(*model) {
        check_size(rough.size(), model->pairs.size(), "rough");
        check_size(told.size(), model->pairs.size(), "told");
        Rows& rows = planner.solver.rows;
        rows.rough.assign(rough.data(), rough.data() + rough.size());
        rows.told.assign(told.data(), told.data() + told.size());
    }

    // Contacts that stay, those that are broken, and the new one.
    void read_contacts_of(Transition& t, const std::vector<Packed>& contacts) const {
        check_size(contacts.size(), 3, "contacts");
        const auto read = [this](const Packed& c) {
            return read_contacts(*model, std::get<0>(c), std::get<1>(c));
        };
        t.held = read(contacts[0]);
        t.rolling = read(contacts[1]);
        const auto new_ones = read(contacts[2]);
        t.makes = !new_ones.empty();
        if (t.makes) t.made = new_ones[0];
    }

    const double* posture(const Array1<>& q) const {
        check_size(q.size(), model->nq, "q");
        return q.data();
    }
};

}  // namespace

void bind_posture(nb::module_& m) {
    m.attr("EDGE_INSET") = EDGE_INSET;
    m.attr("EDGE_ROOM") = EDGE_ROOM;
    m.attr("EDGE_WEIGHT") = EDGE_WEIGHT;
    m.attr("ROUGHNESS_WEIGHT") = ROUGHNESS_WEIGHT;
    m.attr("STEP_ROTATION") = STEP_ROTATION;
    m.attr("STEP_TRANSLATION") = STEP_TRANSLATION;
    m.attr("ACTIVE_RANGE") = ACTIVE_RANGE;
    m.attr("DAMPING") = DAMPING;
    m.attr("PENALTY") = PENALTY;
    m.attr("CONTACT_TOL") = CONTACT_TOL;
    m.attr("LIMIT_TOL") = LIMIT_TOL;
    m.attr("DISTANCE_TOL") = DISTANCE_TOL;
    m.attr("MARGIN_TOL") = MARGIN_TOL;
    m.attr("CLEARANCE") = CLEARANCE;
    m.attr("FURTHER_CLEARANCE") = FURTHER_CLEARANCE;
    m.attr("EFFORT_SHARE") = EFFORT_SHARE;
    m.attr("LEAST_ROOM") = LEAST_ROOM;
    m.attr("MAX_ITERATIONS") = MAX_ITERATIONS;
    m.attr("STEP_TOL") = STEP_TOL;
    m.attr("COM_WEIGHT") = COM_WEIGHT;
    m.attr("ELLIPSE_WEIGHT") = ELLIPSE_WEIGHT;
    m.attr("DRIFT_LIMIT") = DRIFT_LIMIT;
    m.attr("OVERLAP_LIMIT") = OVERLAP_LIMIT;
    m.attr("PATH_OPENS") = static_cast<int>(Path::Status::Opens);
    m.attr("PATH_OVERLAPS") = static_cast<int>(Path::Status::Overlaps);
    m.attr("PATH_WEAK") = static_cast<int>(Path::Status::Weak);
    m.def("lean_direction",
          [](const Array1<>& p1, const Array1<>& p2, const Array2<>& R_WB) {
              check_size(p1.size() + p2.size() + R_WB.size(), 15, "points and rotation");
              const Vec3 d =
                  lean_direction(read3(p1.data()), read3(p2.data()), read9(R_WB.data()));
              return own({d.x, d.y, d.z});
          },
          "Unit vector from a new contact to the mass it will support (4.26, 4.27).");
    m.def("highest",
          [](const Array1<>& position, const Array1<>& normal, const Array2<>& A,
             const Array1<>& b, const Array1<>& p1, const Array1<>& p2) {
              check_size(position.size() + normal.size() + p1.size() + p2.size(), 12, "points");
              check_size(A.size(), 3 * b.size(), "border");
              Support s;
              s.position = read3(position.data());
              s.normal = read3(normal.data());
              for (std::size_t k = 0; k < b.size(); ++k) s.A.push_back(read3(A.data() + 3 * k));
              s.b.assign(b.data(), b.data() + b.size());
              return highest(s, read3(p1.data()), read3(p2.data()));
          },
          "Height of a support's highest point below the way from p1 to p2.");
    m.def("arc",
          [](const Array1<>& p1, const Array1<>& p2, double top, bool on_top, int points,
             double scale) {
              check_size(p1.size() + p2.size(), 6, "ends");
              std::vector<Vec3> arc_points;
              arc(read3(p1.data()), read3(p2.data()), top, on_top, points, scale, arc_points);
              std::vector<double> out;
              for (const Vec3& p : arc_points) out.insert(out.end(), {p.x, p.y, p.z});
              return own(std::move(out), {arc_points.size(), 3});
          },
          nb::arg("p1"), nb::arg("p2"), nb::arg("top"), nb::arg("on_top"), nb::arg("points"),
          nb::arg("scale") = 1.0,
          "Control points of the arc between two contact points (4.29).");

    nb::class_<Problem>(m, "Problem", "What a posture must and should satisfy.")
        .def("__init__",
             [](Problem* self, const std::shared_ptr<const Model>& model,
                const Array2<int>& tasks, const Array2<>& task_values,
                const Array2<int>& pointing, const Array2<>& pointing_values,
                const Array1<>& q_reference, const Array1<>& clearance,
                std::optional<Array1<>> base_rotation, std::optional<Array1<>> com_target,
                bool balance, const Array1<>& weights) {
                 new (self) Problem();
                 check_size(q_reference.size(), model->nq, "q_reference");
                 check_size(clearance.size(), model->pairs.size(), "clearance");
                 check_size(weights.size(), 5, "weights");
                 read_tasks(*model, tasks, task_values, *self);
                 read_pointing(*model, pointing, pointing_values, *self);
                 self->q_reference.assign(q_reference.data(),
                                          q_reference.data() + q_reference.size());
                 self->clearance.assign(clearance.data(), clearance.data() + clearance.size());
                 if (base_rotation) {
                     check_size(base_rotation->size(), 9, "base_rotation");
                     self->turned = true;
                     self->base_rotation = quat_from_matrix(read9(base_rotation->data()));
                 }
                 if (com_target) {
                     check_size(com_target->size(), 2, "com_target");
                     self->over = true;
                     self->com_target = {com_target->data()[0], com_target->data()[1]};
                 }
                 self->balance = balance;
                 self->balance_margin = weights.data()[0];
                 self->posture_weight = weights.data()[1];
                 self->base_weight = weights.data()[2];
                 self->com_weight = weights.data()[3];
                 self->ellipse_weight = weights.data()[4];
             },
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
             nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg());

    nb::class_<Workspace>(m, "Workspace", "Solves postures and paths, one at a time.")
        .def(nb::init<std::shared_ptr<const Model>, const Array1<>&,
                      const Array1<unsigned char>&>())
        .def("solve",
             [](Workspace& w, const Problem& p, const Array1<>& q, int iterations,
                double tolerance) {
                 Solution out;
                 const double* from = w.posture(q);
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.solver.solve(p, from, iterations, tolerance, out);
                 }
                 return as_tuple(out);
             },
             "Iterate from q: q, iterations, whether it converged, residuals.")
        .def("solve_hard",
             [](Workspace& w, const Problem& p, const Array1<>& q,
                std::optional<Array1<>> hint) {
                 Solution out;
                 const double* from = w.posture(q);
                 const double* first = hint ? w.posture(*hint) : nullptr;
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.solver.solve_hard(p, from, first, out);
                 }
                 return as_tuple(out);
             },
             nb::arg(), nb::arg(), nb::arg().none(),
             "Solve with more than one way to get there.")
        .def("residuals",
             [](Workspace& w, const Problem& p, const Array1<>& q) {
                 const std::lock_guard lock(w.busy);
                 return as_tuple(w.planner.solver.residuals(p, w.posture(q)));
             },
             "How well q satisfies a problem.")
        .def("build",
             [](Workspace& w, const Problem& p, const Array1<>& q, double reach) {
                 const std::lock_guard lock(w.busy);
                 Solver& s = w.planner.solver;
                 const double merit = s.begin(p, w.posture(q), reach);
                 const std::size_t nv = w.model->nv;
                 const auto stack = [nv](const std::vector<double>& J, std::size_t n) {
                     return own({J.begin(), J.begin() + n * nv}, {n, nv});
                 };
                 const std::size_t kept = s.lower.size() - nv;
                 return nb::make_tuple(
                     own(std::vector<double>(s.H), {nv, nv}), own(std::vector<double>(s.c)),
                     stack(s.closed_rows(), s.errors().size()),
                     own(std::vector<double>(s.errors())), stack(s.kept_rows(), kept),
                     own(std::vector<double>(s.lower)), own(std::vector<double>(s.upper)),
                     merit);
             },
             "The QP at q: H, c, closed rows and errors, kept rows, bounds, merit.")
        .def("step",
             [](Workspace& w, const Problem& p, const Array1<>& q, double radius) {
                 std::vector<double> dq(w.model->nv);
                 const double* from = w.posture(q);
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.solver.begin(p, from, ACTIVE_RANGE);
                     w.planner.solver.step(radius, dq.data());
                 }
                 return own(std::move(dq));
             },
             "The solution of the QP at q, with steps up to a share of the largest.")
        .def("is_stable",
             [](Workspace& w, const Array2<int>& what, const Array2<>& where,
                const Array1<>& q) {
                 const auto contacts = read_contacts(*w.model, what, where);
                 const std::lock_guard lock(w.busy);
                 return w.planner.is_stable(contacts, w.posture(q));
             },
             "Whether forces and torques that are counted on hold the robot at q.")
        .def("statics",
             [](Workspace& w, const Array2<int>& what, const Array2<>& where,
                const Array1<>& q) {
                 const auto contacts = read_contacts(*w.model, what, where);
                 const std::lock_guard lock(w.busy);
                 const Holding& h = w.planner.look(contacts, w.posture(q));
                 const ContactPointsView p = h.points();
                 const LoadView load = h.load();
                 const TorqueView t = h.torque();
                 const std::size_t n = p.n, nv = t.nv, na = t.na;
                 const auto rows = [n](const double (*x)[3]) {
                     const auto* first = reinterpret_cast<const double*>(x);
                     return own({first, first + 3 * n}, {n, 3});
                 };
                 std::vector<double> of(h.owners().begin(), h.owners().end());
                 return nb::make_tuple(
                     rows(p.points), rows(p.normals), own({p.mu, p.mu + n}),
                     own(std::move(of)), own({load.com, load.com + 3}),
                     own({t.jacobian, t.jacobian + 3 * n * nv}, {3 * n, nv}),
                     own({t.gravity, t.gravity + nv}), own({t.limits, t.limits + na}));
             },
             "Points that bear at q, normals, friction, contact of each; centre of mass, "
             "Jacobians, gravity, torques counted on.")
        .def("centres_of_mass",
             [](Workspace& w, const Array2<>& q) {
                 const std::size_t n = q.shape(0), nq = w.model->nq;
                 if (n) check_size(q.shape(1), nq, "q");
                 const std::lock_guard lock(w.busy);
                 std::vector<double> out(3 * n);
                 for (std::size_t i = 0; i < n; ++i) {
                     w.planner.solver.kin.update(q.data() + i * nq);
                     write3(w.planner.solver.kin.com(), out.data() + 3 * i);
                 }
                 return own(std::move(out), {n, 3});
             },
             "(n, 3) of the robot at postures (n, nq).")
        .def("differences",
             [](Workspace& w, const Array2<>& q) {
                 const std::size_t n = q.shape(0), nq = w.model->nq, nv = w.model->nv;
                 if (n) check_size(q.shape(1), nq, "q");
                 const std::size_t steps = n ? n - 1 : 0;
                 std::vector<double> out(steps * nv);
                 for (std::size_t i = 0; i < steps; ++i)
                     difference(*w.model, q.data() + i * nq, q.data() + (i + 1) * nq,
                                out.data() + i * nv);
                 return own(std::move(out), {steps, nv});
             },
             "(n - 1, nv) tangent vectors from each of the postures (n, nq) to the next.")
        .def("kinematics",
             [](Workspace& w, const Array1<>& q, int body, const Array1<>& point) {
                 check_size(point.size(), 3, "point");
                 index(body, w.model->bodies.size(), "body");
                 const std::lock_guard lock(w.busy);
                 Kinematics& kin = w.planner.solver.kin;
                 kin.update(w.posture(q));
                 const std::size_t n = w.model->bodies.size(), nv = w.model->nv;
                 std::vector<double> x(3 * n), R(9 * n), com(3 * nv), jac(6 * nv, 0.0);
                 for (std::size_t b = 0; b < n; ++b) {
                     write3(kin.pos(static_cast<int>(b)), x.data() + 3 * b);
                     std::copy_n(kin.rotation(static_cast<int>(b)).m, 9, R.data() + 9 * b);
                 }
                 const Vec3* jcom = kin.com_jacobian();
                 for (std::size_t d = 0; d < nv; ++d)
                     for (int k = 0; k < 3; ++k) com[k * nv + d] = jcom[d][k];
                 const Vec3 p = read3(point.data());
                 for (const int d : w.model->chain[body]) {
                     const Twist& t = kin.twist(d);
                     const Vec3 moves = t.v + cross(t.w, p);
                     for (int k = 0; k < 3; ++k) {
                         jac[k * nv + d] = moves[k];
                         jac[(3 + k) * nv + d] = t.w[k];
                     }
                 }
                 return nb::make_tuple(own(std::move(x), {n, 3}), own(std::move(R), {n, 3, 3}),
                                       own(std::move(com), {3, nv}),
                                       own(std::move(jac), {6, nv}));
             },
             "Bodies' positions and rotations at q, the Jacobians of the centre of mass and "
             "of a body's point.")
        .def("holding_torques",
             [](Workspace& w, const Array2<int>& what, const Array2<>& where,
                const Array2<>& prices, const Array2<>& q, const Array2<>& inertia) {
                 const auto all = read_contacts(*w.model, what, where);
                 const std::size_t n = q.shape(0), na = w.model->dadr.size();
                 const std::size_t nv = w.model->nv;
                 check_size(prices.shape(0), n, "prices");
                 check_size(prices.shape(1), all.size(), "prices");
                 check_size(q.shape(1), w.model->nq, "q");
                 const bool moves = inertia.shape(0) > 0;
                 if (moves) {
                     check_size(inertia.shape(0), n, "inertia");
                     check_size(inertia.shape(1), nv, "inertia");
                 }
                 std::vector<double> out(n * na);
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     std::vector<Contact> bearing;
                     std::vector<double> price;
                     for (std::size_t i = 0; i < n; ++i) {
                         bearing.clear();
                         price.clear();
                         for (std::size_t k = 0; k < all.size(); ++k) {
                             const double p = prices.data()[i * all.size() + k];
                             if (!(p > 0.0)) continue;
                             bearing.push_back(all[k]);
                             price.push_back(p);
                         }
                         w.planner.holding_torques(bearing, price.data(),
                                                   q.data() + i * w.model->nq,
                                                   moves ? inertia.data() + i * nv : nullptr,
                                                   out.data() + i * na);
                     }
                 }
                 return own(std::move(out), {n, na});
             },
             "(n, na) torques that hold postures (n, nq), contacts at prices (n, k) or 0; "
             "against generalised forces (n, nv) of inertia, or (0, 0).")
        .def("tangents",
             [](Workspace& w, const Array2<>& q, double ha, double hb, double steeper,
                const Array2<int>& what, const Array2<>& where) {
                 const auto closed = read_contacts(*w.model, what, where);
                 const std::size_t nq = w.model->nq, nv = w.model->nv;
                 check_size(q.shape(0), 4, "postures");
                 check_size(q.shape(1), nq, "q");
                 const std::lock_guard lock(w.busy);
                 std::vector<double> a(nv), v(nv);
                 difference(*w.model, q.data(), q.data() + nq, a.data());
                 difference(*w.model, q.data() + 2 * nq, q.data() + 3 * nq, v.data());
                 for (std::size_t d = 0; d < nv; ++d) {
                     const double before = a[d] / ha, after = v[d] / hb;
                     const double mean = (hb * before + ha * after) / (ha + hb);
                     const double slower = std::min(std::abs(before), std::abs(after));
                     const double most = before * after > 0.0 ? steeper * slower : 0.0;
                     v[d] = std::min(std::max(mean, -most), most);
                 }
                 Kinematics& kin = w.planner.solver.kin;
                 kin.update(q.data() + 2 * nq);
                 keep_closed(kin, closed, v.data());
                 // Of raw coordinates, whose quaternions may have another sign on each side.
                 std::vector<double> out(2 * nq);
                 for (std::size_t side = 0; side < 2; ++side) {
                     const double* const quat = q.data() + (1 + side) * nq + 3;
                     double* const raw = out.data() + side * nq;
                     const Quat turn = readq(quat) * Quat{0.0, v[3], v[4], v[5]};
                     std::copy_n(v.data(), 3, raw);
                     raw[3] = 0.5 * turn.w, raw[4] = 0.5 * turn.x;
                     raw[5] = 0.5 * turn.y, raw[6] = 0.5 * turn.z;
                     std::copy(v.begin() + 6, v.end(), raw + 7);
                 }
                 return own(std::move(out), {2, nq});
             },
             "(2, nq) slopes at the end of one path and the begin of the next, of the last "
             "two and the first two postures (4, nq), at steps of the path parameter; closed "
             "contacts do not move.")
        .def("time_law",
             [](Workspace& w, const std::vector<Packed>& contacts, const Array1<int>& stance,
                const Array2<>& q, const Array2<>& slope, const Array2<>& inertia,
                const Array2<>& velocity, const Array2<>& limits, const Array1<>& damping,
                double share) {
                 const std::size_t n = q.shape(0), nv = w.model->nv;
                 std::vector<std::vector<Contact>> stances;
                 for (const Packed& c : contacts)
                     stances.push_back(read_contacts(*w.model, std::get<0>(c), std::get<1>(c)));
                 check_size(n ? q.shape(1) : 0, n ? w.model->nq : 0, "q");
                 check_size(stance.size(), n, "stance");
                 for (const Array2<>* x : {&slope, &inertia, &velocity})
                     check_size(x->size(), n * nv, "generalised forces");
                 check_size(limits.size(), 5 * n, "limits");
                 check_size(damping.size(), nv, "damping");
                 for (std::size_t i = 0; i < n; ++i)
                     index(stance.data()[i], stances.size(), "stance");
                 Course course;
                 course.n = static_cast<int>(n);
                 course.q = q.data();
                 course.slope = slope.data();
                 course.inertia = inertia.data();
                 course.velocity = velocity.data();
                 course.stance = stance.data();
                 course.length = limits.data();
                 course.u_max = limits.data() + n;
                 course.x_max = limits.data() + 2 * n;
                 course.u_slow = limits.data() + 3 * n;
                 course.x_slow = limits.data() + 4 * n;
                 course.damping = damping.data();
                 std::vector<double> x(n + 1, 0.0);
                 if (n) {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     TimeLaw(w.planner, *w.model).fastest(course, stances, share, x.data());
                 }
                 return own(std::move(x));
             },
             "(n + 1) squared rate of the fastest law between n intervals of a path; limits "
             "(5, n): lengths, bounds of |u| and of x, and |u| and x so slow that they are "
             "always borne.")
        .def("bridge",
             [](Workspace& w, const Array1<>& a, const Array1<>& b, const Array2<int>& what,
                const Array2<>& where) {
                 const auto contacts = read_contacts(*w.model, what, where);
                 const std::size_t nq = w.model->nq;
                 const std::vector<double> from(w.posture(a), a.data() + nq);
                 const std::vector<double> to(w.posture(b), b.data() + nq);
                 Postures out;
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.bridge(from, to, contacts, out);
                 }
                 return stacked(out, nq);
             },
             "Postures from one to another with contacts closed, near the straight way.")
        .def("rolled",
             [](Workspace& w, const Array2<int>& what, const Array2<>& where,
                const Array1<>& q, const Array1<>& towards) {
                 const auto contacts = read_contacts(*w.model, what, where);
                 check_size(contacts.size(), 1, "contacts");
                 check_size(towards.size(), 3, "towards");
                 const std::lock_guard lock(w.busy);
                 const Contact c =
                     w.planner.rolled(contacts[0], read3(towards.data()), w.posture(q));
                 return nb::make_tuple(c.edge, own({c.position.x, c.position.y, c.position.z}));
             },
             "The edge, -1 for none, on which a flat contact comes nearest to a point, and "
             "its middle.")
        .def("shift",
             [](Workspace& w, const Array1<>& before, const std::vector<Packed>& contacts,
                double margin, std::optional<Array1<>> hint) {
                 Transition t;
                 w.read_contacts_of(t, contacts);
                 t.before.assign(w.posture(before), before.data() + w.model->nq);
                 t.margin = margin;
                 const double* near = hint ? w.posture(*hint) : nullptr;
                 Solution out;
                 bool holds = false;
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     holds = w.planner.shift(t, near, out);
                 }
                 nb::list rolling;
                 for (const Contact& c : t.rolling)
                     rolling.append(nb::make_tuple(
                         c.edge, own({c.position.x, c.position.y, c.position.z})));
                 return nb::make_tuple(rolling, as_tuple(out), holds);
             },
             nb::arg(), nb::arg(), nb::arg(), nb::arg().none(),
             "Edges of broken contacts as they are let go, the solution with the weight on "
             "the others, and whether it was found and can be held.")
        .def("touch",
             [](Workspace& w, const Array1<>& shifted, const Array1<>& after,
                const std::vector<Packed>& contacts, double margin,
                std::optional<Array1<>> hint) {
                 Transition t;
                 w.read_contacts_of(t, contacts);
                 if (!t.makes) throw std::invalid_argument("no contact is made");
                 const std::size_t nq = w.model->nq;
                 t.shifted.assign(w.posture(shifted), shifted.data() + nq);
                 t.after.assign(w.posture(after), after.data() + nq);
                 t.margin = margin;
                 const double* near = hint ? w.posture(*hint) : nullptr;
                 Solution out;
                 bool holds = false;
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     holds = w.planner.touch(t, near, out);
                 }
                 return nb::make_tuple(as_tuple(out), holds);
             },
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(),
             "The solution with the new contact closed and not loaded, and whether it was "
             "found and can be held.")
        .def("path",
             [](Workspace& w, const std::vector<Array1<>>& postures,
                const std::vector<Packed>& contacts, double margin, bool adapt) {
                 check_size(postures.size(), 4, "postures");
                 Transition t;
                 w.read_contacts_of(t, contacts);
                 std::vector<double>* const parts[4] = {&t.before, &t.shifted, &t.touching,
                                                        &t.after};
                 for (int k = 0; k < 4; ++k) {
                     const double* q = w.posture(postures[k]);
                     parts[k]->assign(q, q + w.model->nq);
                 }
                 t.margin = margin;
                 t.adapt = adapt;
                 Path out;
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.plan(t, out);
                 }
                 std::vector<double> control;
                 for (const Vec3& p : out.control) control.insert(control.end(), {p.x, p.y, p.z});
                 const std::size_t n = out.control.size(), nq = w.model->nq;
                 return nb::make_tuple(stacked(out.phases[0], nq), stacked(out.phases[1], nq),
                                       stacked(out.phases[2], nq),
                                       own(std::move(control), {n, 3}), as_tuple(out));
             },
             "Postures of shift, swing and settle, the arc's control points, the verdict.")
        .def("check_path",
             [](Workspace& w, const std::vector<Array2<>>& phases,
                const std::vector<Packed>& contacts) {
                 check_size(phases.size(), 3, "phases");
                 Transition t;
                 w.read_contacts_of(t, contacts);
                 Path out;
                 for (int k = 0; k < 3; ++k)
                     for (std::size_t i = 0; i < phases[k].shape(0); ++i) {
                         check_size(phases[k].shape(1), w.model->nq, "q");
                         const double* q = phases[k].data() + i * w.model->nq;
                         out.phases[k].emplace_back(q, q + w.model->nq);
                     }
                 {
                     nb::gil_scoped_release released;
                     const std::lock_guard lock(w.busy);
                     w.planner.check(t, out);
                 }
                 return as_tuple(out);
             },
             "What is wrong with the postures of a path.");
}

}  // namespace clamber
