// Random and degenerate problems for the native core: the same ones for the same seed, so
// that a case that fails can be run alone.
#pragma once

#include <cstdint>
#include <cstring>

namespace clamber::fuzz {

// How bad the numbers of a case are.
enum class Mood {
    TAME,        // metres and kilogrammes of a robot
    DEGENERATE,  // many zeros, ones and repetitions: what coincides, is flat or has no size
    WILD,        // tiny and huge numbers, infinities, NaN too
};

class Random {  // splitmix64
public:
    Random(std::uint64_t seed, Mood mood) : mood(mood), state_(seed) {}

    const Mood mood;

    std::uint64_t bits() {
        std::uint64_t z = (state_ += 0x9e3779b97f4a7c15ULL);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
        return z ^ (z >> 31);
    }
    int below(int n) { return static_cast<int>(bits() % static_cast<std::uint64_t>(n)); }
    int between(int low, int high) { return low + below(high - low + 1); }
    bool one_in(int n) { return below(n) == 0; }
    double uniform(double low, double high) {
        return low + (high - low) * (static_cast<double>(bits() >> 11) * 0x1p-53);
    }

    // A coordinate, as the mood has them: of the size of `scale` while they are tame.
    double number(double scale = 1.0) {
        if (mood == Mood::DEGENERATE && !one_in(3)) return scale * (below(5) - 2) * 0.5;
        if (mood == Mood::WILD && one_in(6)) {
            static constexpr double WORST[] = {0.0,    -0.0,   5e-324, 1e-300, 1e-160, 1e-18,
                                               1e9,    1e18,   1e160,  1.7e308, -1.7e308,
                                               INF,    -INF,   NO_NUMBER};
            return WORST[below(sizeof WORST / sizeof *WORST)];
        }
        return uniform(-scale, scale);
    }
    // A length or a weight: not negative while the numbers are tame.
    double size(double scale = 1.0) {
        const double x = number(scale);
        return mood == Mood::WILD || x >= 0.0 ? x : -x;
    }

private:
    static constexpr double INF = __builtin_inf(), NO_NUMBER = __builtin_nan("");
    std::uint64_t state_;
};

// What a case gave: its bits, which must be the same the second time, and what is wrong.
class Outcome {
public:
    std::uint64_t hash = 0xcbf29ce484222325ULL;
    bool solved = false;  // there was an answer, not only a refusal

    void saw(int x) { mix(static_cast<std::uint64_t>(x)); }
    // NaN has many bits, all of them the same to us.
    void saw(double x) {
        if (x != x) x = __builtin_nan("");
        std::uint64_t bits;
        std::memcpy(&bits, &x, sizeof bits);
        mix(bits);
    }
    void saw(const double* x, int count) {
        for (int i = 0; i < count; ++i) saw(x[i]);
    }
    // Tells of a broken promise, once for each sentence.
    static void expect(bool kept, const char* promise) {
        if (!kept) broken(promise);
    }

private:
    void mix(std::uint64_t bits) { hash = (hash ^ bits) * 0x9e3779b97f4a7c15ULL ^ (hash >> 29); }
    static void broken(const char* promise);
};

// One part of the core: makes one problem and looks at what comes out.
struct Part {
    const char* name;
    void (*run)(Random&, Outcome&);
};

void polygon(Random& random, Outcome& outcome);
void qp(Random& random, Outcome& outcome);
void statics(Random& random, Outcome& outcome);
void geometry(Random& random, Outcome& outcome);
void proximity(Random& random, Outcome& outcome);
void posture(Random& random, Outcome& outcome);
void path(Random& random, Outcome& outcome);
void timing(Random& random, Outcome& outcome);
void planes(Random& random, Outcome& outcome);

constexpr Part PARTS[] = {
    {"polygon", polygon},
    {"qp", qp},
    {"statics", statics},
    {"geometry", geometry},
    {"proximity", proximity},
    {"posture", posture},
    {"path", path},
    {"timing", timing},
    {"planes", planes},
};

}  // namespace clamber::fuzz
