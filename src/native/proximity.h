// Which of many pairs of shapes are near each other, asked again and again as they move.
#pragma once

#include <array>
#include <vector>

#include "geometry.h"

namespace clamber {

// A workspace. What was asked before decides which pairs are looked at, never an answer.
class Proximity {
 public:
    // `pairs` are of indices into `shapes`.
    Proximity(const std::vector<Shape>& shapes, const std::vector<std::array<int, 2>>& pairs);

    struct Near {
        int pair;
        Nearest at;
    };

    // Pairs nearer than `reach`, in order, and those whose distance is NaN; valid until
    // the next call.
    //
    // poses: of each shape. active: whether each pair counts; null: all do.
    const std::vector<Near>& query(const Pose* poses, double reach, const unsigned char* active);

    int shapes() const { return static_cast<int>(shapes_.size()); }
    int pairs() const { return static_cast<int>(pairs_.size()); }

 private:
    void note_moves(const Pose* poses);
    double gap(int a, int b, const Pose* poses) const;

    std::vector<Shape> shapes_;
    std::vector<std::array<int, 2>> pairs_;
    std::vector<double> least_;  // of each pair: at the poses seen it is no nearer than this
    std::vector<Pose> seen_;
    std::vector<double> moved_;  // since the poses before, the farthest point of each shape
    std::vector<Near> near_;
};

}  // namespace clamber
