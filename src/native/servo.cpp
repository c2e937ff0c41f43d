#include "servo.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstdint>
#include <limits>

#include "bindings.h"

namespace clamber {

JointServo::JointServo(Reals kp, Reals damping, Reals ki, Reals limit, double dt)
    : kp_(std::move(kp)), damping_(std::move(damping)), ki_(std::move(ki)),
      limit_(std::move(limit)), integral_(kp_.size(), 0.0), dt_(dt) {}

void JointServo::command(const double* reference, const double* velocity,
                         const double* torque, const double* measured, const double* follow,
                         double* out) {
    for (int j = 0; j < size(); ++j) {
        const double held = 1.0 - follow[j];
        double error = reference[j] - measured[j];
        const double goal = reference[j] - follow[j] * error;
        error *= held;
        integral_[j] = std::clamp(integral_[j] + error * dt_, -limit_[j], limit_[j]);
        const double push =
            damping_[j] * (held * velocity[j]) + torque[j] + ki_[j] * integral_[j];
        out[j] = goal + push / kp_[j];
    }
}

SelfPositioning::SelfPositioning(std::vector<std::vector<int>> arms,
                                 std::vector<Ankle> ankles, int na, double rate)
    : arms_(std::move(arms)), ankles_(std::move(ankles)), share_(na, 0.0), rate_(rate) {}

const Reals& SelfPositioning::share(const bool* loaded, const bool* closed,
                                    const bool* ahead) {
    bool on_arms = true;
    for (const auto& arm : arms_) {
        bool any = false;
        for (int surface : arm) any |= loaded[surface];
        on_arms &= any;
    }
    for (const auto& [foot, joints] : ankles_) {
        const bool free = on_arms && closed[foot] && ahead[foot];
        for (int j : joints)
            share_[j] = std::clamp(share_[j] + (free ? rate_ : -rate_), 0.0, 1.0);
    }
    return share_;
}

void Filter::update(const double* now, const double* force) {
    for (size_t i = 0; i < load.size(); ++i) load[i] += force_share_ * (force[i] - load[i]);
    double* turn = &q[3];
    const double* seen = now + 3;
    if (seen[0] * turn[0] + seen[1] * turn[1] + seen[2] * turn[2] + seen[3] * turn[3] < 0)
        for (int i = 0; i < 4; ++i) turn[i] = -turn[i];
    for (size_t i = 0; i < q.size(); ++i) q[i] += pose_share_ * (now[i] - q[i]);
    const double norm = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1] +
                                  turn[2] * turn[2] + turn[3] * turn[3]);
    for (int i = 0; i < 4; ++i) turn[i] /= norm;
}

bool Filter::is_pressed() const {
    for (const auto& w : watched)
        if (dot(read3(&load[3 * w.surface]), w.normal) >= pressed) return true;
    return false;
}

double Filter::least() const {
    double out = std::numeric_limits<double>::infinity();
    for (const auto& b : bearing)
        out = std::min(out, dot(read3(&load[3 * b.surface]), b.normal));
    return out;
}

bool load_is_missing(const double* load, int ns, double weight, double share) {
    double sum = 0.0;
    for (int s = 0; s < ns; ++s) sum += load[3 * s + 2];
    return weight - sum > share * weight;
}

bool is_sideways(const double* force, double least) {
    return std::hypot(force[0], force[1]) > std::max(least, force[2]);
}

bool Track::advance() {
    if (left() <= 0) return false;
    const int i = rows_.count == 1 ? 0 : done_;
    ++done_;
    const auto copy = [i](const auto* from, auto& to) {
        std::copy_n(from + size_t(i) * to.size(), to.size(), to.begin());
    };
    copy(rows_.q, q);
    copy(rows_.velocity, velocity);
    copy(rows_.torque, torque);
    copy(rows_.closed, closed);
    copy(rows_.ahead, ahead);
    return true;
}

Sensors::Sensors(int nq, int ns, int late, int force_stride, int block)
    : nq_(nq), ns_(ns), late_(late), force_stride_(force_stride), block_(block),
      turn_(block), now_(nq + 3 * ns, 0.0), ring_((late + 1) * now_.size()) {}

