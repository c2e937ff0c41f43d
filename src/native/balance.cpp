// The centre of mass near the border of its support: where to move it.
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include "bindings.h"
#include "model.h"
#include "polygon.h"

namespace clamber {

namespace {

// The centre of mass near the border of its support: where to move it, from how far it
// is from its plan, seen from the points that bear.
class Balance {
public:
    struct Law {
        double sag;               // [m] less than the planned margin is no danger
        double p, d, t, most;     // gain, [s] of rate and integral, [m] bound
        double smoothing, settled;  // [s] of the deviation, [m] that is nothing
        double period;            // [s]
    };
    explicit Balance(const Law& law) : law_(law) {}
    struct Seen {
        double com[2] = {0.0, 0.0}, margin = 0.0;  // from the middle of the points
        std::vector<std::array<double, 2>> points;
    };
    // Of the points (n, 2) that bear load.
    void see(const double (*points)[2], int n, const double* com, Seen& out) const;
    // False where there is nothing to move; else `shift` is where to.
    bool feed_back(const Seen& now, const Seen& planned);

    double high = 0.0, fade = 1.0;  // [m] margin at which it sets in, and within how much
    double shift[2] = {0.0, 0.0};

private:
    Law law_;
    double deviation_[2] = {0.0, 0.0}, integral_[2] = {0.0, 0.0};
};

void Balance::see(const double (*points)[2], int n, const double* com, Seen& out) const {
    Polygon polygon;
    support_polygon(points, n, polygon);
    out.margin = com_margin(com[0], com[1], polygon);
    double middle[2] = {0.0, 0.0};
    for (int i = 0; i < n; ++i)
        for (int a = 0; a < 2; ++a) middle[a] += points[i][a] / n;
    out.points.clear();
    for (int i = 0; i < n; ++i)
        out.points.push_back({points[i][0] - middle[0], points[i][1] - middle[1]});
    for (int a = 0; a < 2; ++a) out.com[a] = com[a] - middle[a];
}

bool Balance::feed_back(const Seen& now, const Seen& planned) {
    // The contacts may be turned from where they were planned, all together.
    double c = 0.0, s = 0.0;
    for (size_t i = 0; i < now.points.size(); ++i) {
        const auto &a = now.points[i], &b = planned.points[i];
        c += a[0] * b[0] + a[1] * b[1];
        s += a[0] * b[1] - a[1] * b[0];
    }
    const double n = std::hypot(c, s);
    c = n > 0 ? c / n : 1.0, s = n > 0 ? s / n : 0.0;
    const double e[2] = {c * now.com[0] - s * now.com[1] - planned.com[0],
                         s * now.com[0] + c * now.com[1] - planned.com[1]};
    const double inside = std::min(high, planned.margin - law_.sag) - now.margin;
    const double w = std::clamp(inside / fade, 0.0, 1.0);
    double move[2];
    for (int a = 0; a < 2; ++a) {
        const double rate = (e[a] - deviation_[a]) / (law_.smoothing + law_.period);
        deviation_[a] += law_.period * rate;
        // Where it is not needed it fades.
        integral_[a] -=
            law_.period / law_.t * (w * deviation_[a] + (1.0 - w) * integral_[a]);
        move[a] = integral_[a] - w * (law_.p * deviation_[a] + law_.d * rate);
    }
    const auto bounded = [this](double* x) {
        const double share = law_.most / std::max(std::hypot(x[0], x[1]), law_.most);
        x[0] *= share, x[1] *= share;
    };
    bounded(integral_);
    bounded(move);
    std::copy_n(move, 2, shift);
    if (w > 0.0 || std::hypot(integral_[0], integral_[1]) >= law_.settled) return true;
    integral_[0] = integral_[1] = 0.0;
    return false;
}

// Balance on points of links.
struct BalanceOf {
    BalanceOf(const std::shared_ptr<const Model>& model, const Balance::Law& law)
        : model(model), kin(*model), balance(law) {}

    void hold(std::vector<int> on, In local, In sole, double high, double fade) {
        want(local.size() == 3 * on.size() && sole.size() == local.size(),
             "a link, a place on it and one from there for each point");
        bodies = std::move(on);
        points.clear();
        for (size_t i = 0; i < bodies.size(); ++i) {
            want(bodies[i] >= 0 && size_t(bodies[i]) < model->bodies.size(), "links");
            points.emplace_back(read3(local.data() + 3 * i), read3(sole.data() + 3 * i));
        }
        places.resize(points.size());
        balance.high = high, balance.fade = fade;
    }
    void look(In q, Balance::Seen& out) {
        want(q.size() == size_t(model->nq), "a posture");
        kin.update(q.data());
        for (size_t i = 0; i < points.size(); ++i) {
            const Vec3 p = kin.point(bodies[i], points[i].first) + points[i].second;
            places[i] = {p.x, p.y};
        }
        double com[3];
        write3(kin.com(), com);
        balance.see(reinterpret_cast<const double(*)[2]>(places.data()), int(places.size()),
                    com, out);
    }
    bool update(In q, In reference) {
        look(q, now);
        look(reference, planned);
        return balance.feed_back(now, planned);
    }

    std::shared_ptr<const Model> model;
    Kinematics kin;
    Balance balance;
    std::vector<int> bodies;
    std::vector<std::pair<Vec3, Vec3>> points;
    std::vector<std::array<double, 2>> places;
    Balance::Seen now, planned;
};

}  // namespace

void bind_balance(nb::module_& m) {
    nb::class_<BalanceOf>(m, "Balance")
        .def("__init__", [](BalanceOf* self, const std::shared_ptr<const Model>& model,
                            double sag, double p, double d, double t, double most,
                            double smoothing, double settled, double period) {
            new (self) BalanceOf(model, {sag, p, d, t, most, smoothing, settled,
                                         period});
        }, nb::arg("model"), nb::kw_only(), nb::arg("sag"),
           nb::arg("p"), nb::arg("d"), nb::arg("t"), nb::arg("most"), nb::arg("smoothing"),
           nb::arg("settled"), nb::arg("period"))
        .def("hold", &BalanceOf::hold, nb::arg("bodies"), nb::arg("local"), nb::arg("sole"),
             nb::kw_only(), nb::arg("high"), nb::arg("fade"))
        .def("update", &BalanceOf::update, nb::arg("q"), nb::arg("reference"))
        .def_prop_ro("shift", [](BalanceOf& self) {
            return nb::cast(new_array(self.balance.shift, {2}));
        });
}

}  // namespace clamber
