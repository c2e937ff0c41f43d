"""Output of a command: progress, tables, or one JSON object.

Progress goes to stderr, results to stdout. A table is made of the same record that
`--json` prints, so that both say the same.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

import clamber
from clamber.cli.progress import bar, lines
from clamber.execution.events import event_fields
from clamber.model.progress import Progress
from clamber.show.track import Track

REACHED, MISSED, BAD_INPUT, INTERRUPTED, READER_GONE = 0, 1, 2, 130, 141
"""The exit codes: success (or the command did its work), failure, bad
input, interrupted, nobody reads the output any more (as in `clamber ... | head`)."""

Switch = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class Output:
    """How results are shown."""

    json: Switch = False
    """Print the result as one JSON object."""
    quiet: Switch = False
    """No progress, no table: files and exit code only."""

    @contextlib.contextmanager
    def progress(self, track: Track, *, more: bool = False) -> Iterator[Progress]:
        """Yield `report(stage, share done, note)`; it draws on stderr.

        Args:
            track: The stages of the command.
            more: The command goes on after it.
        """
        console = Console(stderr=True)
        if self.quiet:
            yield lambda stage, done, note: None
        else:
            draw = bar if console.is_terminal else lines
            with draw(console, track, more=more) as report:
                yield report

    def warn(self, *texts: str) -> None:
        """Say what could not be done, a sentence a line, on stderr."""
        for text in texts if not self.quiet else ():
            sys.stderr.write(f"clamber: {text}\n")

    def tell(self, text: str) -> None:
        """Say what else there is, to people alone, on stderr."""
        if not (self.json or self.quiet):
            sys.stderr.write(f"{text}\n")

    def show(self, record: Mapping[str, Any], *tables: Table, note: str = "") -> None:
        """Print one JSON object, or tables and a closing sentence, on stdout."""
        if self.json:
            sys.stdout.write(
                json.dumps({"version": 1, **record}, allow_nan=False) + "\n"
            )
        elif not self.quiet:
            seen = sys.stdout.isatty()
            console = Console(
                width=None if seen else 140, highlight=False, markup=False
            )
            for k, table in enumerate(tables):
                if k:
                    console.print()
                console.print(table)
            if note:
                console.print(note, soft_wrap=not seen)  # a log has no width
        sys.stdout.flush()


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while a run folder was being filled."""

    def __init__(self, folder: Path) -> None:
        """`folder`: Of the run; every file that is in it is whole."""
        super().__init__(str(folder))
        self.folder = folder

    def __str__(self) -> str:
        """The folder and its files, in a sentence."""
        files = self.folder.glob("*") if self.folder.is_dir() else ()
        names = sorted(f.name for f in files if not f.name.startswith("."))
        if not names:
            return f"interrupted; nothing was written to {self.folder}"
        return f"interrupted; in {self.folder} are, whole: {', '.join(names)}"


@contextlib.contextmanager
def filling(folder: Path) -> Iterator[None]:
    """Have an interrupt say what the run folder holds by then."""
    try:
        yield
    except KeyboardInterrupt as e:
        raise Interrupted(folder) from e


class Clock:
    """Seconds by stage and by contact change, from what the stages report."""

    def __init__(self) -> None:
        """Nothing has run yet."""
        self._stages: dict[str, float] = {}
        self._moves: dict[str, float] = {}

    def watching(self, report: Progress) -> Progress:
        """A report that also takes the time."""
        began: dict[tuple[str, float, str], float] = {}
        last: tuple[str, float, str] | None = None

        def timed(stage: str, done: float, note: str) -> None:
            nonlocal last
            now = time.perf_counter()
            if last is not None:
                spent = now - began[last]
                self._stages[last[0]] = self._stages.get(last[0], 0.0) + spent
                if last[0] == "plan":
                    # One that is tried again, for a later one's sake or with
                    # other weights, costs all of that.
                    move = last[2].rpartition(": ")[2]
                    self._moves[move] = self._moves.get(move, 0.0) + spent
            last = (stage, done, note)
            began[last] = now
            report(stage, done, note)

        return timed

    def stages(self) -> dict[str, float]:
        """Seconds by stage."""
        return dict(self._stages)

    def of(self, move: object) -> float | None:
        """Seconds that a contact change took; None where it was not watched."""
        return self._moves.get(str(move))


