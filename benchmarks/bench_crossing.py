"""Random boxes crossed in physics with one policy, row by row.

    python benchmarks/bench_crossing.py policy.json crossing.csv
    python benchmarks/bench_crossing.py policy.json plans.csv --plan

Row i is a box drawn from the generator of seed (SEED, i): length 0.5 to 2.0 m, width
0.6 to 1.2 m, height 0.20 to 0.31 m, its near face 0.26 m ahead of the robot, which
starts up to 0.1 m aside in x and y and turned by up to 10 degrees. Rows that the file
has are not run again, so that the experiment goes on where it was interrupted. With
`--plan` they are planned alone, with `--keep DIR` each run is kept as a folder. At the
end stands what the contact changes that were tried took, of CPU time.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from pathlib import Path

import numpy as np
from bench_plan import timed_changes

import clamber
from clamber.execution.events import Replanned
from clamber.execution.verdict import Figure

SEED = 2026
# [m] Of the box ahead of the robot, of the goal behind the box. With the start nearer
# by 0.1 m and turned, the toes are still clear of the box.
FACE, BEYOND = 0.26, 0.45
COLUMNS = (
    *("row", "length", "width", "height", "x", "y", "yaw"),
    *("planned", "changes", "plan_s_per_change"),
    *("reached", "motion_s", "planned_again", "to_goal", "effort", "why"),
)


def scene_of(row: int) -> clamber.Scene:
    """The box and the start of a row, to the millimetre and the tenth of a degree."""
    rng = np.random.default_rng([SEED, row])
    low = [0.5, 0.6, 0.20, -0.1, -0.1, -10.0]
    high = [2.0, 1.2, 0.31, 0.1, 0.1, 10.0]
    length, width, height, x, y = np.round(rng.uniform(low, high), 3)[:5]
    yaw = float(np.round(rng.uniform(-10.0, 10.0), 1))
    size = np.array([length, width, height])
    middle = np.array([FACE + length / 2, 0.0, height / 2])
    box = clamber.Box(name="table", size=size, centre=middle, rotation=np.eye(3))
    return clamber.Scene(
        boxes=(box,),
        start=np.array([x, y, math.radians(yaw)]),
        goal=np.array([FACE + length + BEYOND, 0.0]),
    )


def cross(
    policy: clamber.GeneralPolicy,
    robot: clamber.Robot,
    row: int,
    folder: Path | None,
    *,
    physics: bool,
) -> dict[str, object]:
    """What became of a row, by `COLUMNS`."""
    scene = scene_of(row)
    length, width, height = (float(f"{v:.3f}") for v in scene.boxes[0].size)
    x, y, yaw = scene.start
    out: dict[str, object] = {
        **{"row": row, "length": length, "width": width, "height": height},
        **{"x": float(x), "y": float(y), "yaw": round(math.degrees(yaw), 1)},
    }
    began = time.process_time()
    try:
        plan = clamber.plan(policy, robot, scene)
    except clamber.InputError as e:
        return out | {"planned": False, "reached": False, "why": str(e)}
    spent = time.process_time() - began
    changes = len(plan.changes)
    out |= {
        **{"planned": plan.complete, "changes": changes},
        "plan_s_per_change": f"{spent / max(changes, 1):.3f}",
        "why": plan.why_not,
    }
    if not (physics and plan.complete):
        return out
    rollout = clamber.simulate(plan)
    verdict = clamber.judge(plan, rollout)
    if folder is not None:
        clamber.save_plan(plan, folder)
        clamber.save_rollout(plan, rollout, folder)
        clamber.save_verdict(verdict, folder)
    c = verdict.criteria
    broken = [f"{k}: {v.value:.3g}" for k, v in c.items() if not v.ok]
    if not verdict.reached and rollout.events:
        broken.append(f"at {rollout.events[-1].time:.0f} s {rollout.events[-1]}")
    again = sum(isinstance(e, Replanned) for e in rollout.events)
    return out | {
        **{"reached": verdict.reached, "planned_again": again},
        "motion_s": f"{len(rollout.ctrl) / 1e3:.0f}",
        "to_goal": f"{c[Figure.GOAL].value:.3f}",
        "effort": f"{c[Figure.EFFORT].value:.2f}",
        "why": "; ".join(broken),
    }


def main() -> None:
    """Run the rows that are not there yet."""
    parser = argparse.ArgumentParser()
    parser.add_argument("policy", type=Path)
    parser.add_argument("table", type=Path)
    parser.add_argument("--rows", type=int, default=30)
    parser.add_argument("--plan", action="store_true")
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    policy, robot = clamber.load_policy(args.policy), clamber.load_robot("coman")
    done: set[int] = set()
    if args.table.exists():
        with args.table.open(newline="") as f:
            done = {int(r["row"]) for r in csv.DictReader(f)}
    else:
        args.table.write_text(",".join(COLUMNS) + "\n")
    with timed_changes() as changes:
        for row in sorted(set(range(args.rows)) - done):
            folder = None if args.keep is None else args.keep / f"{row:02d}"
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
            result = cross(policy, robot, row, folder, physics=not args.plan)
            with args.table.open("a", newline="") as f:
                csv.DictWriter(f, COLUMNS).writerow(result)
            print(result, flush=True)
    if changes:
        median, high = np.percentile(changes, [50, 99])
        print(
            f"{len(changes)} contact changes tried: median {median:.2f} ms,"
            f" 99 % within {high:.2f} ms, at most {max(changes):.2f} ms"
        )


if __name__ == "__main__":
    main()
