"""The command line: flags in, tables out.

Every command is a dataclass whose fields are its flags and whose `run` calls the public
functions in order, as `clamber.<name>`: those are imported on first use, so that
`--help` answers at once. Progress goes to stderr, results to stdout.

"""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import clamber
from clamber.cli.output import (
    INTERRUPTED,
    MISSED,
    REACHED,
    Clock,
    Output,
    Report,
    closing,
    conclude,
    keyframe_tables,
    new_table,
    outcome,
    plan_record,
    policy_tables,
    replanned_record,
    skipped_tables,
)
from clamber.errors import ClamberError, InputError
from clamber.execution.disturbance import Disturbance

DEFAULT_HEIGHT = 0.275  # [m] of the box where no scene is given


def _default(module: str, record: str, name: str) -> Any:
    """A field whose default is an options record's, looked up when it is needed."""
    return field(
        default_factory=lambda: getattr(
            getattr(import_module(f"clamber.{module}"), record)(), name
        )
    )


Flat = tyro.conf.OmitArgPrefixes
Printed = Annotated[Output, Flat]


def _shown(metavar: str, default: str | None = None) -> Any:
    """How a flag's value is called in help, and its default, where that is no value."""
    hint = None if default is None else f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


Place = Annotated[Path | None, _shown("DIR")]
RunFolder = Annotated[Path, tyro.conf.Positional, _shown("RUN")]


@dataclass(frozen=True, kw_only=True)
class WorldFlags:
    """Which robot, and where."""

    robot: str = "coman"
    """A built-in robot by name, or a robot.yaml."""
    height: Annotated[
        float | None,
        tyro.conf.arg(
            metavar="METRES", help_behavior_hint=f"(default: {DEFAULT_HEIGHT})"
        ),
    ] = None
    """One box of 1.0 x 1.2 m with this height, 0.23 m before the ankles."""
    scene: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(instead of --height)"),
    ] = None
    """A scene.yaml, or boxes as OBJ or MJCF."""

    def load(self) -> tuple[clamber.Robot, clamber.Scene]:
        """Robot and scene, the scene first checked as the cheaper one."""
        scene = _scene(self.height, self.scene)
        return clamber.load_robot(self.robot), scene

    @contextlib.contextmanager
    def blamed(self) -> Iterator[None]:
        """Name the file or flag of a scene that turns out not to fit."""
        try:
            yield
        except InputError as e:
            if e.source is not None or not (e.field or "").startswith("scene"):
                raise
            source = "--height" if self.scene is None else self.scene
            field = str(e.field).removeprefix("scene.")
            raise InputError(
                e.expected, source=source, field=field, value=e.value
            ) from e


@dataclass(frozen=True, kw_only=True)
class PlanningFlags:
    """How to plan."""

    method: Literal["direct", "lbfgs", "gradient"] = _default(
        "planning.records", "PlanOptions", "method"
    )
    """How contact positions are optimised."""
    speed: Annotated[float | Literal["max"], _shown("RAD/S|max")] = _default(
        "planning.records", "PlanOptions", "speed"
    )
    """Largest joint speed; max: as fast as joints and contacts bear."""


@dataclass(frozen=True, kw_only=True)
class SearchFlags:
    """How far to look for contacts that nobody demonstrated."""

    tries: int = _default("planning.free", "Bounds", "tries")
    """Steps that are planned at most; 0: no search."""
    depth: int = _default("planning.free", "Bounds", "depth")
    """Moves of a sequence at most."""
    policy: Annotated[
        Path | None,
        tyro.conf.arg(help_behavior_hint="(default: the sequence's own)"),
    ] = None
    """policy.json whose demonstrations say which contacts are tried first."""

    def read(self) -> dict[str, Any]:
        """The arguments of the functions that search."""
        return {"bounds": self._bounds(), "counts": self._counts()}

    def _bounds(self) -> clamber.Bounds:
        try:
            return clamber.Bounds(tries=self.tries, depth=self.depth)
        except InputError as e:
            source = f"--{e.field}"
            raise InputError(e.expected, source=source, value=e.value) from e

    def _counts(self) -> Any:
        from clamber.planning.free import policy_counts

        if self.policy is None:
            return None
        return policy_counts(clamber.load_policy(self.policy))


