// The postures of one contact change: weight shift, new contact, and the way between.
#pragma once

#include <vector>

#include "holding.h"
#include "ik.h"

namespace clamber {

constexpr double CLEARANCE = 0.010;  // [m] p_safe: between links, and links and the scene
constexpr double FURTHER_CLEARANCE = 0.004;  // [m] a shin beside its knee
constexpr double COM_WEIGHT = 0.3;       // of the middle of the polygon, while weight shifts
constexpr double ELLIPSE_WEIGHT = 2.0;   // ... and of its ellipse (4.28)
constexpr double LEAST_ROOM = 0.020;     // [m] of the centre of mass, from what joints bear
constexpr double DRIFT_LIMIT = 0.01;     // [m] of contacts, anywhere on the path
constexpr double OVERLAP_LIMIT = 0.004;  // [m] of links, anywhere on the path

using Postures = std::vector<std::vector<double>>;  // each (nq)

// What moves one contact: its postures are known, the way between them is not.
struct Transition {
    std::vector<double> before, shifted, touching, after;
    std::vector<Contact> held, rolling;  // that stay; that are broken, as they are let go
    bool makes = false;
    Contact made;
    double margin = 0.0;  // of the centre of mass to the border of its polygon [m]
    bool adapt = true;    // push control points away from collisions (4.30)
};

struct Path {
    enum class Status : int { Solved = 0, Opens = 1, Overlaps = 2, Weak = 3 };

    std::array<Postures, 3> phases;  // shift, swing, settle
    std::vector<Vec3> control;       // of the arc (4.29)
    Status status = Status::Solved;
    int phase = 0;            // in which it fails
    double depth = 0.0;       // of the deepest overlap [m], or how far a contact opens
    int pair = -1;            // that overlaps
    std::vector<double> weak;  // (nq) the first posture of a swing that cannot be held

    void forget() {  // what was wrong
        status = Status::Solved;
        phase = 0;
        depth = 0.0;
        pair = -1;
        weak.clear();
    }
};

class PathPlanner {
  public:
    explicit PathPlanner(const Model& model);

    // Where there is none, the phases are as far as they were found.
    void plan(const Transition& t, Path& out);
    // All old contacts closed, the weight on those that stay; broken ones roll onto their
    // edges. The hint is a posture that solves a similar problem, or none. Whether the
    // posture was found and can be held.
    bool shift(Transition& t, const double* hint, Solution& out);
    // The same with the weight shifted and the new contact closed, not loaded.
    bool touch(Transition& t, const double* hint, Solution& out);
    // A flat contact on the edge that lies farthest towards a point, others as they are.
    Contact rolled(const Contact& c, const Vec3& towards, const double* q);
    // What is wrong with the phases of a path.
    void check(const Transition& t, Path& out);
    // Postures from a to b with all contacts closed, near the straight way.
    void bridge(const std::vector<double>& a, const std::vector<double>& b,
                const std::vector<Contact>& contacts, Postures& out);
    // Whether contact forces and torques that are counted on hold the robot at `q`.
    bool is_stable(const std::vector<Contact>& contacts, const double* q);
    // The same, to be asked more.
    Holding& look(const std::vector<Contact>& contacts, const double* q);
    // (na) torques that hold it there, a force at each contact at its price; against a
    // generalised force (nv) besides its weight, or none.
    void holding_torques(const std::vector<Contact>& contacts, const double* price,
                         const double* q, const double* inertia, double* tau);

    Solver solver;

  private:
    struct Node {
        double share;
        std::vector<double> q;
    };
    // Balance on contacts that bear load, with others in contact, near a posture.
    void ask_balance(const std::vector<Contact>& loaded,
                     const std::vector<Contact>& unloaded, double margin,
                     double posture_weight);
    // Moves the centre of mass to where joints are strong enough to keep its margin, too,
    // or as near to that as is found. Whether they hold it with `LEAST_ROOM` in the end.
    bool strengthen(const std::vector<Contact>& contacts, Solution& out);
    double border();
    void swing(const Transition& t, Path& out);
    void swing_node(const Transition& t, const std::vector<Vec3>& control, double share,
                    const std::vector<double>& last, bool between, std::vector<double>& q);
    void solve_node(const std::vector<double>& from, const std::vector<double>& other,
                    std::vector<double>& q);
    template <typename Fill>
    void fill(const std::vector<double>& a, const std::vector<double>& b, int points,
              const std::vector<Contact>& contacts, const std::vector<Contact>& moving,
              bool refine, Fill node, Postures& out);
    bool check_phase(const Transition& t, const std::vector<Contact>& contacts, int k,
                     Path& out);
    void watch(const std::vector<Contact>& contacts, const std::vector<Contact>& more,
               std::vector<unsigned char>& out) const;
    double overlap(const double* q, const std::vector<unsigned char>& watched, int* pair);
    double drift(const std::vector<Contact>& contacts);
    void between(const std::vector<double>& a, const std::vector<double>& b, double share,
                 std::vector<double>& out);
    void near_ends(const Transition& t);

    const Model& model_;
    Holding holding_;
    Problem problem_;
    Solution first_, second_;
    std::vector<double> tangent_, reference_, clearance_;
    std::vector<unsigned char> aloft_, low_;
    bool strained_ = false;  // a joint, at an end of the swing
    Vec3 com_[2];            // at the ends of the swing
    Vec3 turn_;              // of a sole in the swing, to `made_rotation_`
    Quat made_rotation_;
    struct Eased {
        int pair;
        double distance;
    };
    std::array<std::vector<Eased>, 2> ends_;  // near the supports, at lift-off, touch-down
};

// Unit vector from a new contact at p2, which comes from p1, to the mass that it will
// support (4.26, 4.27): leaning towards where it comes from.
Vec3 lean_direction(const Vec3& p1, const Vec3& p2, const Mat3& R_WB);
// A task that closes a contact in its place.
SurfaceTask closed_task(const Model& model, const Contact& c);
// Height of a support's highest point below the way from p1 to p2; that of its origin where
// the way passes it by, or it is level.
double highest(const Support& support, const Vec3& p1, const Vec3& p2);
// Control points of the arc from p1 to p2 (4.29).
void arc(const Vec3& p1, const Vec3& p2, double top, bool on_top, int points, double scale,
         std::vector<Vec3>& out);

}  // namespace clamber
