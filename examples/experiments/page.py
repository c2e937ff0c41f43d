"""The experiments as a page of the documentation: python page.py RUNS DOCS.

Reads the sweeps `RUNS/<name of the spec>` of all specs beside this file and writes
`DOCS/experiments.md` with a table of each; pictures and all rows are in
`DOCS/experiments`. A sweep that is not done yet is shown as far as it is; one that has
not begun is left out.
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

How far each controller goes: `pid` follows the plan open loop, `mixed` feels its
contacts and plans again. How the runs are chosen and the figures made is said in
[Sweeps](sweeps.md). All of this anew, also after an interruption: `make experiments`.
"""


def page(runs: Path, pictures: Path) -> str:
    """The page as Markdown; draws the pictures."""
    parts = [HEAD]
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
        parts.append(f"## {spec.about}\n")
        parts.append("\n".join(comment) + "\n")
        parts.append(
            "<!-- read only: tens of climbs, which are minutes of computing -->\n"
            f"```sh\nclamber sweep examples/experiments/{name}.yaml\n```\n"
        )
        if len(rows) < wanted:
            parts.append(f"So far {len(rows)} of {wanted} runs.\n")
        parts.append(table(summarise(spec, rows), search=spec.search is not None))
        parts.append(f"![{spec.about}](experiments/{name}.png)\n")
        parts.append(f"[Every run, with its command](experiments/{name}.csv)\n")
    return "\n".join(parts)


def table(summaries: list[Summary], *, search: bool) -> str:
    """A search is told by where it breaks, all else by its share."""
    if not search:
        lines = ["| controller | runs | reached | share | 95 % interval |"]
        lines.append("|---|---|---|---|---|")
        for s in summaries:
            share = f"{100 * s.share:.1f} %"
            span = f"{100 * s.low:.1f} to {100 * s.high:.1f} %"
            lines.append(
                f"| {s.controller} | {s.runs} | {s.reached} | {share} | {span} |"
            )
        return "\n".join(lines) + "\n"
    lines = ["| controller | from | to | runs | half of them at | 95 % interval |"]
    lines.append("|---|---|---|---|---|---|")
    for s in summaries:
        half = s.half if isinstance(s.half, str) else f"{s.half:.3g}"
        ends = ["-" if x is None else f"{x:.3g}" for x in (s.half_from, s.half_to)]
        span = " to ".join(ends) if ends != ["-", "-"] else ""
        lines.append(
            f"| {s.controller} | {s.start:g} | {s.end:g} | {s.runs} | {half} | {span} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python page.py RUNS DOCS")
    docs = Path(sys.argv[2])
    shutil.rmtree(docs / "experiments", ignore_errors=True)
    (docs / "experiments").mkdir(parents=True)
    text = page(Path(sys.argv[1]), docs / "experiments")
    with whole_file(docs / "experiments.md") as draft:
        draft.write_text(text)