@dataclass(frozen=True, kw_only=True)
class ExecutionFlags:
    """How to execute, and in which world."""

    controller: Literal["pid", "mixed"] = "mixed"
    """pid: open loop. mixed: compliant joints, contacts are felt, plans adapted."""
    disturb: Disturbance = field(default_factory=Disturbance)
    """What the planner does not know of the true world."""

    def simulate(
        self, plan: clamber.Plan, folder: Path, report: Report, truth: Path | None
    ) -> tuple[clamber.Rollout, clamber.Verdict] | None:
        """Simulate, judge and save; None where there is nothing to simulate."""
        if plan.trajectory is None:
            return None
        rollout = clamber.simulate(
            plan,
            controller=self.controller,
            disturbance=self.disturb,
            true_scene=None if truth is None else clamber.load_scene(truth),
            progress=report,
        )
        clamber.save_rollout(plan, rollout, folder)
        verdict = clamber.judge(plan, rollout)
        clamber.save_verdict(verdict, folder)
        return rollout, verdict


def _scene(height: float | None, path: Path | None) -> clamber.Scene:
    """The scene of a file, or the one box of `--height`."""
    from clamber.study.climb import scene_of

    if path is not None and height is not None:
        raise InputError("--height, --scene: give one of them alone")
    return scene_of(DEFAULT_HEIGHT if height is None else height, path)