void Sensors::draw(Noise noise) {
    noise_ = std::move(noise);
    turns_ = false;
    for (int i = 0; i < block_; ++i) {
        const Vec3 tilt = read3(&noise_.tilt[3 * i]);
        const double angle = norm(tilt);
        turns_ |= angle > 0.0;
        turn_[i] = angle > 0.0 ? axis_angle(tilt * (1.0 / angle), angle) : Quat{};
    }
}

void Sensors::read(const double* qpos, const double* felt) {
    const int i = int(step_ % block_);
    for (int n = 0; n < nq_; ++n) now_[n] = qpos[n] + noise_.offset[size_t(i) * nq_ + n];
    if (turns_) {
        const Quat seen = readq(&now_[3]) * turn_[i];
        now_[3] = seen.w, now_[4] = seen.x, now_[5] = seen.y, now_[6] = seen.z;
    }
    if (feels()) {
        const size_t row = size_t(i / force_stride_) * ns_;
        for (int s = 0; s < ns_; ++s)
            for (int a = 0; a < 3; ++a)
                now_[nq_ + 3 * s + a] = felt[3 * s + a] * (1.0 + noise_.gain[row + s]) +
                                        noise_.pull[3 * (row + s) + a];
    }
    std::copy(now_.begin(), now_.end(), ring_.begin() + (step_ % (late_ + 1)) * now_.size());
    const std::int64_t then = std::max<std::int64_t>(step_ - late_, 0);
    q = &ring_[(then % (late_ + 1)) * now_.size()];
    force = q + nq_;
    ++step_;
}

void ContactForces::update(const Contacts& c) {
    touches.clear();
    std::fill(surface.begin(), surface.end(), 0.0);
    other = 0.0;
    for (int i = 0; i < c.count; ++i) {
        const int* geom = c.geom + i * c.geom_stride;
        const int address = c.address[i * c.address_stride];
        const bool second = row(geom[0]) == kScene;  // the force acts on the second geom
        if (address < 0 || second == (row(geom[1]) == kScene)) continue;
        const double *f = c.force + address, *R = c.frame + i * c.frame_stride;
        Touch t{second ? geom[1] : geom[0], second ? geom[0] : geom[1], f[0], {}};
        for (int a = 0; a < 3; ++a) {
            const double x = f[0] * R[a] + f[1] * R[3 + a] + f[2] * R[6 + a];
            t.force[a] = second ? x : -x;
        }
        const int s = row(t.robot);
        for (int a = 0; s >= 0 && a < 3; ++a) surface[3 * s + a] += t.force[a];
        if (s < 0) other += t.normal;
        touches.push_back(t);
    }
}

namespace {

using InBool = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

template <typename T>
nb::ndarray<nb::numpy, T> view(T* data, std::initializer_list<size_t> shape, nb::handle owner) {
    return nb::ndarray<nb::numpy, T>(data, shape, owner);
}

std::vector<Filter::Watched> surfaces_along(const Filter& filter,
                                            const std::vector<int>& surfaces, In normals) {
    want(normals.size() == 3 * surfaces.size(), "a normal for each surface");
    std::vector<Filter::Watched> out;
    for (size_t i = 0; i < surfaces.size(); ++i) {
        want(surfaces[i] >= 0 && surfaces[i] < filter.surfaces(), "rows of surfaces");
        out.push_back({surfaces[i], read3(normals.data() + 3 * i)});
    }
    return out;
}

struct OwnTrack : Track {  // keeps the arrays of its rows
    using Track::Track;
    nb::object rows;
};

// One controller: it filters what is measured and follows its track on its servos.
//
// `owner.decide(look)` is called where the rows are at their end, where a surface is
// pressed that is watched, and every `period` steps (`look`), before the next row is
// taken; `owner.balance()` after that, every `period` steps.
struct Follower {
    Follower(Filter& filter, Track& track, JointServo& servo, SelfPositioning& ankles,
             std::vector<int> qadr, int period, double touch, double shift_share)
        : filter(filter), track(track), servo(servo), ankles(ankles), qadr(std::move(qadr)),
          period(period), touch(touch), shift_share(shift_share), goal(servo.size(), 0.0),
          shift(servo.size(), 0.0), measured(servo.size()), reference(servo.size()),
          torque(servo.size()), command(servo.size()), loaded(filter.surfaces()) {}

