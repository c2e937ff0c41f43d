"""The command line: flags in, tables out.

Every command is a dataclass whose fields are its flags and whose `run` calls the public
functions in order, as `clamber.<name>`: those are imported on first use, so that
`--help` answers at once. Progress goes to stderr, results to stdout.

"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import clamber
from clamber.cli.flags import (
    ExecutionFlags,
    Flat,
    Place,
    PlanningFlags,
    Printed,
    RecordingFlags,
    RobotName,
    RunFolder,
    SearchFlags,
    WorldFlags,
    default_of,
    scene_of,
    shown,
)
from clamber.cli.output import (
    MISSED,
    REACHED,
    Clock,
    Output,
    Switch,
    closing,
    conclude,
    filling,
    keyframe_tables,
    new_table,
    outcome,
    plan_record,
    policy_tables,
    replanned_record,
    skipped_tables,
)
from clamber.cli.tools import (
    ExportCommand,
    RenderCommand,
    ReportCommand,
    RobotCommand,
    SceneCommand,
    SweepCommand,
    ViewCommand,
)
from clamber.errors import ClamberError, InputError
from clamber.model.progress import Progress
from clamber.show.track import DRAWING, EXECUTION, PLANNING, Track


@dataclass(frozen=True, kw_only=True)
class ClimbCommand:
    """The whole job: detect contacts, plan, simulate; all files in one run folder."""

    demo: Annotated[str, shown("RECORDING|NAME")] = "climb"
    """A recording, or a built-in demonstration (climb, crossing)."""
    recorded: Annotated[RecordingFlags, Flat]
    world: Annotated[WorldFlags, Flat]
    planning: Annotated[PlanningFlags, Flat]
    contacts: Literal["any", "demonstrated"] = "any"
    """any: other contacts where the demonstrated ones have no stable plan."""
    search: SearchFlags = field(default_factory=SearchFlags)
    """How far to look for contacts beyond the demonstrated ones."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    video: Switch = False
    """Draw pictures and a video."""
    out: Place = None
    """The run folder (runs/climb, then runs/climb-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Recording to verdict."""
        robot, scene = self.world.load()
        others = (
            None if self.contacts == "demonstrated" else self.search.read(self.planning)
        )
        clock = Clock()
        drawn = DRAWING if self.video else ()
        track = Track("detect", *PLANNING, *EXECUTION, *drawn)
        with self.output.progress(track, more=self.video) as show:
            report = clock.watching(show)
            report("detect", 0.0, "")
            demo = self.recorded.load(self.demo, None)
            sequence = clamber.detect_contacts(demo)
            report("detect", 1.0, "; ".join(demo.notes[:1]))
            folder = clamber.new_run_folder(self.out, "climb")
            with filling(folder), self.world.blamed():
                clamber.save_sequence(sequence, folder / "sequence.json")
                plan = _plan(
                    sequence, robot, scene, self.planning, folder, report, others
                )
                done = self.execution.simulate(plan, folder, report, None)
        usual = ("recognised", "unit:", "gaps", "fitted", "not fitted")
        self.output.warn(*(n for n in demo.notes if not n.startswith(usual)))
        self.output.warn(*scene.notes)
        code = conclude(self.output, folder, plan, done, clock, drawn=self.video)
        if self.video:
            _draw(self.output, folder, clock, track, demonstration=(demo, sequence))
        _save_timings(folder, clock)
        return code


@dataclass(frozen=True, kw_only=True)
class ContactsCommand:
    """Find the contacts in a recording, at the person's scale: sequence.json."""

    recording: Annotated[str, tyro.conf.Positional, shown("RECORDING")]
    """A recording, recording.yaml, or a built-in demonstration by name."""
    scene: Annotated[Path | None, shown("FILE")] = None
    """The scene.yaml it was recorded in, where the recording has none."""
    recorded: Annotated[RecordingFlags, Flat]
    out: Place = None
    """The run folder (runs/contacts, then runs/contacts-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Recording to contact sequence."""
        scene = None if self.scene is None else clamber.load_scene(self.scene)
        with self.output.progress(Track("detect")) as report:
            report("detect", 0.0, "")
            demo = self.recorded.load(self.recording, scene)
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

    sequence: Annotated[Path, tyro.conf.Positional, shown("SEQUENCE")]
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
        with self.output.progress(Track(*PLANNING)) as show:
            folder = clamber.new_run_folder(self.out, "plan")
            report = clock.watching(show)
            with filling(folder), self.world.blamed():
                clamber.save_sequence(sequence, folder / "sequence.json")
                plan = _plan(sequence, robot, scene, self.planning, folder, report)
        record = {"out": str(folder), **plan_record(plan, clock)}
        note = closing(outcome(plan), folder, plan.complete, plan)
        self.output.show(
            record, *keyframe_tables(record), *skipped_tables(plan), note=note
        )
        return REACHED if plan.complete else MISSED


