// Random robots between two supports, and what they are asked.
#pragma once

#include <vector>

#include "fuzz.h"
#include "path.h"

namespace clamber::fuzz {

Vec3 vector(Random& random, double scale);
Quat turn(Random& random);
Model robot(Random& random);
std::vector<double> posture(Random& random, const Model& m);
Contact contact(Random& random, const Model& m);

// Most random problems have no answer. Here one has: at a posture within its limits, that of
// a strong robot whose parts may pass each other, two surfaces lie on supports without end.
struct Answer {
    std::vector<double> q;
    std::vector<Contact> contacts;
};

Answer with_answer(Random& random, Model& m);

}  // namespace clamber::fuzz