    void step(const double* q, const double* force, nb::handle owner) {
        filter.update(q, force);
        const bool look = step_count % period == 0;
        if (look || track.left() == 0 || filter.is_pressed()) owner.attr("decide")(look);
        if (!track.advance()) throw nb::value_error("a controller that has nothing to follow");
        if (++step_count % period == 0) owner.attr("balance")();
        for (int s = 0; s < filter.surfaces(); ++s) loaded[s] = filter.load[3 * s + 2] > touch;
        const Reals& follow = ankles.share(reinterpret_cast<const bool*>(loaded.data()),
                                           reinterpret_cast<const bool*>(track.closed.data()),
                                           reinterpret_cast<const bool*>(track.ahead.data()));
        commanded.insert(commanded.end(), track.q.begin(), track.q.end());
        double* posture = &commanded[commanded.size() - track.q.size()];
        for (size_t j = 0; j < qadr.size(); ++j) {
            shift[j] += shift_share * (goal[j] - shift[j]);
            posture[qadr[j]] += shift[j];
            reference[j] = posture[qadr[j]];
            measured[j] = q[qadr[j]];
            torque[j] = scale * track.torque[j];
        }
        servo.command(reference.data(), track.velocity.data(), torque.data(), measured.data(),
                      follow.data(), command.data());
    }

    Filter& filter;
    Track& track;
    JointServo& servo;
    SelfPositioning& ankles;
    std::vector<int> qadr;
    int period;
    double touch, shift_share;
    double scale = 1.0;  // of the torques
    bool ends = false;   // the rows at hand are the last ones
    std::int64_t step_count = 0;
    Reals goal, shift;  // (na,) [rad] added to the joints of the track, `shift` following
    Reals measured, reference, torque, command;
    std::vector<std::uint8_t> loaded;
    Reals commanded;  // (steps, nq)
};

// The pelvis has tilted or sunk far from its reference, both (nq,).
bool has_fallen(const double* q, const double* reference, double tilt, double height) {
    const auto upward = [](const Quat& t) {
        return Vec3{2 * (t.x * t.z - t.w * t.y), 2 * (t.y * t.z + t.w * t.x),
                    1 - 2 * (t.x * t.x + t.y * t.y)};
    };
    const double along = dot(upward(readq(q + 3)), upward(readq(reference + 3)));
    return along < std::cos(tilt) || q[2] < reference[2] - height;
}

// Where an array of numpy's lies. Quicker than a cast, which asks it first whether it is one
// of somebody else's.
template <typename T>
const T* data_of(nb::handle array, std::ptrdiff_t* stride = nullptr) {
    Py_buffer b;
    if (PyObject_GetBuffer(array.ptr(), &b, PyBUF_STRIDES) != 0) throw nb::python_error();
    const auto* out = static_cast<const T*>(b.buf);
    const bool fits = b.itemsize == sizeof(T);
    if (stride) *stride = b.strides[0] / std::ptrdiff_t(sizeof(T));
    PyBuffer_Release(&b);
    want(fits, "an array of other numbers");
    return out;
}

// The contacts of an `MjData`, by the names of MuJoCo's Python package. They begin its
// arena, which stays where it is as long as the data: how many there are is asked for after
// every step, where they lie only until two of them were seen. An array of one says nothing
// of the distance between two, and an empty one not where it is.
struct ListedContacts {
    explicit ListedContacts(nb::handle data)
        : data(nb::borrow(data)), contact(data.attr("contact")) {}

