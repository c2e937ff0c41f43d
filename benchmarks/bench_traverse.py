"""How the time and the memory of planning grow with the length of the box.

    python benchmarks/bench_traverse.py policy.json scaling.csv scaling.png

Boxes of 0.5 to 8 m, each planned and saved in a process of its own, three times. Rows:
the length [m], contact changes, CPU seconds of planning and of writing the run folder
(medians), milliseconds of planning a change, seconds of motion, the peak memory of the
process before planning, after it and after saving [MB], and whether the goal was
reached. The picture is drawn from them.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import clamber
from clamber.show.plots import finish_axes, save_plot

LENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
HEIGHT, WIDTH, FACE, BEYOND = 0.27, 0.8, 0.23, 0.45  # [m]
REPEATS = 3
Row = dict[str, float | bool | str]


def measure(policy: Path, length: float) -> Row:
    """One plan, with all that this process has taken for it."""
    size = np.array([length, WIDTH, HEIGHT])
    middle = np.array([FACE + length / 2, 0.0, HEIGHT / 2])
    box = clamber.Box(name="table", size=size, centre=middle, rotation=np.eye(3))
    goal = np.array([FACE + length + BEYOND, 0.0])
    scene = clamber.Scene(boxes=(box,), start=np.zeros(3), goal=goal)
    robot, general = clamber.load_robot("coman"), clamber.load_policy(policy)
    clock, memory = [time.process_time()], [peak()]
    plan = clamber.plan(general, robot, scene)
    clock.append(time.process_time())
    memory.append(peak())
    with tempfile.TemporaryDirectory() as folder:
        clamber.save_plan(plan, folder)
    clock.append(time.process_time())
    spent, saving = np.diff(clock).tolist()
    t, changes = plan.trajectory, len(plan.changes)
    return {
        "length_m": length,
        "changes": changes,
        "plan_s": spent,
        "ms_per_change": 1e3 * spent / max(changes, 1),
        "save_s": saving,
        "motion_s": 0.0 if t is None else float(t.time[-1]),
        "before_mb": memory[0],
        "planned_mb": memory[1],
        "saved_mb": peak(),
        "complete": plan.complete,
        "why": plan.why_not,
    }


def peak() -> float:
    """The most memory that this process has had [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def medians(rows: list[Row]) -> Row:
    """Of the times and the memory; the rest is the same in all."""
    out = dict(rows[0])
    for name in [k for k, v in out.items() if isinstance(v, float)]:
        out[name] = float(np.median([float(r[name]) for r in rows]))
    return {k: round(v, 1) if isinstance(v, float) else v for k, v in out.items()}


def draw(rows: list[Row], path: Path) -> None:
    """Time over contact changes, and memory over the seconds of motion."""
    fig = Figure(figsize=(7.2, 3.0), layout="constrained")
    left, right = fig.subplots(1, 2)
    of = {name: [float(r[name]) for r in rows] for name in rows[0] if name != "why"}
    left.plot(of["changes"], of["plan_s"], "o-", color="#1d4ed8", label="planning")
    for length, x, y in zip(of["length_m"], of["changes"], of["plan_s"], strict=True):
        if length >= 2:  # shorter ones are next to each other
            left.annotate(f"{length:g} m", (x, y), (4, -10), textcoords="offset points")
    left.set(xlabel="contact changes", ylabel="CPU time [s]")
    for name, mark, colour in (
        ("before", "^", "#6b7280"),
        ("planned", "o", "#1d4ed8"),
        ("saved", "s", "#b91c1c"),
    ):
        memory = of[f"{name}_mb"]
        right.plot(of["changes"], memory, f"{mark}-", color=colour, label=name)
    right.set(xlabel="contact changes", ylabel="peak memory [MB]")
    for ax in (left, right):
        ax.set(xlim=(0, None), ylim=(0, None))
        finish_axes(ax)
    right.legend(frameon=False, fontsize=8, loc="lower right")
    left.legend(frameon=False, fontsize=8, loc="upper left")
    save_plot(fig, path)


def main() -> None:
    """Plan one box after the other, the shortest first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", type=Path)
    parser.add_argument("table", type=Path)
    parser.add_argument("picture", type=Path, nargs="?")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--only", type=float, help="measure this length, here, as JSON")
    args = parser.parse_args()
    if args.only is not None:
        json.dump(measure(args.policy, args.only), sys.stdout)
        return
    rows = []
    for length in LENGTHS:
        again = [sys.executable, __file__, args.policy, args.table, "--only"]
        runs = [
            json.loads(subprocess.check_output([*again, str(length)]))
            for _ in range(args.repeats)
        ]
        rows.append(medians(runs))
        sys.stdout.write(f"{rows[-1]}\n")
        sys.stdout.flush()
        with args.table.open("w", newline="") as f:
            writer = csv.DictWriter(f, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    if args.picture is not None:
        draw(rows, args.picture)


if __name__ == "__main__":
    main()
