// What a posture is asked for, and the rows of its QP at one configuration.
#pragma once

#include <vector>

#include "model.h"
#include "polygon.h"
#include "proximity.h"

namespace clamber {

constexpr double FAR = 1e30;             // no bound
constexpr double FLAT_WEIGHT = 0.3;      // of a flat surface's turn, against its place
constexpr double EDGE_INSET = 0.015;     // [m] contacts stay this far inside the border
constexpr double EDGE_RANGE = 0.15;      // [m] ... and have a row where they are nearer
constexpr double EDGE_ROOM = 0.045;      // [m] ... and round ones should, at no other cost
constexpr double BORDER_WEIGHT = 20.0;  // of the centre of mass, beyond other borders
constexpr double EDGE_WEIGHT = 3.0;
constexpr double ROUGHNESS_WEIGHT = 10.0;  // more distance from what is rough

enum class TaskKind : int { Closed = 0, OnEdge = 1, Sliding = 2, Reaching = 3 };

// A surface on, or on its way to, a support; as in `clamber.step.tasks`.
struct SurfaceTask {
    TaskKind kind = TaskKind::Closed;
    int surface = 0, support = 0, edge = -1;
    bool loaded = true, has_link = false;
    Vec3 position;
    Quat rotation;  // R_WC of a flat surface in contact
    Quat link;      // of the round surface's link where it touched at `position`
    double reference = 0.0, stability = 0.0, weight = 0.0;
};

// From the middle of one or two places to that of others, in a direction.
struct PointingTask {
    int starts = 1, ends = 1;
    std::array<int, 2> start_body{}, end_body{};
    std::array<Vec3, 2> start, end;
    Vec3 direction;
    double weight = 0.0;
};

struct Problem {
    std::vector<SurfaceTask> tasks;
    std::vector<PointingTask> pointing;
    std::vector<double> q_reference;
    std::vector<double> clearance;  // by pair; -inf where a pair does not count
    bool turned = false;            // towards `base_rotation`
    Quat base_rotation;
    double base_weight = 0.0;
    bool over = false;  // `com_target`; else the middle of the polygon
    std::array<double, 2> com_target{};
    double com_weight = 0.0;
    bool balance = true;
    struct Border {
        double x, y, b;  // (x, y) c <= b of the centre of mass c
    };
    std::vector<Border> borders;  // besides those of the polygon, as tasks
    double balance_margin = 0.0, ellipse_weight = 0.0, posture_weight = 0.0;
};

// Part of a row: what moves a body, as force and moment about the world's origin.
struct Lever {
    int body;
    Vec3 f, t;
};

// Rows `lo <= J dq <= hi`; their Jacobians are written only where a QP is built.
struct Block {
    int nv, n = 0;
    std::vector<double> J, lo, hi;

    explicit Block(int nv) : nv(nv) {}
    double* row(int i) { return J.data() + static_cast<std::size_t>(i) * nv; }
    const double* row(int i) const { return J.data() + static_cast<std::size_t>(i) * nv; }

  private:
    friend class Rows;
    struct Source {
        int first, count;
        Vec3 com;
    };
    std::vector<Source> source_;
};

// All rows of a posture's QP at one configuration.
//   soft:   J dq = -lo, in the least-squares sense, times their weights
//   closed: J dq = lo
//   kept:   lo <= J dq <= hi
class Rows {
  public:
    explicit Rows(const Model& model);

    // What each pair keeps besides its clearance; parts that were told to keep apart.
    std::vector<double> rough;
    std::vector<unsigned char> told;

    // Look at another problem: its pairs and what of them counts.
    void ask(const Problem& problem);
    // Put down what holds at the present posture; pairs farther than `reach` have no row.
    void look(Kinematics& kin, Proximity& near, const Problem& problem, double reach);
    // The Jacobians of all rows.
    void fill(Kinematics& kin);

    Block soft, closed, kept;
    double violation = 0.0;  // squared norm of what closed and kept ask for

    // Of each kept row, which it is: the pair, or its order among the others after those.
    std::vector<int> keys;

    // Points that bear load, and the polygon that they span.
    void bearing(const Kinematics& kin, const Problem& problem);
    Polygon polygon;
    std::vector<unsigned char> counts;  // by pair
    double farthest = 0.0;              // clearance of those

  private:
    void add(Block& block, double lo, double hi, const Vec3& com = {});
    void push(int body, const Vec3& f, const Vec3& t);
    void pull(int body, const Vec3& p, const Vec3& f) { push(body, f, cross(p, f)); }
    void want(double e, double weight, const Vec3& com = {});
    void close(double e);
    void at_most(double room, const Vec3& com = {});
    // A point stays inside the border of its support, or no farther out than `at`.
    void inside(int support, const Vec3& p, int body, const Vec3& moves,
                const Vec3* at = nullptr);
    void contact(const Kinematics& kin, const SurfaceTask& task);
    void point(const Kinematics& kin, const PointingTask& task);
    void balance(Kinematics& kin, const Problem& problem);
    void distances(Kinematics& kin, Proximity& near, const Problem& problem, double reach);

    const Model& model_;
    std::vector<Lever> levers_;
    Block* open_ = nullptr;  // block of the last row
    std::vector<unsigned char> apart_;
    double apart_reach_ = 0.0;
    struct Bearing {
        int body;  // -1 where the point stays put
        Vec3 centre;
    };
    std::vector<Bearing> bearing_;
    std::vector<std::array<double, 2>> places_;
};

// By how much a contact is open, or over the border of its support [m, rad].
double opened(const Kinematics& kin, const SurfaceTask& task);
// Unit vector along an edge of a flat surface that lay as `rotation` says.
Vec3 edge_axis(const Model& model, const SurfaceTask& task);

}  // namespace clamber