def new_table(*columns: str, numbers: bool = False) -> Table:
    """An empty table without rules, its last column the one that is folded.

    `numbers`: all columns but the first are narrow ones of numbers.
    """
    gap = 1 if numbers else 2
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, gap, 0, 0))
    for k, name in enumerate(columns):
        table.add_column(name, justify="right" if numbers and k else "left")
    table.columns[-1].overflow = "fold"
    return table


def plan_record(plan: clamber.Plan, clock: Clock | None = None) -> dict[str, Any]:
    """What `--json` says of a plan; costs and margins are those of `plan.json`."""
    from clamber.model.kinematics import Kinematics
    from clamber.step.robust import robust_margin, robust_margin_along

    kin, keyframes = Kinematics(plan.world), []
    changes = [None, *plan.changes]
    for change, key, held in zip(changes, plan.keyframes, plan.equilibria, strict=True):
        move = None if change is None else change.step
        phases = () if change is None else change.phases
        keyframes.append(
            {
                "move": "start" if move is None else str(move),
                "method": key.method,
                "iterations": key.iterations,
                "seconds": None if clock is None or move is None else clock.of(move),
                "cost_before": key.cost_before,
                "cost_after": key.cost_after,
                "projected_distance": {
                    c.contact.surface: c.projected_distance for c in key.contacts
                },
                "com_margin": key.com_margin if math.isfinite(key.com_margin) else None,
                "robust_margin": robust_margin(kin, key.q, key.stance),
                "robust_margin_on_way": robust_margin_along(kin, phases),
                "equilibrium_margin": held.margin,
                "limiting": held.limiting,
            }
        )
    return {
        "complete": plan.complete,
        "fallback": None if plan.fallback is None else asdict(plan.fallback),
        "keyframes": keyframes,
        "skipped": [asdict(s) for s in plan.skipped],
        "failures": [str(f) for f in plan.failures],
    }


def keyframe_tables(record: Mapping[str, Any]) -> list[Table]:
    """The keyframes of a record: how each was found, and where its contacts are."""
    found = new_table(
        "contact change",
        "iter",
        "time [s]",
        "cost",
        "after",
        "CoM [mm]",
        "robust [mm]",
        "push [m g]",
        "limited by",
    )
    keys = record["keyframes"]
    for k in keys:
        com, way = k["com_margin"], k["robust_margin_on_way"]
        found.add_row(
            k["move"],
            str(k["iterations"]),
            "-" if k["seconds"] is None else f"{k['seconds']:.2f}",
            f"{k['cost_before']:.3f}",
            f"{k['cost_after']:.3f}",
            "-" if com is None else f"{1000 * com:.0f}",
            f"{1000 * (k['robust_margin'] if way is None else way):.0f}",
            f"{k['equilibrium_margin']:.2f}",
            k["limiting"] or "-",
        )
    surfaces = list(dict.fromkeys(s for k in keys for s in k["projected_distance"]))
    distances = new_table("projected distance [mm]", *surfaces, numbers=True)
    for k in keys:
        d = k["projected_distance"]
        cells = (f"{1000 * d[s]:.0f}" if s in d else "" for s in surfaces)
        distances.add_row(k["move"], *cells)
    return [found, distances]


def replanned_record(found: clamber.Replanned) -> dict[str, Any]:
    """Differences and plans, the best first."""
    return {
        "differences": [list(d) for d in found.differences],
        "plans": [
            {"surfaces": list(r.surfaces), "cost": r.cost, "stable": r.stable}
            for r in found.ranked
        ],
    }


def outcome(plan: clamber.Plan) -> str:
    """One clause: planned to the end, or why not."""
    if plan.complete:
        return "planned to the last stance"
    return f"no plan: {plan.fallback or plan.why_not}"


def closing(
    note: str, folder: Path, well: bool, plan: clamber.Plan | None = None
) -> str:
    """The last line: how it ended, where the files are, and what to look at.

    Before it, where a plan is complete, what it does in place of what was asked for.
    """
    look = "" if well else f"; `clamber report {folder}` shows how far it came"
    said = f"{note}; the files are in {folder}{look}"
    if plan is None or not plan.complete or plan.fallback is None:
        return said
    return f"note: {plan.fallback}\n{said}"


