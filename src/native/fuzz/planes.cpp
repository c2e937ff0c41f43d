#include "planes.h"

#include <vector>

#include "fuzz.h"

namespace clamber::fuzz {

namespace {

constexpr double REACH = 0.01, COSINE = 0.9;

// Strips of triangles one after the other, each across the one before.
struct Strips {
    std::vector<double> corners, normals, weights;
    std::vector<std::int32_t> first{0}, next, order, strip;

    Elements elements() const {
        return {static_cast<int>(strip.size()), 3,           corners.data(), normals.data(),
                weights.data(),                 first.data(), next.data(),   order.data()};
    }
};

Strips strips(Random& random) {
    Strips out;
    const int count = random.below(4);
    for (int s = 0; s < count; ++s) {
        const Vec3 origin{random.number(), random.number(), random.number()};
        Vec3 along, across, normal;
        along[s % 3] = across[(s + 1) % 3] = normal[(s + 2) % 3] = 1.0;
        const double noise = random.one_in(2) ? 0.0 : 1e-4;
        for (int j = random.between(1, 20); j > 0; --j) {
            for (int k = j; k < j + 3; ++k) {
                const Vec3 p = origin + along * (0.05 * k) + across * (0.1 * (k % 2)) +
                               normal * random.number(noise);
                out.corners.insert(out.corners.end(), {p.x, p.y, p.z});
            }
            out.normals.insert(out.normals.end(), {normal.x, normal.y, normal.z});
            out.weights.push_back(random.mood == Mood::TAME ? random.uniform(0.1, 1.0)
                                                            : random.size());
            out.strip.push_back(s);
        }
    }
    const int n = static_cast<int>(out.strip.size());
    for (int i = 0; i < n; ++i) {
        if (i > 0) out.next.push_back(i - 1);
        if (i + 1 < n) out.next.push_back(i + 1);
        if (random.mood == Mood::WILD && random.one_in(4)) out.next.push_back(random.below(n));
        out.first.push_back(static_cast<std::int32_t>(out.next.size()));
        out.order.push_back(i);
    }
    for (int i = 1; i < n; ++i) std::swap(out.order[i], out.order[random.below(i + 1)]);
    if (random.mood == Mood::WILD)
        for (double& x : out.normals) x = random.number();
    return out;
}

}  // namespace

void planes(Random& random, Outcome& outcome) {
    const Strips of = strips(random);
    const int n = static_cast<int>(of.strip.size());
    std::vector<std::int32_t> label(n);
    grow_planes(of.elements(), REACH, COSINE, label.data());
    int begun = 0;
    for (const int i : of.order) {  // where each region begins
        Outcome::expect(label[i] >= 0 && label[i] <= begun, "regions are numbered as they begin");
        begun += label[i] == begun;
        outcome.saw(label[i]);
    }
    outcome.solved = n > 0;
    if (random.mood == Mood::WILD) return;
    for (int i = 1; i < n; ++i)
        if (of.strip[i] != of.strip[i - 1])
            Outcome::expect(label[i] != label[i - 1], "no region goes round an edge");
        else if (random.mood == Mood::TAME)
            Outcome::expect(label[i] == label[i - 1], "what is flat and connected is one region");
}

}  // namespace clamber::fuzz