@dataclass(frozen=True, kw_only=True)
class ReplanCommand:
    """Plan other contacts than the demonstrated ones; or, with --from, the rest."""

    source: Annotated[Path, tyro.conf.Positional, shown("SEQUENCE|RUN")]
    """A sequence.json; with --from, the run folder whose plan was followed."""
    begin: Annotated[
        str | None,
        tyro.conf.arg(
            name="from",
            metavar="STATE|SECONDS",
            help_behavior_hint="(default: from standing)",
        ),
    ] = None
    """Where the robot is: a state file, or a time of the run's rollout [s]."""
    world: Annotated[WorldFlags, Flat]
    planning: Annotated[PlanningFlags, Flat]
    search: SearchFlags = field(default_factory=SearchFlags)
    """How far to look for contacts beyond the demonstrated ones."""
    out: Place = None
    """The run folder (runs/replan, then runs/replan-2 ...)."""
    output: Printed

    def run(self) -> int:
        """Sequence to ranked plans, or run and state to the plan of the rest."""
        return self._ranked() if self.begin is None else self._rest(self.begin)

    def _ranked(self) -> int:
        from clamber.planning.records import told
        from clamber.run.folder import save_replanned

        sequence = clamber.load_sequence(self.source)
        robot, scene = self.world.load()
        others = self.search.read(self.planning)
        stages = Track("plan", "save")
        with self.output.progress(stages) as report, self.world.blamed():
            found = clamber.replan(
                sequence,
                robot,
                scene,
                options=self.planning.options(),
                **others,
                progress=report,
            )
            folder = clamber.new_run_folder(self.out, "replan")
            report("save", 0.0, "")
            with filling(folder):
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
        note = "the best one is planned" if stable else told(found.tried)
        self.output.show({}, table, note=closing(note, folder, stable))
        return REACHED if found.best.stable else MISSED

    def _rest(self, begin: str) -> int:
        from clamber.run.state import load_state

        made = clamber.load_plan(self.source)
        if self.world.scene is None and self.world.height is None:
            scene = made.world.scene
        else:
            scene = scene_of(self.world.height, self.world.scene)
        others = self.search.read(self.planning)
        q, touching = load_state(made, self.source, begin)
        stages = Track(*PLANNING)
        with self.output.progress(stages) as report, self.world.blamed():
            report("plan", 0.0, "")
            now = clamber.state_of(made, scene, q, touching, source=begin)
            plan = clamber.plan(
                made.policy or made.sequence,
                made.world.robot,
                scene,
                start=now,
                options=made.options,
                **others,
                progress=report,
            )
            folder = clamber.new_run_folder(self.out, "replan")
            report("save", 0.0, "")
            with filling(folder):
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
            note=closing(note, folder, plan.complete, plan),
        )
        return REACHED if plan.complete else MISSED


