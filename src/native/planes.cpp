// Planar regions of a surface that is given as many small elements and their neighbours.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "bindings.h"
#include "planes.h"

namespace clamber {

namespace {

constexpr int kSweeps = 12;  // of Jacobi's method: 3 x 3 needs about five

// Unit eigenvector of the smallest eigenvalue of a symmetric matrix.
Vec3 least_axis(Mat3 A) {
    Mat3 V;
    for (int sweep = 0; sweep < kSweeps; ++sweep)
        for (int p = 0; p < 2; ++p)
            for (int q = p + 1; q < 3; ++q) {
                if (A(p, q) == 0.0) continue;
                const double tau = (A(q, q) - A(p, p)) / (2.0 * A(p, q));
                const double t = (tau < 0 ? -1.0 : 1.0) / (std::abs(tau) + std::hypot(1.0, tau));
                const double c = 1.0 / std::hypot(1.0, t), s = t * c;
                for (int k = 0; k < 3; ++k) {
                    const double a = A(k, p), b = A(k, q);
                    A(k, p) = c * a - s * b, A(k, q) = s * a + c * b;
                }
                for (int k = 0; k < 3; ++k) {
                    const double a = A(p, k), b = A(q, k);
                    A(p, k) = c * a - s * b, A(q, k) = s * a + c * b;
                }
                for (int k = 0; k < 3; ++k) {
                    const double a = V(k, p), b = V(k, q);
                    V(k, p) = c * a - s * b, V(k, q) = s * a + c * b;
                }
            }
    int least = 0;
    for (int k = 1; k < 3; ++k)
        if (A(k, k) < A(least, least)) least = k;
    return V.col(least);
}

// The plane of what has been added: moments about the first point, which is near.
class Fit {
 public:
    Fit(const Vec3& origin, const Vec3& normal) : origin_(origin), normal_(normal) {}

    void add(const Vec3& point, const Vec3& normal, double weight) {
        const Vec3 x = point - origin_;
        weight_ += weight;
        sum_ += weight * x;
        normals_ += weight * normal;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) squares_(i, j) += weight * x[i] * x[j];
    }

    void refit() {
        const Vec3 mean = sum_ * (1.0 / weight_);
        Mat3 C;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                C(i, j) = squares_(i, j) / weight_ - mean[i] * mean[j];
        Vec3 n = least_axis(C);
        if (dot(n, normals_) < 0.0) n = -n;
        const double length = norm(n);
        if (length > 0.5 && dot(n, normals_) > 0.8 * norm(normals_)) normal_ = n * (1.0 / length);
        centre_ = mean;
    }

    double offset(const Vec3& p) const { return dot(p - origin_ - centre_, normal_); }
    const Vec3& normal() const { return normal_; }

 private:
    Vec3 origin_, normal_, centre_, sum_, normals_;
    Mat3 squares_{{0, 0, 0, 0, 0, 0, 0, 0, 0}};
    double weight_ = 0.0;
};

}  // namespace

void grow_planes(const Elements& of, double reach, double cosine, std::int32_t* label) {
    const auto corner = [&](int i, int j) { return read3(of.corners + 3 * (of.k * i + j)); };
    const auto normal = [&](int i) { return read3(of.normals + 3 * i); };
    std::fill_n(label, of.n, -1);
    std::vector<std::int32_t> queue;
    std::int32_t regions = 0;
    for (int o = 0; o < of.n; ++o) {
        const std::int32_t seed = of.order[o];
        if (label[seed] >= 0) continue;
        Fit plane(corner(seed, 0), normal(seed));
        const auto take = [&](std::int32_t i) {
            label[i] = regions;
            for (int j = 0; j < of.k; ++j)
                plane.add(corner(i, j), normal(i), of.weights[i] / static_cast<double>(of.k));
            queue.push_back(i);
        };
        queue.clear();
        take(seed);
        plane.refit();
        std::size_t refit = 4;
        for (std::size_t head = 0; head < queue.size(); ++head) {
            for (int e = of.first[queue[head]]; e < of.first[queue[head] + 1]; ++e) {
                const std::int32_t i = of.next[e];
                if (label[i] >= 0 || !(dot(plane.normal(), normal(i)) >= cosine)) continue;
                bool flat = true;
                for (int j = 0; flat && j < of.k; ++j)
                    flat = std::abs(plane.offset(corner(i, j))) <= reach;
                if (!flat) continue;
                take(i);
                if (queue.size() >= refit) {
                    plane.refit();
                    refit += refit / 2;
                }
            }
        }
        ++regions;
    }
}

namespace {

nb::ndarray<nb::numpy, std::int32_t> planes_of(
    const Array3<>& corners, const Array2<>& normals, const Array1<>& weights,
    const Array1<std::int32_t>& first, const Array1<std::int32_t>& next,
    const Array1<std::int32_t>& order, double reach, double cosine) {
    const std::size_t n = corners.shape(0), k = corners.shape(1);
    if (corners.shape(2) != 3 || k == 0 || normals.shape(0) != n || normals.shape(1) != 3 ||
        weights.shape(0) != n || first.shape(0) != n + 1 || order.shape(0) != n)
        throw std::invalid_argument("corners, a normal, a weight and neighbours for each");
    for (std::size_t i = 0; i < next.shape(0); ++i)
        if (next(i) < 0 || static_cast<std::size_t>(next(i)) >= n)
            throw std::invalid_argument("a neighbour that there is not");
    for (std::size_t i = 0; i < n; ++i)
        if (first(i) < 0 || first(i + 1) < first(i) || order(i) < 0 ||
            static_cast<std::size_t>(first(i + 1)) > next.shape(0) ||
            static_cast<std::size_t>(order(i)) >= n)
            throw std::invalid_argument("neighbours in order");
    const Elements of{static_cast<int>(n), static_cast<int>(k), corners.data(),
                      normals.data(),      weights.data(),      first.data(),
                      next.data(),         order.data()};
    std::vector<std::int32_t> label(n);
    {
        const nb::gil_scoped_release released;
        grow_planes(of, reach, cosine, label.data());
    }
    return new_array(label.data(), {n});
}

}  // namespace

void bind_planes(nb::module_& m) {
    m.def("grow_planes", planes_of, nb::arg("corners"), nb::arg("normals"),
          nb::arg("weights"), nb::arg("first"), nb::arg("next"), nb::arg("order"),
          nb::arg("reach"), nb::arg("cosine"));
}

}  // namespace clamber
