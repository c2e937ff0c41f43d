// fuzz [problems of each part] [seed] [part] [first problem]: throws them at the core.
// Ends with a line for each part; with 1 where a promise was broken. A crash, or a problem
// that takes more than ten seconds, tells how to run it alone.
#include <signal.h>
#include <sys/time.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>

#include "fuzz.h"

namespace clamber::fuzz {

namespace {

struct {
    const char* part = "";
    long long seed = 0, problem = 0;
} now;

long broken_promises = 0;

void tell_where() {
    char line[160];
    const int size = std::snprintf(line, sizeof line, "alone: fuzz 1 %lld %s %lld\n", now.seed,
                                   now.part, now.problem);
    if (write(STDERR_FILENO, line, static_cast<std::size_t>(size)) < 0) _exit(2);
}

void on_tick(int) {
    static long long last = -1;
    if (now.problem == last) {
        constexpr char WORDS[] = "a problem without end\n";
        if (write(STDERR_FILENO, WORDS, sizeof WORDS - 1) < 0) _exit(2);
        tell_where();
        _exit(1);
    }
    last = now.problem;
}

Outcome once(const Part& part, long long seed, long long problem) {
    const auto of_problem = static_cast<std::uint64_t>(problem);
    std::uint64_t mixed = Random(static_cast<std::uint64_t>(seed), Mood::TAME).bits();
    mixed = Random(mixed ^ of_problem, Mood::TAME).bits();
    Random random(mixed, static_cast<Mood>(problem % 3));
    Outcome outcome;
    part.run(random, outcome);
    return outcome;
}

void run(const Part& part, long long count, long long seed, long long first) {
    now.part = part.name;
    now.seed = seed;
    long long solved = 0;
    const long before = broken_promises;
    for (long long i = first; i < first + count; ++i) {
        now.problem = i;
        const Outcome outcome = once(part, seed, i);
        Outcome::expect(outcome.hash == once(part, seed, i).hash, "the same bits again");
        solved += outcome.solved;
    }
    std::printf("%-10s %lld problems, %lld with an answer, %ld broken promises\n", part.name,
                count, solved, broken_promises - before);
    std::fflush(stdout);
}

}  // namespace

void Outcome::broken(const char* promise) {
    static std::map<std::string, int> told;
    ++broken_promises;
    if (told[std::string(now.part) + promise]++ > 0) return;
    std::fprintf(stderr, "%s: not kept: %s\n", now.part, promise);
    tell_where();
}

int main(int argc, char** argv) {
    const long long count = argc > 1 ? std::atoll(argv[1]) : 10000;
    const long long seed = argc > 2 ? std::atoll(argv[2]) : 0;
    const std::string only = argc > 3 ? argv[3] : "";
    const long long first = argc > 4 ? std::atoll(argv[4]) : 0;
    signal(SIGABRT, [](int) { tell_where(); });  // how both sanitizers end (make fuzz)
    signal(SIGPROF, on_tick);
    const itimerval every{{10, 0}, {10, 0}};
    setitimer(ITIMER_PROF, &every, nullptr);
    for (const Part& part : PARTS)
        if (only.empty() || only == part.name) run(part, count, seed, first);
    return broken_promises > 0;
}

}  // namespace clamber::fuzz

int main(int argc, char** argv) { return clamber::fuzz::main(argc, argv); }
