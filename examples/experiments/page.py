"""The experiments as a page of the documentation: python page.py RUNS DOCS.

Reads the sweeps `RUNS/<name of the spec>` of all specs beside this file and writes
`DOCS/experiments.md`, one table of searches and one of shares; pictures and all rows
are in `DOCS/experiments`. A sweep that is not done yet is shown as far as it is; one
that has not begun is left out.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from clamber.run.codec import whole_file
from clamber.study.curves import Summary, draw_success, summarise
from clamber.study.spec import strands
from clamber.study.sweep import load_sweep

HERE = Path(__file__).parent
ORDER = (
    *("box-height", "unevenness", "height-mistaken", "tilt", "friction", "start"),
    *("mass", "effort", "delay", "push", "speed"),
    *("all-at-once", "all-at-once-doubled", "thesis"),
)
HEAD = """# Experiments

How far each controller goes: `pid` tracks the plan open loop, `mixed` measures its
contacts and replans. How runs are chosen and figures made is said in
[Sweeps](sweeps.md). All of this anew, also after an interruption: `make experiments`.
"""
SEARCHES = """## Where success breaks

Success falls through one half at the value in the last but one column; `beyond` says
that it did not within the range.

| experiment | controller | from | to | runs | half of them at | 95 % interval |
|---|---|---|---|---|---|---|
"""
SHARES = """## How often it succeeds

| experiment | controller | runs | reached | share | 95 % interval |
|---|---|---|---|---|---|
"""


def page(runs: Path, pictures: Path) -> str:
    """The page as Markdown; draws the pictures."""
    searches, shares, parts = [], [], []
    for name in ORDER:
        folder = runs / name
        if not (folder / "runs.csv").exists():
            continue
        spec, rows = load_sweep(folder)
        wanted = sum(s.runs for s in strands(spec))
        draw_success(spec, rows, pictures / f"{name}.png")
        shutil.copyfile(folder / "runs.csv", pictures / f"{name}.csv")
        comment = [
            line.removeprefix("# ")
            for line in (HERE / f"{name}.yaml").read_text().splitlines()
            if line.startswith("# ")
        ]
        if spec.search is not None:
            searches += [half(name, s) for s in summarise(spec, rows)]
        else:
            shares += [share(name, s) for s in summarise(spec, rows)]
        parts.append(f"## {spec.about}\n")
        parts.append("\n".join(comment) + "\n")
        if len(rows) < wanted:
            parts.append(f"So far {len(rows)} of {wanted} runs.\n")
        parts.append(f"![{spec.about}](experiments/{name}.png)\n")
        parts.append(
            f"`clamber sweep examples/experiments/{name}.yaml`; "
            f"[every run, with its command](experiments/{name}.csv)\n"
        )
    both = ((SEARCHES, searches), (SHARES, shares))
    tables = [head + "\n".join(rows) + "\n" for head, rows in both if rows]
    return "\n".join([HEAD, *tables, *parts])


def share(name: str, s: Summary) -> str:
    """A row of what is told by its share."""
    span = f"{100 * s.low:.1f} to {100 * s.high:.1f} %"
    return (
        f"| {name} | {s.controller} | {s.runs} | {s.reached} |"
        f" {100 * s.share:.1f} % | {span} |"
    )


def half(name: str, s: Summary) -> str:
    """A row of what is told by where it breaks."""
    at = s.half if isinstance(s.half, str) else f"{s.half:.3g}"
    ends = ["-" if x is None else f"{x:.3g}" for x in (s.half_from, s.half_to)]
    span = " to ".join(ends) if ends != ["-", "-"] else ""
    return (
        f"| {name} | {s.controller} | {s.start:g} | {s.end:g} | {s.runs} |"
        f" {at} | {span} |"
    )


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python page.py RUNS DOCS")
    docs = Path(sys.argv[2])
    for name in ORDER:  # what others have put there stays
        for suffix in (".csv", ".png"):
            (docs / "experiments" / f"{name}{suffix}").unlink(missing_ok=True)
    (docs / "experiments").mkdir(parents=True, exist_ok=True)
    text = page(Path(sys.argv[1]), docs / "experiments")
    with whole_file(docs / "experiments.md") as draft:
        draft.write_text(text)
