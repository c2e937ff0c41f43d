"""Terrains from supports to the verdict: what is climbed, how long it takes, why not.

    python examples/terrains/make.py terrains
    python benchmarks/bench_terrain.py terrains --out table.md
    python benchmarks/bench_terrain.py terrains --only ramp --again

Each is read, planned and simulated as `clamber climb --scene` does, and leaves its run
folder in --runs with a `row.json`: what is there is not done again, so that an
interrupted benchmark goes on where it was. `--judge PROGRAM` is
called with the run folder, `--goal reach` and `--scene`, prints JSON with `ok` and
`criteria`, and says whether it is believed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from clamber import load_scene
from clamber.planning.records import PlanOptions
from clamber.study.climb import Climb, run_climb

ROW = "row.json"
RAYS = "rays from the links meet the terrain"


def figures(folder: Path, run: Path, speed: float) -> dict[str, object]:
    """What became of one terrain."""
    file = folder / "scene.yaml"
    run.mkdir(parents=True, exist_ok=True)
    begin = time.process_time()
    (mesh,) = load_scene(file).meshes
    read = time.process_time() - begin
    begin = time.process_time()
    done = run_climb(Climb(scene=str(file), speed=speed), folder=run)
    return {
        "terrain": folder.name,
        "supports": len(mesh.supports),
        "read [s]": round(read, 2),
        "climb [s]": round(time.process_time() - begin, 1),
        "motion [s]": round(done.seconds, 1),
        "replans": done.replans,
        "climbed": "yes" if done.reached else "no",
        "why not": done.why,
    }


def judged(folder: Path, run: Path, judge: str) -> dict[str, object]:
    """What the judge says of a run."""
    if not (run / "rollout.npz").exists():
        return {"judged": "-", "rays": "-"}
    command = [sys.executable, *shlex.split(judge), str(run), "--goal", "reach"]
    found = subprocess.run(
        [*command, "--scene", str(folder / "scene.yaml")],
        capture_output=True,
        text=True,
    )
    criteria = json.loads(found.stdout)["criteria"]
    failed = [k for k, v in criteria.items() if not v["ok"]]
    rays = [v["value"][0] for k, v in criteria.items() if k.startswith(RAYS)]
    return {
        "judged": f"no: {'; '.join(failed)}" if failed else "yes",
        "rays": f"{100 * rays[0]:.1f} %" if rays else "-",
    }


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terrains", type=Path)
    parser.add_argument("--only", default="", help="part of the names of terrains")
    parser.add_argument("--runs", type=Path, default=Path("runs/terrains"))
    parser.add_argument("--speed", type=float, default=PlanOptions().speed)
    parser.add_argument("--judge", help="program, with its options")
    parser.add_argument("--again", action="store_true", help="what is there as well")
    parser.add_argument("--out", type=Path, help="where to write the table")
    args = parser.parse_args()
    rows = []
    for scene in sorted(args.terrains.glob(f"*{args.only}*/scene.yaml")):
        run = args.runs / scene.parent.name
        if args.again or not (run / ROW).exists():
            row = figures(scene.parent, run, args.speed)
            (run / ROW).write_text(json.dumps(row))
        row = json.loads((run / ROW).read_text())
        if args.judge is not None and "judged" not in row:
            row |= judged(scene.parent, run, args.judge)
            (run / ROW).write_text(json.dumps(row))
        rows.append(row)
        if len(rows) == 1:
            print("|".join(rows[0]), flush=True)
        print("|".join(map(str, rows[-1].values())), flush=True)
    total, good = Counter[str](), Counter[str]()
    for row in rows:
        kind = row["terrain"].partition("-")[2]
        total[kind] += 1
        good[kind] += row["climbed"] == "yes" and row.get("judged", "yes") == "yes"
    print("; ".join(f"{k} {good[k]} of {n}" for k, n in total.items()))
    print(f"{good.total()} of {total.total()}")
    if args.out is not None and rows:
        lines = [list(rows[0]), ["---"] * len(rows[0]), *(r.values() for r in rows)]
        text = "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)
        args.out.write_text(text)


if __name__ == "__main__":
    main()
