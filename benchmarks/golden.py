"""Hashes of what whole jobs give: plans, trajectories, rollouts, policies, robots.

    python benchmarks/golden.py before.json                  # record
    python benchmarks/golden.py after.json --like before.json  # record and compare
    python benchmarks/golden.py after.json --like before.json --only plan-

Equal hashes mean equal bits. They hold for one machine and one set of versions alone,
so that a comparison takes two runs of this script: one of the code before a change, one
of the code after it (`PYTHONPATH=.../src` says which). What is hashed is what other
programs read: names and arrays of docs/files.md. Beside the hashes stand a few figures,
for changes that shall alter results: whether the goal was reached, contact changes,
seconds of motion.

`--robots DIR` adds robots of other people: every DIR/*.xml and DIR/*.urdf is proposed
and checked. `--recordings DIR` adds recordings: DIR/*.yaml.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROW = """\
boxes: [{name: table, size: [0.95, 0.60, 0.275], position: [0.735, 0.0]}]
start: [-0.05, 0.03, 0.1]
goal: [1.66, 0.0]
"""
STAIRS = """\
boxes:
  - {name: first, size: [1.2, 1.0, 0.12], position: [0.83, 0.0]}
  - {name: second, size: [0.9, 1.0, 0.24], position: [0.98, 0.0]}
  - {name: third, size: [0.6, 1.0, 0.36], position: [1.13, 0.0]}
