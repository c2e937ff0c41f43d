"""Seconds of a whole plan by stage: the built-in climb, one box, the method `direct`.

    python benchmarks/bench_plan.py

Prints the median of five plans after one to warm up, and the peak memory.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time

from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.planning.planner import plan
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo

HEIGHT = 0.275  # [m]
REPEATS = 5


def peak_memory() -> float:
    """Of this process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def main() -> None:
    sequence, robot = detect_contacts(load_demo("climb")), load_robot("coman")
    scene = Scene.from_height(HEIGHT)
    result = plan(sequence, robot, scene)
    runs: list[dict[str, float]] = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        result = plan(sequence, robot, scene)
        runs.append({**result.timings, "total": time.perf_counter() - start})
    seconds = result.trajectory.time[-1] if result.trajectory else 0.0
    print(
        f"climb onto {HEIGHT} m, {len(result.changes)} contact changes, {seconds:.0f} s"
        f" of motion, {'complete' if result.complete else 'INCOMPLETE'}"
    )
    print(f"{'stage':14}{'median [s]':>12}{'min':>8}{'max':>8}")
    for stage in runs[0]:
        took = [run.get(stage, 0.0) for run in runs]
        print(
            f"{stage:14}{statistics.median(took):12.3f}{min(took):8.3f}{max(took):8.3f}"
        )
    total = statistics.median(r["total"] for r in runs)
    per_change = total / max(len(result.changes), 1)
    print(f"{'per change':14}{per_change:12.3f}")
    print(f"peak memory {peak_memory():.0f} MB")


if __name__ == "__main__":
    main()
