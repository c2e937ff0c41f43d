"""Terrains from supports to the verdict: how long each takes, and what fails.

    python examples/terrains/make.py terrains
    python benchmarks/bench_terrain.py terrains --only ramp --out table.md

Each is loaded, planned and simulated by `clamber climb` in a process of its own, with
its run folder beside it in --runs. `--judge FILE` names a program that is called with
the run folder, `--goal reach` and `--scene`, prints JSON with `ok` and `criteria`, and
says whether it is believed.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from clamber import load_scene


def figures(folder: Path, runs: Path, judge: Path | None) -> dict[str, object]:
    """What became of one terrain."""
    file = folder / "scene.yaml"
    begin = time.process_time()
    scene = load_scene(file)
    (mesh,) = scene.meshes
    out: dict[str, object] = {
        "terrain": folder.name,
        "read [s]": round(time.process_time() - begin, 2),
        "pieces": len(mesh.pieces),
        "supports": len(mesh.supports),
    }
    run = runs / folder.name
    used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    command = [sys.executable, "-m", "clamber", "climb", "--scene", str(file)]
    done = subprocess.run(
        [*command, "--out", str(run), "--json"], capture_output=True, text=True
    )
    used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - used
    out |= {"climb [s]": round(used), "climbed": done.returncode == 0, "judged": "-"}
    out["why not"] = "" if done.returncode == 0 else _why(run, done)
    if judge is not None and (run / "rollout.npz").exists():
        command = [sys.executable, str(judge), str(run), "--goal", "reach"]
        found = subprocess.run(
            [*command, "--scene", str(file)], capture_output=True, text=True
        )
        said = json.loads(found.stdout)
        failed = [k for k, v in said["criteria"].items() if not v["ok"]]
        out["judged"] = "yes" if said["ok"] else f"no: {'; '.join(failed)}"
    return out


def _why(run: Path, done: subprocess.CompletedProcess[str]) -> str:
    """The criteria that failed, or what was said last."""
    verdict = run / "verdict.json"
    if verdict.exists():
        criteria = json.loads(verdict.read_text())["criteria"]
        return ", ".join(k for k, c in criteria.items() if not c["ok"])
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit {done.returncode}"


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terrains", type=Path)
    parser.add_argument("--only", default="", help="part of the names of terrains")
    parser.add_argument("--runs", type=Path, default=Path("runs/terrains"))
    parser.add_argument("--judge", type=Path)
    parser.add_argument("--out", type=Path, help="where to write the table")
    args = parser.parse_args()
    rows, names = [], sorted(args.terrains.glob(f"*{args.only}*/scene.yaml"))
    for folder in (n.parent for n in names):
        row = figures(folder, args.runs, args.judge)
        if not rows:
            print("|".join(row), flush=True)
        print("|".join(map(str, row.values())), flush=True)
        rows.append(row)
    good = sum(bool(r["climbed"]) and r["judged"] in ("yes", "-") for r in rows)
    print(f"{good} of {len(rows)}")
    if args.out is not None and rows:
        lines = [list(rows[0]), ["---"] * len(rows[0]), *(r.values() for r in rows)]
        text = "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)
        args.out.write_text(text)


if __name__ == "__main__":
    main()