@dataclass(frozen=True, kw_only=True)
class TraverseCommand:
    """Cross a scene with a general policy: plan, then simulate."""

    policy: Annotated[Path, tyro.conf.Positional, shown("POLICY")]
    """A policy.json, as `clamber learn` writes it."""
    scene: Annotated[Path, shown("FILE")]
    """A scene.yaml."""
    robot: RobotName = "coman"
    """A built-in robot by name, or a robot.yaml."""
    planning: Annotated[PlanningFlags, Flat]
    max_changes: int = default_of("planning.records", "PlanOptions", "max_changes")
    """Contact changes at most."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    video: Switch = False
    """Draw pictures and a video."""
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
        options = self.planning.options(max_changes=self.max_changes)
        budget = self.planning.bound()
        clock = Clock()
        world = WorldFlags(robot=self.robot, scene=self.scene)
        track = Track(*PLANNING, *EXECUTION, *(DRAWING if self.video else ()))
        with self.output.progress(track, more=self.video) as show:
            report = clock.watching(show)
            with world.blamed():
                plan = clamber.plan(
                    policy,
                    robot,
                    scene,
                    options=options,
                    budget=budget,
                    progress=report,
                )
            folder = clamber.new_run_folder(self.out, "traverse")
            with filling(folder):
                report("save", 0.0, "")
                clamber.save_plan(plan, folder)
                report("save", 1.0, "")
                done = None
                if plan.complete:
                    done = self.execution.simulate(plan, folder, report, None)
        code = conclude(self.output, folder, plan, done, clock, drawn=self.video)
        if self.video:
            _draw(self.output, folder, clock, track)
        _save_timings(folder, clock)
        return code


@dataclass(frozen=True, kw_only=True)
class SimulateCommand:
    """Run a plan in physics: rollout.npz, verdict.json."""

    run_folder: RunFolder
    """A run folder that holds a plan."""
    scene: Annotated[Path | None, shown("TRUTH")] = None
    """The scene.yaml that physics runs, where it is not the planned one."""
    pause: Annotated[float | None, shown("SECONDS")] = None
    """When the robot is told to slow down and stand for 10 s; then it goes on."""
    execution: Annotated[ExecutionFlags, tyro.conf.arg(name="")]
    output: Printed

    def run(self) -> int:
        """Plan to verdict."""
        plan = clamber.load_plan(self.run_folder)
        clock = Clock()
        stages = Track(*EXECUTION)
        with self.output.progress(stages) as show, filling(self.run_folder):
            done = self.execution.simulate(
                plan, self.run_folder, clock.watching(show), self.scene, self.pause
            )
            _save_timings(self.run_folder, clock)
        return conclude(self.output, self.run_folder, plan, done)


@dataclass(frozen=True, kw_only=True)
class LearnCommand:
    """Learn the general policy of demonstrations: policy.json and its pictures."""

    demonstrations: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        shown("RECORDING|SEQUENCE|NAME"),
    ]
    """Recordings, sequence.json files, or built-in demonstrations (crossing)."""
    out: Annotated[Path | None, shown("FILE", "runs/learn/policy.json")] = None
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
        with self.output.progress(Track("detect", "draw")) as report:
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
    from clamber.recording.built_in import BUILT_IN

    path = Path(name)
    if path.suffix == ".json" or (name not in BUILT_IN and path.is_dir()):
        return clamber.load_sequence(path)
    return clamber.detect_contacts(clamber.load_demo(name))


COMMANDS = {
    "climb": ClimbCommand,
    "contacts": ContactsCommand,
    "plan": PlanCommand,
    "replan": ReplanCommand,
    "traverse": TraverseCommand,
    "simulate": SimulateCommand,
    "learn": LearnCommand,
    "render": RenderCommand,
    "report": ReportCommand,
    "view": ViewCommand,
    "export": ExportCommand,
    "scene": SceneCommand,
    "robot": RobotCommand,
    "sweep": SweepCommand,
}


def _plan(
    sequence: clamber.ContactSequence,
    robot: clamber.Robot,
    scene: clamber.Scene,
    flags: PlanningFlags,
    folder: Path,
    report: Progress,
    others: Mapping[str, Any] | None = None,
) -> clamber.Plan:
    """Plan and save; `others`: how alternative contacts are searched for."""
    result = clamber.plan(
        sequence,
        robot,
        scene,
        options=flags.options(),
        contacts="demonstrated" if others is None else "any",
        **(others or {"budget": flags.bound()}),
        progress=report,
    )
    report("save", 0.0, "")
    clamber.save_plan(result, folder)
    report("save", 1.0, "")
    return result


def _draw(
    output: Output,
    folder: Path,
    clock: Clock,
    track: Track,
    **options: Any,
) -> None:
    """Pictures and video, after the verdict has been shown."""
    missing, files = (), []
    with output.progress(track) as show, filling(folder):
        report = clock.watching(show)
        try:
            files = clamber.render_run(folder, report=report, **options)
        except ClamberError as e:  # the climb is as it is all the same
            missing = (str(e),)
    output.warn(*missing)
    if files:
        page = f"`clamber report {folder}` makes a page of it"
        output.tell(f"{files[-1]} shows it; {page}")


def _save_timings(folder: Path, clock: Clock) -> None:
    """Add the seconds of the stages that were watched."""
    from clamber.run.folder import save_timings

    finer = ("plan", "search", "trajectory")  # of which the plan itself knows all
    stages = clock.stages().items()
    save_timings(folder, {k: v for k, v in stages if k not in finer})
