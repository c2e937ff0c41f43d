"""How the time and the memory of planning grow with the length of the box.

    python benchmarks/bench_traverse.py policy.json 0.5 1 2 4 8

Prints, for each length [m]: contact changes, CPU seconds, milliseconds a change, and
the peak memory of the process so far.
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np

import clamber

HEIGHT, WIDTH, FACE, BEYOND = 0.25, 0.8, 0.23, 0.25  # [m]


def main() -> None:
    """Plan one box after the other, the shortest first."""
    policy = clamber.load_policy(sys.argv[1])
    robot = clamber.load_robot("coman")
    sys.stdout.write("length  changes  CPU [s]  [ms]/change  peak [MB]  complete\n")
    for length in sorted(float(x) for x in sys.argv[2:]):
        box = clamber.Box(
            name="table",
            size=np.array([length, WIDTH, HEIGHT]),
            position=np.array([FACE + length / 2, 0.0, HEIGHT / 2]),
            rotation=np.eye(3),
        )
        goal = np.array([FACE + length + BEYOND, 0.0])
        scene = clamber.Scene(boxes=(box,), start=np.zeros(3), goal=goal)
        began = time.process_time()
        plan = clamber.plan_traverse(policy, robot, scene)
        spent = time.process_time() - began
        changes = max(len(plan.paths), 1)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        sys.stdout.write(
            f"{length:6.2f}  {changes:7d}  {spent:7.1f}  {1e3 * spent / changes:11.0f}"
            f"  {memory:9.0f}  {plan.complete}\n"
        )


if __name__ == "__main__":
    main()