def skipped_tables(plan: clamber.Plan) -> list[Table]:
    """A table of the stances left out, and of the steps that could not be planned."""
    rows = [(str(s.stance), s.reason) for s in plan.skipped]
    for f in plan.failures:
        rows.append(("" if f.step is None else str(f.step.stance), str(f)))
    table = new_table("skipped stance", "reason")
    for row in rows:
        table.add_row(*row)
    return [table] if rows else []


def policy_tables(policy: clamber.GeneralPolicy, name: str) -> list[Table]:
    """Options, and the distributions of the pelvis's orientation."""
    options = new_table(
        " ".join(("option", name)).strip(), "region", "cycle", "repeats", "begins in",
        "until",
    )  # fmt: skip
    for o in policy.options:
        options.add_row(
            o.name, o.region, ", ".join(o.surfaces), str(o.repeats),
            " ".join(o.initiation), o.termination,
        )  # fmt: skip
    pelvis = new_table("pelvis", "angle", "mean [deg]", "sigma [deg]", "imposed [deg]")
    for place, d in (("near edge", policy.near_edge), ("over top", policy.over_top)):
        for k, angle in enumerate(("roll", "pitch", "yaw")):
            imposed = d.imposed[k]
            pelvis.add_row(
                "" if k else f"{place} ({d.samples})",
                angle,
                f"{math.degrees(d.mean[k]):.1f}",
                f"{math.degrees(d.sigma[k]):.1f}",
                "-"
                if imposed is None
                else " to ".join(f"{math.degrees(x):.1f}" for x in imposed),
            )
    return [options, pelvis]


def _strained(rollout: clamber.Rollout) -> str:
    """A sentence on the joint at its effort limit; empty if none was."""
    from clamber.execution.verdict import strained_joint

    found = strained_joint(rollout)
    if found is None:
        return ""
    name, limit, seconds = found
    lasted = f"{seconds:.1f} s" if seconds >= 0.1 else f"{1000 * seconds:.0f} ms"
    return f"; {name} was at its effort limit of {limit:g} N m for {lasted}"


def conclude(
    output: Output,
    folder: Path,
    plan: clamber.Plan,
    done: tuple[clamber.Rollout, clamber.Verdict] | None,
    clock: Clock | None = None,
    *,
    drawn: bool = True,
) -> int:
    """Show the verdict and where the files are; the exit code says the same."""
    table = new_table("criterion", "value", "limit", "")
    rollout, verdict = (None, None) if done is None else done
    criteria = {} if verdict is None else verdict.criteria
    for *row, ok in [] if verdict is None else verdict.rows():
        table.add_row(*row, "ok" if ok else "NO")
    reached = verdict is not None and verdict.reached
    planned = plan_record(plan, clock)
    record = {
        "out": str(folder),
        "reached": reached,
        "criteria": {
            n: {"value": c.value, "limit": c.limit, "ok": c.ok}
            for n, c in criteria.items()
        },
        "events": [] if rollout is None else [event_fields(e) for e in rollout.events],
        "stopped": "" if rollout is None else rollout.stopped,
        **planned,
    }
    if reached:
        note = "success: the robot reached the goal stance"
    elif not plan.complete:
        note = outcome(plan)
    elif rollout is not None and rollout.stopped:
        note = f"failed: stopped during execution: {rollout.stopped}"
    else:
        wrong = "" if verdict is None else verdict.failed()
        note = f"failed: not met: {wrong}" if wrong else "failed: nothing was planned"
    if rollout is not None and not reached:
        note += _strained(rollout)
    record["note"] = note
    tables = keyframe_tables(planned) if clock is not None else []
    tables += skipped_tables(plan)
    if rollout is not None and rollout.events:
        felt = new_table("at [s]", "measured during execution")
        for e in rollout.events:
            felt.add_row(f"{e.time:.2f}", str(e))
        tables.append(felt)
    tables += [table] if criteria else []
    note = closing(note, folder, reached, plan)
    if reached and not drawn:
        note += f"; `clamber render {folder}` draws it"
    output.show(record, *tables, note=note)
    return REACHED if reached else MISSED