    double deepest() {
        look();
        double out = 0.0;
        for (int i = 0; i < seen.count; ++i) out = std::max(out, -dist[i * dist_stride]);
        return out;
    }
    Contacts all() {
        look();
        seen.force = data_of<double>(nb::getattr(data, force_name));
        return seen;
    }

private:
    void look() {
        seen.count = nb::cast<int>(nb::getattr(data, count_name));
        if (known) return;
        known = seen.count > 1;
        dist = data_of<double>(nb::getattr(contact, dist_name), &dist_stride);
        seen.geom = data_of<int>(nb::getattr(contact, geom_name), &seen.geom_stride);
        seen.address = data_of<int>(nb::getattr(contact, address_name), &seen.address_stride);
        seen.frame = data_of<double>(nb::getattr(contact, frame_name), &seen.frame_stride);
    }

    nb::object data, contact;
    // Interned: that is what the interpreter finds quickly.
    static nb::object name(const char* of) { return nb::steal(PyUnicode_InternFromString(of)); }
    nb::object count_name = name("ncon"), dist_name = name("dist"), geom_name = name("geom"),
               address_name = name("efc_address"), frame_name = name("frame"),
               force_name = name("efc_force");
    bool known = false;
    Contacts seen;
    const double* dist = nullptr;
    std::ptrdiff_t dist_stride = 0;
};

// The steps of one simulation: all but `mj_step` itself, and what is recorded.
struct Loop {
    Loop(nb::handle data, Follower& follower, Sensors& sensors, ContactForces& forces,
         std::vector<int> order, double step_size, int base, int stride, int tail, double tilt,
         double height, std::optional<In> push, int steps)
        : follower(follower), sensors(sensors), forces(forces), listed(data),
          order(std::move(order)), step_size(step_size), base(base), stride(stride), tail(tail),
          tilt(tilt), height(height), push(std::move(push)) {
        const auto numbers = [&](const char* name) {
            return nb::cast<nb::ndarray<double, nb::c_contig, nb::device::cpu>>(data.attr(name));
        };
        qpos = numbers("qpos"), qvel = numbers("qvel"), ctrl = numbers("ctrl");
        effort = numbers("actuator_force"), applied = numbers("xfrc_applied");
        const size_t n = std::max(steps, 0), rows = n / stride + 1;
        follower.commanded.reserve(n * follower.track.q.size());
        states.ctrl.reserve(n * ctrl.size());
        states.qpos.reserve(rows * qpos.size());
        states.qvel.reserve(rows * qvel.size());
        states.effort.reserve(rows * effort.size());
    }

    // What is due before the next `mj_step`; false where there is none.
    bool step(nb::handle owner) {
        if (count > 0 && !finish(count - 1)) return false;
        if (count % stride == 0) {
            append(states.qpos, qpos);
            append(states.qvel, qvel);
            states.depth.push_back(0.0);
        }
        if (sensors.feels()) forces.update(listed.all());
        sensors.read(qpos.data(), forces.surface.data());
        follower.step(sensors.q, sensors.force, owner);
        std::fill_n(ctrl.data(), ctrl.size(), 0.0);
        for (size_t j = 0; j < order.size(); ++j)
            ctrl.data()[order[j]] = std::nearbyint(follower.command[j] / step_size) * step_size;
        append(states.ctrl, ctrl);
        if (push) {
            const bool pushes = size_t(3 * count) < push->size();
            for (int a = 0; a < 3; ++a)
                applied.data()[6 * base + a] = pushes ? push->data()[3 * count + a] : 0.0;
        }
        ++count;
        return true;
    }

    // Record what the step `k` made; false where it was the last one.
    bool finish(std::int64_t k) {
        const bool first = k % stride == 0;
        const bool end = follower.ends && follower.track.left() < tail;
        states.depth.back() = std::max(states.depth.back(), listed.deepest());
        if (end) states.end_speed.push_back(norm(read3(qvel.data())));
        if (first || end) {
            forces.update(listed.all());
            for (const auto& t : forces.touches) {
                states.touch_step.push_back(std::int32_t(k));
                states.touch_geoms.push_back(std::int16_t(t.robot));
                states.touch_geoms.push_back(std::int16_t(t.scene));
                states.touch_load.push_back(t.normal);
                states.touch_load.push_back(t.force.z);
            }
        }
        if (first) {
            for (double f : forces.surface) states.surface.push_back(double(float(f)));
            states.other.push_back(forces.other);
            append(states.effort, effort);
            fell = has_fallen(qpos.data(), follower.track.q.data(), tilt, height);
        }
        return !fell && !(follower.ends && follower.track.left() == 0);
    }