@dataclass(frozen=True, kw_only=True)
class ClimbCommand:
    """The whole job: detect contacts, plan, simulate; all files in one run folder."""

    demo: Annotated[str, _shown("RECORDING|NAME")] = "climb"
    """A recording, or a built-in demonstration (climb, crossing)."""
    fit_floor: bool = False
    """Correct the heights of the recording's floor and boxes by what rests on them."""
    world: Annotated[WorldFlags, Flat]
    planning: Annotated[PlanningFlags, Flat]
    contacts: Literal["any", "demonstrated"] = "any"
    """any: other contacts where the demonstrated ones have no stable plan."""
    search: SearchFlags = field(default_factory=SearchFlags)
    """How far to look for contacts that nobody demonstrated."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    video: bool = False
    """Draw a video too, not pictures alone."""
    out: Place = None
    """The run folder (runs/climb, then runs/climb-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Recording to verdict."""
        robot, scene = self.world.load()
        others = None if self.contacts == "demonstrated" else self.search.read()
        clock = Clock()
        with self.output.progress() as show:
            report = clock.watching(show)
            report("detect", 0.0, "")
            demo = clamber.load_demo(self.demo, fit_floor=self.fit_floor)
            sequence = clamber.detect_contacts(demo)
            report("detect", 1.0, "; ".join(demo.notes[:1]))
            folder = clamber.new_run_folder(self.out, "climb")
            clamber.save_sequence(sequence, folder / "sequence.json")
            with self.world.blamed():
                plan = _plan(
                    sequence, robot, scene, self.planning, folder, report, others
                )
            done = self.execution.simulate(plan, folder, report, None)
            missing = ""
            try:
                clamber.render_run(
                    folder,
                    with_video=self.video,
                    demonstration=(demo, sequence),
                    report=report,
                )
            except ClamberError as e:  # the robot has climbed all the same
                missing = str(e)
            _save_timings(folder, clock)
        if missing and not self.output.quiet:
            sys.stderr.write(f"clamber: {missing}\n")
        return conclude(self.output, folder, plan, done, clock)


@dataclass(frozen=True, kw_only=True)
class ContactsCommand:
    """Find the contacts in a recording, at the person's scale: sequence.json."""

    recording: Annotated[str, tyro.conf.Positional, _shown("RECORDING")]
    """A recording, recording.yaml, or a built-in demonstration by name."""
    scene: Annotated[Path | None, _shown("FILE")] = None
    """The scene.yaml it was recorded in, where the recording has none."""
    fit_floor: bool = False
    """Correct the heights of floor and boxes by what rests on them."""
    out: Place = None
    """The run folder (runs/contacts, then runs/contacts-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Recording to contact sequence."""
        scene = None if self.scene is None else clamber.load_scene(self.scene)
        with self.output.progress() as report:
            report("detect", 0.0, "")
            demo = clamber.load_demo(
                self.recording, scene=scene, fit_floor=self.fit_floor
            )
            sequence = clamber.detect_contacts(demo)
            folder = clamber.new_run_folder(self.out, "contacts")
            clamber.save_sequence(sequence, folder / "sequence.json")
        table = new_table("stance", "region", "from [s]", "to [s]", "contacts")
        for i, stance in enumerate(sequence.stances):
            on = ", ".join(
                f"{' '.join(surfaces)} on {support}"
                for support, surfaces in _by_support(stance).items()
            )
            t0, t1 = sequence.t[i], sequence.t[i + 1]
            table.add_row(str(i), stance.region, f"{t0:.2f}", f"{t1:.2f}", on)
        record = {
            "out": str(folder),
            "stances": len(sequence.stances),
            "notes": list(demo.notes),
        }
        note = "\n".join([*demo.notes, f"the sequence is in {folder}"])
        self.output.show(record, table, note=note)
        return REACHED


def _by_support(stance: clamber.Stance) -> dict[str, list[str]]:
    """The surfaces on each support."""
    found: dict[str, list[str]] = {}
    for c in stance.contacts:
        found.setdefault(c.support, []).append(c.surface)
    return found


@dataclass(frozen=True, kw_only=True)
class PlanCommand:
    """Plan a contact sequence for a robot and a scene: plan, trajectory, scene.xml."""

    sequence: Annotated[Path, tyro.conf.Positional, _shown("SEQUENCE")]
    """A sequence.json."""
    world: Annotated[WorldFlags, Flat]
    planning: Annotated[PlanningFlags, Flat]
    out: Place = None
    """The run folder (runs/plan, then runs/plan-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Contact sequence to trajectory."""
        sequence = clamber.load_sequence(self.sequence)
        robot, scene = self.world.load()
        clock = Clock()
        with self.output.progress() as show:
            folder = clamber.new_run_folder(self.out, "plan")
            clamber.save_sequence(sequence, folder / "sequence.json")
            report = clock.watching(show)
            with self.world.blamed():
                plan = _plan(sequence, robot, scene, self.planning, folder, report)
        record = {"out": str(folder), **plan_record(plan, clock)}
        note = closing(outcome(plan), folder, plan.complete)
        self.output.show(
            record, *keyframe_tables(record), *skipped_tables(plan), note=note
        )
        return REACHED if plan.complete else MISSED


@dataclass(frozen=True, kw_only=True)
class ReplanCommand:
    """Other contacts than the demonstrated ones, ranked, the best planned; or the rest.

    With --from the rest of a run is planned from where the robot is.
    """

    source: Annotated[Path, tyro.conf.Positional, _shown("SEQUENCE|RUN")]
    """A sequence.json; with --from, the run folder whose plan was followed."""
    begin: Annotated[
        str | None,
        tyro.conf.arg(
            name="from",
            metavar="STATE|SECONDS",
            help_behavior_hint="(default: from standing)",
        ),
    ] = None
    """Where the robot is: a state file, or a time of the run's rollout."""
    world: Annotated[WorldFlags, Flat]
    planning: Annotated[PlanningFlags, Flat]
    search: SearchFlags = field(default_factory=SearchFlags)
    """How far to look for contacts that nobody demonstrated."""
    out: Place = None
    """The run folder (runs/replan, then runs/replan-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Sequence to ranked plans, or run and state to the plan of the rest."""
        return self._ranked() if self.begin is None else self._rest(self.begin)

    def _ranked(self) -> int:
        from clamber.planning.substitutes import described
        from clamber.run.folder import save_replanned

        sequence = clamber.load_sequence(self.source)
        robot, scene = self.world.load()
        others = self.search.read()
        with self.output.progress() as report, self.world.blamed():
            found = clamber.replan(
                sequence,
                robot,
                scene,
                options=clamber.PlanOptions(**asdict(self.planning)),
                **others,
                progress=report,
            )
            folder = clamber.new_run_folder(self.out, "replan")
            clamber.save_sequence(sequence, folder / "sequence.json")
            clamber.save_plan(found.best.plan, folder)
            save_replanned(found, folder)
        if self.output.json:  # these two fields and no other
            sys.stdout.write(json.dumps(replanned_record(found)) + "\n")
            return REACHED if found.best.stable else MISSED
        table = new_table("surfaces", "stable", "cost [m]", "moves", "why not")
        for r in found.ranked:
            table.add_row(
                ", ".join(r.surfaces) or "as demonstrated",
                "yes" if r.stable else "no",
                f"{r.cost:.3f}",
                str(len(r.plan.changes)),
                "" if r.stable else outcome(r.plan),
            )
        stable = found.best.stable
        note = "the best one is planned" if stable else described(found)
        self.output.show({}, table, note=closing(note, folder, stable))
        return REACHED if found.best.stable else MISSED

    def _rest(self, begin: str) -> int:
        from clamber.run.state import load_state

        made = clamber.load_plan(self.source)
        if self.world.scene is None and self.world.height is None:
            scene = made.world.scene
        else:
            scene = _scene(self.world.height, self.world.scene)
        others = self.search.read()
        q, touching = load_state(made, self.source, begin)
        with self.output.progress() as report, self.world.blamed():
            report("replan", 0.0, "")
            now = clamber.state_of(made, scene, q, touching, source=begin)
            plan = clamber.replan_rest(made, now, scene, **others, progress=report)
            folder = clamber.new_run_folder(self.out, "replan")
            clamber.save_sequence(plan.sequence, folder / "sequence.json")
            clamber.save_plan(plan, folder)
        record = {"out": str(folder), "done": now.done, **plan_record(plan)}
        on = ", ".join(f"{c.surface} on {c.support}" for c in now.stance)
        note = f"from {on}, {now.done} steps made: {outcome(plan)}"
        tables = keyframe_tables(record)
        self.output.show(
            record,
            *tables,
            *skipped_tables(plan),
            note=closing(note, folder, plan.complete),
        )
        return REACHED if plan.complete else MISSED


@dataclass(frozen=True, kw_only=True)
class TraverseCommand:
    """Cross a scene with a general policy: plan, then simulate."""

    policy: Annotated[Path, tyro.conf.Positional, _shown("POLICY")]
    """A policy.json, as `clamber learn` writes it."""
    scene: Annotated[Path, _shown("FILE")]
    """A scene.yaml."""
    robot: str = "coman"
    """A built-in robot by name, or a robot.yaml."""
    planning: Annotated[PlanningFlags, Flat]
    max_changes: int = _default("planning.records", "PlanOptions", "max_changes")
    """Contact changes at most."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    video: bool = False
    """Draw a video too, not pictures alone."""
    out: Place = None
    """The run folder (runs/traverse, then runs/traverse-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Policy to verdict."""
        if self.max_changes < 1:
            raise InputError(
                "1 or more", source="--max-changes", value=self.max_changes
            )
        policy = clamber.load_policy(self.policy)
        scene = clamber.load_scene(self.scene)
        robot = clamber.load_robot(self.robot)
        options = clamber.PlanOptions(
            **asdict(self.planning), max_changes=self.max_changes
        )
        clock = Clock()
        world = WorldFlags(robot=self.robot, scene=self.scene)
        with self.output.progress() as show:
            report = clock.watching(show)
            with world.blamed():
                plan = clamber.plan_traverse(
                    policy, robot, scene, options=options, progress=report
                )
            folder = clamber.new_run_folder(self.out, "traverse")
            clamber.save_plan(plan, folder)
            done = None
            if plan.complete:
                done = self.execution.simulate(plan, folder, report, None)
            missing = ""
            try:
                clamber.render_run(folder, with_video=self.video, report=report)
            except ClamberError as e:  # the robot has crossed all the same
                missing = str(e)
            _save_timings(folder, clock)
        if missing and not self.output.quiet:
            sys.stderr.write(f"clamber: {missing}\n")
        return conclude(self.output, folder, plan, done, clock)


@dataclass(frozen=True, kw_only=True)
class SimulateCommand:
    """Run a plan in physics: rollout.npz, verdict.json."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    scene: Annotated[Path | None, _shown("TRUTH")] = None
    """The scene.yaml that physics runs, where it is not the planned one."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    output: Printed

    def run(self) -> int:
        """Plan to verdict."""
        plan = clamber.load_plan(self.run_folder)
        clock = Clock()
        with self.output.progress() as show:
            done = self.execution.simulate(
                plan, self.run_folder, clock.watching(show), self.scene
            )
            _save_timings(self.run_folder, clock)
        return conclude(self.output, self.run_folder, plan, done)


@dataclass(frozen=True, kw_only=True)
class LearnCommand:
    """Learn the general policy of demonstrations: policy.json and its pictures."""

    demonstrations: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        _shown("RECORDING|SEQUENCE|NAME"),
    ]
    """Recordings, sequence.json files, or built-in demonstrations (crossing)."""
    out: Annotated[
        Path | None,
        _shown("FILE", "runs/learn/policy.json"),
    ] = None
    """The policy's file; pictures are written beside it."""
    output: Printed

    def run(self) -> int:
        """Demonstrations to a policy."""
        from clamber.run.folder import POLICY, policy_summary
        from clamber.show.plots import save_pictures

        if not self.demonstrations:
            raise InputError("no demonstration: name at least one, such as crossing")
        if self.out is not None and self.out.suffix != ".json":
            raise InputError(
                "a file that ends in .json", source="--out", value=str(self.out)
            )
        with self.output.progress() as report:
            sequences = []
            for k, name in enumerate(self.demonstrations):
                report("detect", k / len(self.demonstrations), name)
                sequences.append(_sequence(name))
            report("detect", 1.0, "")
            policy = clamber.learn_policy(sequences)
            folder = clamber.new_run_folder(self.out and self.out.parent, "learn")
            file = self.out or folder / POLICY
            clamber.save_policy(policy, file)
            report("draw", 0.0, "")
            pictures = save_pictures(policy, file)
            report("draw", 1.0, "")
        record = {
            "out": str(file),
            "pictures": [str(p) for p in pictures],
            **policy_summary(policy),
        }
        tables, notes = [], [*policy.notes]
        for k, one in enumerate((policy, *policy.secondary)):
            tables += policy_tables(one, f"secondary {k}" if k else "")
            notes += one.notes if k else ()
            if k:
                notes.append(f"secondary {k}: {', '.join(one.sources)}")
        note = "\n".join([*notes, f"the policy is in {file}"])
        self.output.show(record, *tables, note=note)
        return REACHED


def _sequence(name: str) -> clamber.ContactSequence:
    """The contact sequence of a file, or what is detected in a recording."""
    path = Path(name)
    if path.suffix == ".json" or path.is_dir():
        return clamber.load_sequence(path)
    return clamber.detect_contacts(clamber.load_demo(name))


@dataclass(frozen=True, kw_only=True)
class RenderCommand:
    """Draw pictures and a video of a run, all of them or one."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    video: bool = False
    """The video alone: MP4 with clamber[video], else an animated WebP."""
    sheet: bool = False
    """The sheet of keyframes alone."""
    frame: Annotated[float | None, _shown("T")] = None
    """One picture alone, at that time [s]."""
    camera: Literal["corner", "side", "front", "behind", "top"] = "corner"
    """From where."""
    transparent: bool = False
    """Robot and obstacles on nothing; with --frame."""
    size: Annotated[
        str | None,
        _shown("1080p|WxH", "frames 1080p"),
    ] = None
    """Of the video, the frame, or each picture of the sheet."""
    out: Annotated[
        Path | None,
        _shown("FILE", "in RUN"),
    ] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run to pictures."""
        self._check()
        with self.output.progress() as report:
            files = self._draw(report)
        names = [str(f) for f in files]
        self.output.show({"files": names}, note="\n".join(names))
        return REACHED

    def _check(self) -> None:
        """One of the three, and flags that go with it."""
        asked = [self.video, self.sheet, self.frame is not None]
        if sum(asked) > 1:
            raise InputError("--video, --sheet, --frame: give one of them alone")
        if self.transparent and self.frame is None:
            raise InputError("--transparent: give --frame too, or leave it out")
        special = self.camera != "corner" or self.size or self.out
        if special and not any(asked):
            raise InputError(
                "--camera, --size, --out: give --video, --sheet or --frame too"
            )

    def _draw(self, report: Report) -> list[Path]:
        if not (self.video or self.sheet or self.frame is not None):
            return clamber.render_run(self.run_folder, report=report)
        from clamber.show import pictures, renderer

        size = None if self.size is None else _picture_size(self.size)
        given: dict[str, Any] = {"camera": self.camera}
        try:
            if self.frame is not None:
                given |= {"out": self.out, "transparent": self.transparent}
                given |= {} if size is None else {"size": size}
                return [pictures.render_frame(self.run_folder, self.frame, **given)]
            plan = clamber.load_plan(self.run_folder)
            if self.sheet:
                path = self.out or self.run_folder / "keyframes.png"
                if path.suffix != ".png":
                    raise InputError("a name that ends in .png", source=path)
                given |= {} if size is None else {"tile": size}
                return [pictures.keyframe_sheet(plan, path, **given)]
            rollout = clamber.load_rollout(self.run_folder)
            given |= {"out": self.out, "size": size, "report": report}
            return [renderer.video(plan, rollout, self.run_folder, **given)]
        except OSError as e:
            raise InputError(
                f"a file that can be written ({e.strerror or e})",
                source="--out",
                value=str(self.out or self.run_folder),
            ) from e


def _picture_size(text: str) -> tuple[int, int]:
    """Width and height of `1080p` (16 to 9) or `1280x720`; even, as videos need."""
    lines = re.fullmatch(r"(\d{1,5})p", text)
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if lines:
        height = int(lines[1])
        size = (2 * round(height * 8 / 9), height)
    elif sides:
        size = (int(sides[1]), int(sides[2]))
    else:
        size = (0, 0)
    if not all(64 <= x <= 4096 and x % 2 == 0 for x in size):
        raise InputError(
            "such as 1080p or 1280x720, even numbers from 64 to 4096",
            source="--size",
            value=text,
        )
    return size


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Write a run as one HTML file: an animation to turn and scrub, plots, tables."""

    run_folder: RunFolder
    """A run folder, whole or not."""
    compare: Annotated[Path | None, _shown("RUN2")] = None
    """Another run, laid beside it."""
    out: Annotated[
        Path | None,
        _shown("FILE", "RUN/report.html"),
    ] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run to one page."""
        with self.output.progress() as report:
            report("report", 0.0, "")
            done = clamber.write_report(
                self.run_folder, compare=self.compare, out=self.out
            )
            report("report", 1.0, "")
        if not self.output.quiet:
            for text in done.missing:
                sys.stderr.write(f"clamber: {text}\n")
        record = {"file": str(done.file), "missing": list(done.missing)}
        self.output.show(record, note=str(done.file))
        return REACHED


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """Look at a run or a recording in the browser, step through it, edit a plan."""

    source: Annotated[str, tyro.conf.Positional, _shown("RUN|RECORDING")]
    """A run folder, whole or not; a recording, or a built-in demonstration by name."""
    demo: Annotated[
        str | None,
        _shown("RECORDING|NAME", "the run's own"),
    ] = None
    """The recording that is shown beside a run."""
    scene: Annotated[Path | None, _shown("FILE")] = None
    """The scene.yaml of a recording that has none."""
    host: Annotated[
        str | None,
        _shown("ADDRESS", "this machine alone"),
    ] = None
    """Address to listen on; 0.0.0.0: every one of this machine."""
    port: Annotated[int | None, _shown("N", "8080")] = None
    """Port, or the next one that is free."""
    output: Printed

    def run(self) -> int:
        """Serve until Ctrl-C."""
        from clamber.show.live import open_view

        place: dict[str, Any] = {"host": self.host, "port": self.port}
        page = open_view(
            self.source,
            demo=self.demo,
            scene=None if self.scene is None else clamber.load_scene(self.scene),
            **{k: v for k, v in place.items() if v is not None},
        )
        try:
            self._say(page)
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            return REACHED
        finally:
            page.close()

    def _say(self, page: Any) -> None:
        """Where the page is, and what it cannot show."""
        if not self.output.quiet:
            for text in page.missing:
                sys.stderr.write(f"clamber: {text}\n")
        lines = [f"the page is at {page.url} (Ctrl-C ends it)"]
        if page.port != page.wanted:
            lines.insert(0, f"port {page.wanted} is in use: {page.port} instead")
        if page.host == "127.0.0.1":
            lines.append(
                f"from another machine: ssh -L {page.port}:127.0.0.1:{page.port}"
                f" {socket.gethostname()}, then the same address there"
            )
        elif page.host in ("0.0.0.0", "::"):
            lines.append(
                f"from another machine: http://{socket.gethostname()}:{page.port}; "
                "whoever reaches it can edit and save"
            )
        record = {"url": page.url, "port": page.port, "missing": page.missing}
        self.output.show(record, note="\n".join(lines))
        sys.stdout.flush()


@dataclass(frozen=True, kw_only=True)
class ExportCommand:
    """Write the motion of a run for other tools: CSV, MCAP (ROS 2), npz (trainers)."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    to: Literal["csv", "mcap", "npz"]
    """The format."""
    rate: Annotated[
        int | None,
        _shown("HZ", "100; npz 50; at most 1000"),
    ] = None
    """Samples per second, a divisor of 1000."""
    lead_in: Annotated[str | None, _shown("FILE|home")] = None
    """Measured joint angles [rad] by name (YAML or JSON), to start from."""
    lead_in_speed: Annotated[float, _shown("RAD/S")] = field(
        default_factory=lambda: import_module("clamber.run.lead_in").SPEED
    )
    """Largest joint speed on the way from there to the first posture."""
    layout: Annotated[
        Literal["mjlab", "holosoma"] | None,
        _shown("mjlab|holosoma", "mjlab; npz alone"),
    ] = None
    """Whose joint_pos and joint_vel an npz holds."""
    out: Annotated[
        Path | None,
        _shown("FILE", "RUN/motion.FORMAT"),
    ] = None
    """The file."""
    output: Printed

    def run(self) -> int:
        """Run folder to a file."""
        done = clamber.export_run(
            self.run_folder,
            to=self.to,
            out=self.out,
            rate=self.rate,
            lead_in=self.lead_in,
            lead_in_speed=self.lead_in_speed,
            layout=self.layout,
        )
        parts = [f"{done.samples} samples at {done.rate} Hz"]
        if done.lead_in:
            parts.append(f"the first {done.lead_in:.2f} s lead in")
        parts.append(
            "with contact forces" if done.forces else "no forces: not simulated"
        )
        note = f"{done.file}: {', '.join(parts)}"
        self.output.show({**asdict(done), "file": str(done.file)}, note=note)
        return REACHED


@dataclass(frozen=True, kw_only=True)
class SceneCommand:
    """Check a scene, say what is in it and, with --out, draw it."""

    file: Annotated[Path, tyro.conf.Positional, _shown("FILE")]
    """A scene.yaml, or boxes as OBJ or MJCF."""
    robot: str = "coman"
    """Who stands at its start: a built-in robot by name, or a robot.yaml."""
    out: Annotated[Path | None, _shown("DIR")] = None
    """Where to write the picture scene.png."""
    output: Printed

    def run(self) -> int:
        """Scene file to a table of its supports."""
        scene = clamber.load_scene(self.file)
        table = new_table("support", "centre [m]", "slope [deg]", "friction", "")
        supports = []
        faults = clamber.check_scene(scene)
        for s in scene.supports:
            centre = [round(float(x), 6) for x in s.position]
            slope = math.degrees(math.acos(min(1.0, float(s.normal[2]))))
            fault = faults.get(s.name, "")
            supports.append(
                {
                    "name": s.name,
                    "centre": centre,
                    "slope": round(slope, 4),
                    "friction": s.friction,
                    "fault": fault,
                }
            )
            text = " ".join(f"{x:.3f}" for x in centre)
            table.add_row(s.name, text, f"{slope:.1f}", f"{s.friction:g}", fault)
        record: dict[str, Any] = {"supports": supports, "picture": None}
        note = ""
        if self.out is not None:
            robot = clamber.load_robot(self.robot)
            folder = clamber.new_run_folder(self.out, "scene")
            record["picture"] = note = str(
                clamber.draw_scene(robot, scene, folder / "scene.png")
            )
        self.output.show(record, table, note=note)
        return MISSED if faults else REACHED


@dataclass(frozen=True, kw_only=True)
class RobotCommand:
    """Bring a robot: init proposes a robot.yaml, check says what is wrong with one."""

    action: tyro.conf.Positional[Literal["init", "check"]]
    """init: from an MJCF or URDF. check: a robot.yaml."""
    model: Annotated[str, tyro.conf.Positional, _shown("MODEL")]
    """init: an MJCF or URDF file. check: a robot.yaml, or a built-in robot by name."""
    effort: Annotated[Path | None, _shown("FILE")] = None
    """init: effort limits the model lacks: YAML {joint: N m}, or another model."""
    out: Annotated[
        Path | None,
        _shown("DIR", "init: robots/NAME"),
    ] = None
    """Where to write robot.yaml and robot.xml (init), and the picture robot.png."""
    output: Printed

    def run(self) -> int:
        """Description to a proposal, or a robot file to what a planner sees of it."""
        notes: list[str] = []
        path, out = self.model, self.out
        if self.action == "init":
            proposal = clamber.propose_robot(self.model, effort_from=self.effort)
            out = out or Path("robots") / proposal.name
            if out.exists() and (not out.is_dir() or any(out.iterdir())):
                raise InputError(
                    "a new or empty folder", source="--out", value=str(out)
                )
            out = clamber.new_run_folder(out, "robot")
            clamber.save_proposal(proposal, out)
            path, notes = str(out / "robot.yaml"), list(proposal.notes)
        robot = clamber.load_robot(path)
        found = clamber.check_robot(robot)
        table = new_table("limb", "from", "over", "to", "surfaces", "length [m]")
        for limb in robot.limbs.values():
            table.add_row(
                limb.name,
                limb.root,
                limb.middle,
                limb.end,
                ", ".join(limb.surfaces),
                f"{found.lengths[limb.name]:.3f}",
            )
        if out is not None:
            try:
                clamber.draw_robot(robot, out / "robot.png")
            except ClamberError as e:  # the robot is checked all the same
                notes.append(str(e))
        record = {
            "out": None if out is None else str(out),
            "name": robot.name,
            "mass": round(found.mass, 4),
            "joints": found.joints,
            "surfaces": list(robot.surfaces),
            "segments": found.segments,
            "knee_height": found.knee_height,
            "com_height": found.com_height,
            "faults": list(found.faults),
            "notes": notes,
        }
        lengths = ", ".join(f"{k} {v:.3f} m" for k, v in found.segments.items())
        lines = [
            *(f"note: {x}" for x in notes),
            *(f"wrong: {x}" for x in found.faults),
            f"{robot.name}: {found.mass:.2f} kg, {found.joints} actuated joints, CoM"
            f" {found.com_height:.3f} m and knees {found.knee_height:.3f} m high as it"
            f" stands; {lengths}",
        ]
        if out is not None:
            lines.append(f"the files are in {out}: look at robot.png")
        self.output.show(record, table, note="\n".join(lines))
        return MISSED if found.faults else REACHED


@dataclass(frozen=True, kw_only=True)
class SweepCommand:
    """Many climbs, by a spec: one row a run, success against each factor."""

    spec: Annotated[Path, tyro.conf.Positional, _shown("SPEC")]
    """A spec.yaml: what all runs share, and a grid, a random sample or a search."""
    workers: Annotated[
        int | None,
        _shown("N", "one a core"),
    ] = None
    """Processes that do the runs."""
    scheduler: Annotated[str | None, _shown("ADDRESS")] = None
    """A dask scheduler, whose workers do the runs instead."""
    out: Place = None
    """The sweep's folder (runs/<name of the spec>); it is gone on with if it exists."""
    output: Printed

    def run(self) -> int:
        """Spec to table and curves."""
        from clamber.study import curves, sweep
        from clamber.study import spec as experiment

        if self.workers is not None and self.workers < 1:
            raise InputError("1 or more", source="--workers", value=self.workers)
        if self.workers is not None and self.scheduler is not None:
            raise InputError("--workers, --scheduler: give one of them alone")
        spec = experiment.load_spec(self.spec)
        folder = self.out or Path("runs") / self.spec.stem
        sweep.check_inputs(spec)
        try:
            with self.output.progress() as report:
                rows, pace = sweep.run_sweep(
                    spec,
                    folder,
                    workers=self.workers,
                    scheduler=self.scheduler,
                    progress=report,
                )
                report("draw", 0.0, "")
                curves.save_curves(spec, rows, folder)
                report("draw", 1.0, "")
        except KeyboardInterrupt:
            sys.stderr.write(
                f"clamber: interrupted; the finished rows are in {folder}, and the same"
                " command goes on from there\n"
            )
            return INTERRUPTED
        summaries = curves.summarise(spec, rows)
        table = new_table(
            "controller", "to", "runs", "reached", "95 % interval", "half at",
            "95 % interval",
        )  # fmt: skip
        for s in summaries:
            table.add_row(
                s.controller,
                "" if s.end is None else f"{s.factor} {s.end:g}",
                str(s.runs),
                f"{s.reached} ({100 * s.share:.1f} %)",
                f"{100 * s.low:.1f} to {100 * s.high:.1f} %",
                s.half if isinstance(s.half, str) else f"{s.half:.4g}",
                " to ".join(
                    "-" if x is None else f"{x:.4g}" for x in (s.half_from, s.half_to)
                )
                if s.factor
                else "",
            )
        note = f"{len(rows)} rows, {pace.runs} of them new; the files are in {folder}"
        errors = sum(s.errors for s in summaries)
        if errors:
            note = f"{errors} runs crashed and count as not reached; {note}"
        record = {
            "out": str(folder),
            "rows": len(rows),
            "new": pace.runs,
            "summary": [asdict(s) for s in summaries],
        }
        self.output.show(record, table, note=note)
        return REACHED


Command = (
    Annotated[ClimbCommand, tyro.conf.subcommand("climb")]
    | Annotated[ContactsCommand, tyro.conf.subcommand("contacts")]
    | Annotated[PlanCommand, tyro.conf.subcommand("plan")]
    | Annotated[ReplanCommand, tyro.conf.subcommand("replan")]
    | Annotated[TraverseCommand, tyro.conf.subcommand("traverse")]
    | Annotated[SimulateCommand, tyro.conf.subcommand("simulate")]
    | Annotated[LearnCommand, tyro.conf.subcommand("learn")]
    | Annotated[RenderCommand, tyro.conf.subcommand("render")]
    | Annotated[ReportCommand, tyro.conf.subcommand("report")]
    | Annotated[ViewCommand, tyro.conf.subcommand("view")]
    | Annotated[ExportCommand, tyro.conf.subcommand("export")]
    | Annotated[SceneCommand, tyro.conf.subcommand("scene")]
    | Annotated[RobotCommand, tyro.conf.subcommand("robot")]
    | Annotated[SweepCommand, tyro.conf.subcommand("sweep")]
)


def _plan(
    sequence: clamber.ContactSequence,
    robot: clamber.Robot,
    scene: clamber.Scene,
    flags: PlanningFlags,
    folder: Path,
    report: Report,
    others: Mapping[str, Any] | None = None,
) -> clamber.Plan:
    """Plan and save; `others`: how others are looked for where the shown ones fail."""
    options = clamber.PlanOptions(**asdict(flags))
    world = (sequence, robot, scene)
    if others is None:
        result = clamber.plan(*world, options=options, progress=report)
    else:
        result = clamber.plan_or_replan(
            *world,
            options=options,
            **others,
            progress=report,
        )
    report("save", 0.0, "")
    clamber.save_plan(result, folder)
    report("save", 1.0, "")
    return result


def _save_timings(folder: Path, clock: Clock) -> None:
    """Add the seconds of the stages that were watched."""
    from clamber.run.folder import save_timings

    finer = ("plan", "trajectory")  # of which the plan itself knows the parts
    stages = clock.stages().items()
    save_timings(folder, {k: v for k, v in stages if k not in finer})
