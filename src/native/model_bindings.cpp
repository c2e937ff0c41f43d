// A robot in a scene as Python hands it over.
#include <nanobind/stl/string.h>

#include <memory>
#include <stdexcept>

#include "bindings.h"
#include "model.h"

namespace clamber {

namespace {

template <typename T>
nb::ndarray<const T, nb::c_contig, nb::device::cpu> column(const nb::dict& d,
                                                           const char* name) {
    return nb::cast<nb::ndarray<const T, nb::c_contig, nb::device::cpu>>(d[name]);
}

template <typename T>
std::vector<T> list(const nb::dict& d, const char* name) {
    const auto a = column<T>(d, name);
    return {a.data(), a.data() + a.size()};
}

Touching touching_from(const double* corners, int n) {
    Touching out;
    out.corners = n;
    for (int k = 0; k < n; ++k) {
        out.corner[k] = read3(corners + 3 * k);
        out.centre += out.corner[k] * (1.0 / n);
    }
    return out;
}

// Built from what `clamber.model.core` hands over.
Model read_model(const nb::dict& d) {
    Model m;
    m.nq = nb::cast<int>(d["nq"]);
    m.nv = nb::cast<int>(d["nv"]);
    m.base = nb::cast<int>(d["base"]);
    m.mass = nb::cast<double>(d["mass"]);
    m.length_scale = nb::cast<double>(d["length_scale"]);
    const auto parent = column<int>(d, "body_parent");
    const auto body_pos = column<double>(d, "body_pos"), body_quat = column<double>(d, "body_quat");
    const auto mass = column<double>(d, "body_mass"), ipos = column<double>(d, "body_ipos");
    const auto first = column<int>(d, "body_joint"), count = column<int>(d, "body_joints");
    for (std::size_t b = 0; b < parent.size(); ++b)
        m.bodies.push_back({parent.data()[b], read3(body_pos.data() + 3 * b),
                            readq(body_quat.data() + 4 * b), mass.data()[b],
                            read3(ipos.data() + 3 * b), first.data()[b], count.data()[b]});
    const auto kind = column<int>(d, "joint_kind"), joint_body = column<int>(d, "joint_body");
    const auto qadr = column<int>(d, "joint_qadr"), dadr = column<int>(d, "joint_dadr");
    const auto axis = column<double>(d, "joint_axis"), anchor = column<double>(d, "joint_pos");
    const auto zero = column<double>(d, "joint_zero");
    for (std::size_t j = 0; j < kind.size(); ++j)
        m.joints.push_back({static_cast<JointKind>(kind.data()[j]), joint_body.data()[j],
                            qadr.data()[j], dadr.data()[j], read3(axis.data() + 3 * j),
                            read3(anchor.data() + 3 * j), zero.data()[j]});
    const auto shape = column<int>(d, "geom_shape"), geom_body = column<int>(d, "geom_body");
    const auto geom_pos = column<double>(d, "geom_pos"), geom_quat = column<double>(d, "geom_quat");
    const auto size = column<double>(d, "geom_size");
    const auto vertices = nb::cast<nb::list>(d["geom_vertices"]);
    for (std::size_t g = 0; g < shape.size(); ++g) {
        std::vector<Vec3> hull;
        const auto points = nb::cast<Array2<>>(vertices[g]);
        for (std::size_t k = 0; k < points.shape(0); ++k)
            hull.push_back(read3(points.data() + 3 * k));
        m.geoms.push_back({geom_body.data()[g], read3(geom_pos.data() + 3 * g),
                           readq(geom_quat.data() + 4 * g),
                           make_shape(static_cast<ShapeKind>(shape.data()[g]),
                                      read3(size.data() + 3 * g), std::move(hull))});
    }
    const auto pairs = column<int>(d, "pairs");
    for (std::size_t i = 0; i + 1 < pairs.size(); i += 2)
        m.pairs.push_back({pairs.data()[i], pairs.data()[i + 1]});
    for (const nb::handle h : nb::cast<nb::list>(d["supports"])) {
        const auto s = nb::cast<nb::dict>(h);
        Support out;
        out.position = read3(column<double>(s, "position").data());
        const Mat3 R = read9(column<double>(s, "rotation").data());
        out.x = R.col(0), out.y = R.col(1), out.normal = R.col(2);
        out.friction = nb::cast<double>(s["friction"]);
        out.geom = nb::cast<int>(s["geom"]);
        const auto A = column<double>(s, "A");
        out.b = list<double>(s, "b");
        for (std::size_t k = 0; k < out.b.size(); ++k) out.A.push_back(read3(A.data() + 3 * k));
        m.supports.push_back(std::move(out));
    }
    for (const nb::handle h : nb::cast<nb::list>(d["surfaces"])) {
        const auto s = nb::cast<nb::dict>(h);
        Surface out;
        out.body = nb::cast<int>(s["body"]);
        out.radius = nb::cast<double>(s["radius"]);
        const auto corners = column<double>(s, "corners");
        const int n = static_cast<int>(corners.size() / 3);
        out.whole = touching_from(corners.data(), n);
        out.whole.centre = read3(column<double>(s, "centre").data());
        out.flat = nb::cast<bool>(s["flat"]);
        if (out.flat) {
            out.rotation = quat_from_matrix(read9(column<double>(s, "rotation").data()));
            for (int k = 0; k < n; ++k) {
                double ends[6];
                std::copy_n(corners.data() + 3 * k, 3, ends);
                std::copy_n(corners.data() + 3 * ((k + 1) % n), 3, ends + 3);
                out.edges.push_back(touching_from(ends, 2));
            }
        }
        out.mass_body = nb::cast<int>(s["mass_body"]);
        out.mass_point = read3(column<double>(s, "mass_point").data());
        m.touching.emplace_back();
        for (const nb::handle t : nb::cast<nb::list>(s["touching"])) {
            const auto both = nb::cast<nb::dict>(t);
            m.touching.back().push_back(
                {list<int>(both, "planned"), list<int>(both, "further")});
        }
        m.surfaces.push_back(std::move(out));
    }
    m.qadr = list<int>(d, "qadr");
    m.dadr = list<int>(d, "dadr");
    m.q_min = list<double>(d, "q_min");
    m.q_max = list<double>(d, "q_max");
    m.tau_max = list<double>(d, "tau_max");
    if (!m.finish()) throw std::invalid_argument("bodies come after their parents");
    return m;
}

}  // namespace

void bind_model(nb::module_& m) {
    nb::class_<std::shared_ptr<const Model>>(m, "Model", "Constants of a robot in a scene.")
        .def("__init__", [](std::shared_ptr<const Model>* self, const nb::dict& d) {
            new (self) std::shared_ptr<const Model>(
                std::make_shared<const Model>(read_model(d)));
        });
}

}  // namespace clamber