    nb::dict recorded() {
        const size_t m = states.depth.size(), touches = states.touch_step.size();
        const size_t ns = forces.surface.size() / 3, nu = ctrl.size();
        auto s = std::move(states);
        states = {};
        nb::dict out;
        out["ctrl"] = own(std::move(s.ctrl), {size_t(count), nu});
        out["qpos"] = own(std::move(s.qpos), {m, qpos.size()});
        out["qvel"] = own(std::move(s.qvel), {m, qvel.size()});
        out["actuator_force"] = own(std::move(s.effort), {m, nu});
        out["contact_force"] = own(std::move(s.surface), {m, ns, 3});
        out["unintended"] = own(std::move(s.other), {m});
        out["penetration"] = own(std::move(s.depth), {m});
        out["contact_step"] = own(std::move(s.touch_step), {touches});
        out["contact_geoms"] = own(std::move(s.touch_geoms), {touches, 2});
        out["contact_load"] = own(std::move(s.touch_load), {touches, 2});
        const size_t n = s.end_speed.size();
        out["end_speed"] = own(std::move(s.end_speed), {n});
        return out;
    }

    using Numbers = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
    // What is recorded has single precision.
    static void append(Reals& to, const Numbers& x) {
        const size_t n = to.size();
        to.resize(n + x.size());
        for (size_t i = 0; i < x.size(); ++i) to[n + i] = double(float(x.data()[i]));
    }

    Follower& follower;
    Sensors& sensors;
    ContactForces& forces;
    ListedContacts listed;
    std::vector<int> order;
    double step_size;  // commands are multiples of it [rad]
    int base, stride, tail;
    double tilt, height;
    std::optional<In> push;  // (n, 3) [N] on the base
    Numbers qpos, qvel, ctrl, effort, applied;
    std::int64_t count = 0;
    bool fell = false;
    struct {
        Reals ctrl, qpos, qvel, effort, surface, other, depth, touch_load, end_speed;
        std::vector<std::int32_t> touch_step;
        std::vector<std::int16_t> touch_geoms;
    } states;
};

}  // namespace

