#include "polygon.h"

#include <algorithm>
#include <cmath>

#include "fuzz.h"

namespace clamber::fuzz {

namespace {

constexpr double GRID = 0x1p-29;  // twice what the hull rounds to

// What is asked of any polygon, a hull or not: it must end.
void ask(Random& random, Outcome& outcome, const Polygon& polygon) {
    double A[Polygon::CAPACITY][2], b[Polygon::CAPACITY], outward[2] = {0.0, 0.0};
    const int rows = halfplanes(polygon, A, b);
    for (int i = 0; i < rows; ++i) {
        outcome.saw(A[i], 2);
        outcome.saw(b[i]);
    }
    outcome.saw(nearest_border(random.number(), random.number(), polygon, outward));
    outcome.saw(outward, 2);
    if (polygon.n == 0) return;
    const Ellipse e = support_ellipse(polygon);
    outcome.saw(&e.centre[0], 2);
    outcome.saw(&e.semi_axes[0], 2);
    outcome.saw(&e.foci[0][0], 4);
    double gradient[2];
    outcome.saw(excess(e, random.number(), random.number(), gradient));
    outcome.saw(gradient, 2);
}

void check_hull(const Polygon& hull, const double (*points)[2], int n) {
    for (int i = 0; i < hull.n && hull.n > 2; ++i) {
        const double *p = hull.v[i], *q = hull.v[(i + 1) % hull.n], *r = hull.v[(i + 2) % hull.n];
        const double turn = (q[0] - p[0]) * (r[1] - q[1]) - (q[1] - p[1]) * (r[0] - q[0]);
        Outcome::expect(turn > 0.0, "a hull turns left at each vertex");
    }
    for (int i = 0; i < n; ++i)
        Outcome::expect(com_margin(points[i][0], points[i][1], hull) >= -2.0 * GRID,
                        "a hull contains its points");
    double A[Polygon::CAPACITY][2], b[Polygon::CAPACITY];
    const int rows = halfplanes(hull, A, b);
    for (int i = 0; i < rows; ++i) {
        Outcome::expect(std::abs(std::hypot(A[i][0], A[i][1]) - 1.0) < 1e-9, "normals are unit");
        for (int k = 0; k < hull.n; ++k)
            Outcome::expect(A[i][0] * hull.v[k][0] + A[i][1] * hull.v[k][1] <= b[i] + 1e-9,
                            "half-planes contain the vertices");
    }
    const Ellipse e = support_ellipse(hull);
    Outcome::expect(e.semi_axes[0] >= e.semi_axes[1] && e.semi_axes[1] >= 0.0,
                    "the longer semi-axis comes first");
    Outcome::expect(com_margin(e.centre[0], e.centre[1], hull) >= -1e-9,
                    "an ellipse's centre is inside");
    double gradient[2];
    Outcome::expect(excess(e, e.centre[0], e.centre[1], gradient) <= 1e-9,
                    "a centre is inside its ellipse");
    for (int k = 0; k < hull.n && hull.n > 2; ++k)
        Outcome::expect(excess(e, hull.v[k][0], hull.v[k][1], gradient) >= -1e-7,
                        "no vertex is inside the ellipse");
}

}  // namespace

void polygon(Random& random, Outcome& outcome) {
    double points[80][2];
    const int n = random.between(0, 80);
    const bool on_a_line = random.one_in(5);
    for (int i = 0; i < n; ++i) {
        points[i][0] = random.number();
        points[i][1] = on_a_line ? 0.3 * points[i][0] : random.number();
        if (i > 0 && random.one_in(8)) std::copy_n(points[random.below(i)], 2, points[i]);
    }
    Polygon hull;
    outcome.solved = support_polygon(points, n, hull);
    if (outcome.solved) {
        ask(random, outcome, hull);
        if (hull.n > 0 && random.mood != Mood::WILD) check_hull(hull, points, n);
    }
    // Vertices as they come, in no order.
    Polygon raw;
    raw.n = std::min(n, Polygon::CAPACITY);
    for (int i = 0; i < raw.n; ++i) std::copy_n(points[i], 2, raw.v[i]);
    ask(random, outcome, raw);
}

}  // namespace clamber::fuzz
