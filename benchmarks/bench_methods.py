"""The three ways to optimise contacts, on the built-in demonstration of a climb.

    python benchmarks/bench_methods.py [HEIGHT]

The contacts of the demonstration are detected once; then the whole climb onto a box of
that height [m] (0.275 by default) is planned with each method: CPU time of planning in
one thread (median of five, warm), iterations of each keyframe (of the contacts; QPs
with `direct`, which has no outer loop), and the stability cost of its new contact, sum
of w || X - S ||^2, at the demonstrated position and at the one found.
"""

from __future__ import annotations

import os
import sys
import time
from typing import get_args

import numpy as np

from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.planning.planner import plan
from clamber.planning.records import Plan, PlanOptions
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.step.methods import Method

REPEATS = 5


def table(result: Plan) -> None:
    print(f"  {'keyframe':34}{'iterations':>11}{'before':>9}{'after':>9}  status")
    for change in result.changes:
        key = change.keyframe
        print(
            f"  {change.step!s:34}{key.iterations:11d}"
            f"{key.cost_before:9.4f}{key.cost_after:9.4f}  {key.status.name.lower()}"
        )
    for failure in result.failures:
        print(f"  missed: {failure}")


def main() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    height = float(sys.argv[1]) if len(sys.argv) > 1 else 0.275
    robot, scene = load_robot("coman"), Scene.from_height(height)
    sequence = detect_contacts(load_demo("climb"))
    print(f"built-in climb, {robot.name}, a box of {height:g} m")
    rows = []
    for method in get_args(Method):
        options, took = PlanOptions(method=method), []
        result = plan(sequence, robot, scene, options=options)
        for _ in range(REPEATS):
            start = time.process_time()
            result = plan(sequence, robot, scene, options=options)
            took.append(time.process_time() - start)
        keys = result.keyframes[1:]
        print(f"\n{method}")
        table(result)
        costs = np.array([(k.cost_before, k.cost_after) for k in keys]).reshape(-1, 2)
        iterations = sum(k.iterations for k in keys)
        total = float(np.median(took))
        rows.append((method, total, len(keys), iterations, *costs.sum(axis=0)))
    print(f"\n{'method':10}{'plan':>9}{'made':>6}", end="")
    print(f"{'iterations':>12}{'before':>9}{'after':>9}")
    for method, total, made, iterations, before, after in rows:
        print(
            f"{method:10}{total:7.2f} s{made:6d}{iterations:12d}"
            f"{before:9.3f}{after:9.3f}"
        )


if __name__ == "__main__":
    main()