void bind_servo(nb::module_& m) {
    nb::class_<JointServo>(m, "JointServo")
        .def(nb::init<Reals, Reals, Reals, Reals, double>(), nb::kw_only(), nb::arg("kp"),
             nb::arg("damping"), nb::arg("ki"), nb::arg("limit"), nb::arg("dt"))
        .def("command", [](JointServo& self, In reference, In velocity, In torque, In measured,
                           In follow) {
            const size_t n = self.size();
            for (const In* x : {&reference, &velocity, &torque, &measured, &follow})
                want(x->size() == n, "one number for each joint");
            Reals out(n);
            self.command(reference.data(), velocity.data(), torque.data(), measured.data(),
                         follow.data(), out.data());
            return own(std::move(out));
        });
    nb::class_<SelfPositioning>(m, "SelfPositioning")
        .def(nb::init<std::vector<std::vector<int>>, std::vector<SelfPositioning::Ankle>, int,
                      double>(),
             nb::kw_only(), nb::arg("arms"), nb::arg("ankles"), nb::arg("joints"),
             nb::arg("rate"))
        .def("share", [](SelfPositioning& self, InBool loaded, InBool closed, InBool ahead) {
            return own(Reals(self.share(loaded.data(), closed.data(), ahead.data())));
        });
    nb::class_<Filter>(m, "Filter")
        .def(nb::init<Reals, int, double, double>(), nb::arg("q"), nb::arg("surfaces"),
             nb::kw_only(), nb::arg("pose_share"), nb::arg("force_share"))
        .def("update", [](Filter& self, In q, In force) {
            want(q.size() == self.q.size() && force.size() == self.load.size(),
                 "as many numbers as are filtered");
            self.update(q.data(), force.data());
        })
        .def("watch", [](Filter& self, std::vector<int> surfaces, In normals, double pressed) {
            self.watched = surfaces_along(self, surfaces, normals);
            self.pressed = pressed;
        })
        .def("bear", [](Filter& self, std::vector<int> surfaces, In normals) {
            self.bearing = surfaces_along(self, surfaces, normals);
        })
        .def_prop_ro("least", &Filter::least)
        .def_prop_ro("q", [](nb::handle_t<Filter> self) {
            auto& f = nb::cast<Filter&>(self);
            return view(f.q.data(), {f.q.size()}, self);
        })
        .def_prop_ro("load", [](nb::handle_t<Filter> self) {
            auto& f = nb::cast<Filter&>(self);
            return view(f.load.data(), {size_t(f.surfaces()), 3}, self);
        });
    nb::class_<OwnTrack>(m, "Track")
        .def(nb::init<int, int, int>(), nb::arg("nq"), nb::arg("joints"), nb::arg("surfaces"))
        .def("load", [](OwnTrack& self, In q, In velocity, In torque, InBool closed,
                        InBool ahead, int steps) {
            const size_t n = self.q.size() ? q.size() / self.q.size() : 0;
            want(n >= 1 && (n == 1 || int(n) >= steps) && q.size() == n * self.q.size() &&
                     velocity.size() == n * self.velocity.size() &&
                     torque.size() == n * self.torque.size() &&
                     closed.size() == n * self.closed.size() &&
                     ahead.size() == n * self.ahead.size(),
                 "one row for each step, or for all");
            self.load({q.data(), velocity.data(), torque.data(), closed.data(), ahead.data(),
                       int(n)}, steps);
            self.rows = nb::make_tuple(q, velocity, torque, closed, ahead);
        })
        .def("advance", [](OwnTrack& self) { return self.advance(); })
        .def_prop_ro("done", [](OwnTrack& self) { return self.done(); })
        .def_prop_ro("left", [](OwnTrack& self) { return self.left(); })
        .def_prop_ro("q", [](nb::handle_t<OwnTrack> self) {
            auto& t = nb::cast<OwnTrack&>(self);
            return view(t.q.data(), {t.q.size()}, self);
        })
        .def_prop_ro("velocity", [](nb::handle_t<OwnTrack> self) {
            auto& t = nb::cast<OwnTrack&>(self);
            return view(t.velocity.data(), {t.velocity.size()}, self);
        })
        .def_prop_ro("torque", [](nb::handle_t<OwnTrack> self) {
            auto& t = nb::cast<OwnTrack&>(self);
            return view(t.torque.data(), {t.torque.size()}, self);
        })
        .def_prop_ro("closed", [](nb::handle_t<OwnTrack> self) {
            auto& t = nb::cast<OwnTrack&>(self);
            return view(reinterpret_cast<bool*>(t.closed.data()), {t.closed.size()}, self);
        })
        .def_prop_ro("ahead", [](nb::handle_t<OwnTrack> self) {
            auto& t = nb::cast<OwnTrack&>(self);
            return view(reinterpret_cast<bool*>(t.ahead.data()), {t.ahead.size()}, self);
        });
    nb::class_<Follower>(m, "Follower")
        .def(nb::init<Filter&, OwnTrack&, JointServo&, SelfPositioning&, std::vector<int>, int,
                      double, double>(),
             nb::arg("filter"), nb::arg("track"), nb::arg("servo"), nb::arg("ankles"),
             nb::kw_only(), nb::arg("qadr"), nb::arg("period"), nb::arg("touch"),
             nb::arg("shift_share"), nb::keep_alive<1, 2>(), nb::keep_alive<1, 3>(),
             nb::keep_alive<1, 4>(), nb::keep_alive<1, 5>())
        .def("command", [](Follower& self, In q, In force, nb::handle owner) {
            want(q.size() == self.filter.q.size() && force.size() == self.filter.load.size(),
                 "a measurement of this robot");
            self.step(q.data(), force.data(), owner);
            return own(Reals(self.command));
        })
        .def_rw("scale", &Follower::scale)
        .def_rw("ends", &Follower::ends)
        .def_ro("steps", &Follower::step_count)
        .def_prop_ro("goal", [](nb::handle_t<Follower> self) {
            auto& f = nb::cast<Follower&>(self);
            return view(f.goal.data(), {f.goal.size()}, self);
        })
        .def_prop_ro("commanded", [](nb::handle_t<Follower> self) {
            auto& f = nb::cast<Follower&>(self);
            return view(f.commanded.data(), {size_t(f.step_count), f.track.q.size()}, self);
        });
    nb::class_<Sensors>(m, "Sensors")
        .def(nb::init<int, int, int, int, int>(), nb::kw_only(), nb::arg("nq"),
             nb::arg("surfaces"), nb::arg("late"), nb::arg("force_stride"), nb::arg("block"))
        .def("draw", [](Sensors& self, In offset, In tilt, In gain, In pull) {
            const auto copy = [](const In& x) { return Reals(x.data(), x.data() + x.size()); };
            want(self.fits(offset.size(), tilt.size(), gain.size(), pull.size()),
                 "noise of a block");
            self.draw({copy(offset), copy(tilt), copy(gain), copy(pull)});
        })
        .def("read", [](Sensors& self, In qpos, In force) {
            self.read(qpos.data(), force.data());
            return nb::make_tuple(own(Reals(self.q, self.q + qpos.size())),
                                  own(Reals(self.force, self.force + force.size()),
                                      {force.size() / 3, 3}));
        });
    nb::class_<ContactForces>(m, "ContactForces")
        .def(nb::init<std::vector<int>, int>(), nb::arg("row_of_geom"), nb::arg("surfaces"))
        .def("update", [](ContactForces& self, nb::handle data) {
            self.update(ListedContacts(data).all());
        })
        .def_prop_ro("surface", [](nb::handle_t<ContactForces> self) {
            auto& f = nb::cast<ContactForces&>(self);
            return view(f.surface.data(), {f.surface.size() / 3, 3}, self);
        });
    nb::class_<Loop>(m, "Loop")
        .def(nb::init<nb::handle, Follower&, Sensors&, ContactForces&, std::vector<int>, double,
                      int, int, int, double, double, std::optional<In>, int>(),
             nb::arg("data"), nb::arg("follower"), nb::arg("sensors"), nb::arg("forces"),
             nb::kw_only(), nb::arg("order"), nb::arg("step_size"), nb::arg("base"),
             nb::arg("stride"), nb::arg("tail"),
             nb::arg("tilt"), nb::arg("height"), nb::arg("push").none(), nb::arg("steps"),
             nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(), nb::keep_alive<1, 5>())
        .def("step", &Loop::step)
        .def("recorded", &Loop::recorded)
        .def_ro("count", &Loop::count)
        .def_ro("fell", &Loop::fell);
    m.attr("SCENE") = ContactForces::kScene;
    m.attr("OTHER") = ContactForces::kOther;
    m.def("load_is_missing", [](In load, double weight, double share) {
        return load_is_missing(load.data(), int(load.size() / 3), weight, share);
    }, nb::arg("load"), nb::arg("weight"), nb::arg("share"));
    m.def("hit_sideways", [](In load, double least) {
        std::vector<int> rows;
        for (size_t s = 0; s < load.size() / 3; ++s)
            if (is_sideways(load.data() + 3 * s, least)) rows.push_back(int(s));
        return rows;
    }, nb::arg("load"), nb::arg("least"));
    m.def("has_fallen", [](In q, In reference, double tilt, double height) {
        want(q.size() >= 7 && reference.size() >= 7, "configurations");
        return has_fallen(q.data(), reference.data(), tilt, height);
    });
}

}  // namespace clamber