goal: [1.2, 0.0]
"""
TURNED = """\
boxes: [{name: table, size: [0.8, 0.8, 0.24], position: [0.75, 0.1], rpy: [0, 0, 0.4]}]
start: [0.0, 0.1, 0.15]
"""


def clamber(folder: Path, *args: str) -> None:
    """Run a command in a folder; that a robot does not make it is a result, too."""
    done = subprocess.run(
        [sys.executable, "-m", "clamber", *args, "--quiet"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"clamber {' '.join(args)}: {done.stderr.strip()[-500:]}")


def digest(*parts: Any) -> str:
    """Of arrays and of what JSON can say."""
    h = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            h.update(str((part.dtype.str, part.shape)).encode())
            h.update(np.ascontiguousarray(part).tobytes())
        else:
            h.update(json.dumps(part, sort_keys=True).encode())
    return h.hexdigest()[:16]


def contacts_of(stance: list[dict[str, Any]]) -> list[Any]:
    """What a contact is, whatever else stands beside it."""
    names = ("surface", "support", "position", "quaternion")
    return [[c[n] for n in names] for c in stance]


def read_run(run: Path) -> dict[str, Any]:
    """Hashes and figures of a run folder, as far as it has files."""
    out: dict[str, Any] = {}
    if (run / "sequence.json").exists():
        made = json.loads((run / "sequence.json").read_text())
        stances = [
            [s["t0"], s["t1"], contacts_of(s["contacts"])] for s in made["stances"]
        ]
        out["sequence"] = digest(stances)
    if (run / "plan.json").exists():
        made = json.loads((run / "plan.json").read_text())
        keyframes = made["keyframes"]
        out["postures"] = digest([k["qpos"] for k in keyframes])
        out["contacts"] = digest([contacts_of(k["contacts"]) for k in keyframes])
        out["changes"] = len(keyframes) - 1
        out["complete"] = made["complete"]
    planned = run / "planned.npz"
    for name, file in (
        ("planned", planned if planned.exists() else run / "trajectory.npz"),
        ("trajectory", run / "trajectory.npz"),
    ):
        if file.exists():
            with np.load(file) as z:
                out[name] = digest(*(z[n] for n in sorted(z.files)))
                out[f"{name} [s]"] = float(z["time"][-1])
    if (run / "rollout.npz").exists():
        with np.load(run / "rollout.npz") as z:
            names = ("ctrl", "qpos", "contact_force", "unintended")
            out["rollout"] = digest(*(z[n] for n in names))
    if (run / "verdict.json").exists():
        made = json.loads((run / "verdict.json").read_text())
        out["reached"] = made["reached"]
        out["figures"] = digest(sorted(c["value"] for c in made["criteria"].values()))
    return out


def planned(*world: str, demo: str = "climb") -> Callable[[Path], dict[str, Any]]:
    """Contacts, then a plan."""

    def case(folder: Path) -> dict[str, Any]:
        clamber(folder, "contacts", demo, "--out", "contacts")
        clamber(folder, "plan", "contacts/sequence.json", *world, "--out", "run")
        return read_run(folder / "run")

    return case


def climbed(*args: str) -> Callable[[Path], dict[str, Any]]:
    """The whole job."""

    def case(folder: Path) -> dict[str, Any]:
        clamber(folder, "climb", *args, "--out", "run")
        return read_run(folder / "run")

    return case


def in_scene(scene: str, case: Callable[[Path], dict[str, Any]]) -> Any:
    """With `scene.yaml` in the folder."""

    def inside(folder: Path) -> dict[str, Any]:
        (folder / "scene.yaml").write_text(scene)
        return case(folder)

    return inside


def learned(folder: Path) -> dict[str, Any]:
    """A policy of the crossing."""
    clamber(folder, "learn", "crossing", "--out", "policy.json")
    made = json.loads((folder / "policy.json").read_text())
    return {"policy": digest({k: v for k, v in made.items() if k != "version"})}


def crossed(folder: Path) -> dict[str, Any]:
    """A scene that a policy gets through, planned alone."""
    clamber(folder, "learn", "crossing", "--out", "policy.json")
    code = (
        "import clamber\n"
        "p = clamber.plan(clamber.load_policy('policy.json'),"
        " clamber.load_robot('coman'), clamber.load_scene('scene.yaml'))\n"
        "clamber.save_plan(p, 'run')\n"
    )
    (folder / "run").mkdir()
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)
    return read_run(folder / "run")


def traversed(folder: Path) -> dict[str, Any]:
    """The same in physics."""
    clamber(folder, "learn", "crossing", "--out", "policy.json")
    clamber(folder, "traverse", "policy.json", "--scene", "scene.yaml", "--out", "run")
    return read_run(folder / "run")


def replanned(folder: Path) -> dict[str, Any]:
    """All alternatives, ranked."""
    clamber(folder, "contacts", "climb", "--out", "contacts")
    source = "contacts/sequence.json"
    clamber(folder, "replan", source, "--height", "0.15", "--out", "run")
    return read_run(folder / "run")


def rest(folder: Path) -> dict[str, Any]:
    """The rest of a climb, from 12 s on, simulated."""
    clamber(folder, "climb", "--out", "first")
    clamber(folder, "replan", "first", "--from", "12", "--out", "run")
    clamber(folder, "simulate", "run")
    return read_run(folder / "run")


def proposed(model: Path) -> Callable[[Path], dict[str, Any]]:
    """A robot of somebody else, as `robot init` proposes it."""

    def case(folder: Path) -> dict[str, Any]:
        clamber(folder, "robot", "init", str(model), "--out", "robot")
        if not (folder / "robot" / "robot.yaml").exists():
            return {}
        made = (folder / "robot" / "robot.yaml").read_text()
        return {"robot.yaml": digest(made)}

    return case


CASES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "plan-coman-0.20": planned("--height", "0.20"),
    "plan-coman-0.275": planned("--height", "0.275"),
    "plan-coman-0.36": planned("--height", "0.36"),
    "plan-coman-0.52": planned("--height", "0.52"),
    "plan-coman-0.56": planned("--height", "0.56"),
    "plan-coman29-0.25": planned("--height", "0.25", "--robot", "coman29"),
    "plan-coman29-0.42": planned("--height", "0.42", "--robot", "coman29"),
    "plan-max": planned("--speed", "max"),
    "plan-lbfgs": planned("--method", "lbfgs"),
    "plan-turned": in_scene(TURNED, planned("--scene", "scene.yaml")),
    "learn": learned,
    "replan-0.15": replanned,
    "cross-plan": in_scene(ROW, crossed),
    "stairs-plan": in_scene(STAIRS, crossed),
    "climb-coman-0.275": climbed(),
    "climb-coman29-0.25": climbed("--robot", "coman29", "--height", "0.25"),
    "climb-pid": climbed("--controller", "pid", "--height", "0.25"),
    "climb-max": climbed("--speed", "max"),
    "climb-mistaken": climbed(
        "--disturb.height", "-0.03", "--disturb.noise", "0.002", "--disturb.seed", "3"
    ),
    "climb-early": climbed("--disturb.height", "0.02", "--disturb.yaw", "0.05"),
    "climb-coman-0.52": climbed("--height", "0.52"),
    "climb-coman-0.60": climbed("--height", "0.60"),
    "rest": rest,
    "traverse-stairs": in_scene(STAIRS, traversed),
    "traverse-table": in_scene(ROW, traversed),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--like", type=Path, help="what it is compared with")
    parser.add_argument("--only", default="", help="cases that begin like this")
    parser.add_argument("--robots", type=Path)
    parser.add_argument("--recordings", type=Path)
    args = parser.parse_args()
    cases = dict(CASES)
    if args.robots is not None:
        for model in sorted(args.robots.resolve().iterdir()):
            if model.suffix in (".xml", ".urdf"):
                cases[f"robot-{model.stem}"] = proposed(model)
    if args.recordings is not None:
        for file in sorted(args.recordings.resolve().glob("*.yaml")):
            cases[f"plan-{file.stem}"] = planned("--height", "0.262", demo=str(file))
    found = json.loads(args.out.read_text()) if args.out.exists() else {}
    for name, case in cases.items():
        if not name.startswith(tuple(args.only.split(","))) or name in found:
            continue
        start = time.perf_counter()
        folder = Path(tempfile.mkdtemp(prefix="golden-"))
        try:
            found[name] = case(folder)
        except Exception as e:  # the others are run all the same
            found[name] = {"error": str(e)}
        shutil.rmtree(folder)
        args.out.write_text(json.dumps(found, indent=1) + "\n")
        print(f"{name}: {time.perf_counter() - start:.0f} s, {found[name]}", flush=True)
    if args.like is None:
        return 0
    before = json.loads(args.like.read_text())
    differ = 0
    for name in (n for n in found if n in before):
        items = found[name].keys() | before[name].keys()
        odd = [k for k in sorted(items) if found[name].get(k) != before[name].get(k)]
        for k in odd:
            print(f"{name}, {k}: {before[name].get(k)} -> {found[name].get(k)}")
        differ += bool(odd)
    print(f"{differ} of {len(found)} cases differ")
    return 1 if differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
