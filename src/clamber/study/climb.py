"""One whole climb, from the recording to the verdict of physics.

A `Climb` is the flags of `clamber climb`, by the same names, and nothing else: whatever
a climb did can be done again from the command line.
"""

from __future__ import annotations

import functools
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import pydantic

from clamber.contact.contact import ContactSequence
from clamber.errors import InputError, input_error
from clamber.execution.disturbance import Disturbance
from clamber.execution.events import Replanned
from clamber.execution.servo import ControlMode
from clamber.execution.simulation import DEFAULT_CONTROLLER, simulate
from clamber.execution.verdict import Figure, judge
from clamber.model.arguments import checks_types
from clamber.model.progress import Progress, silent
from clamber.model.records import short_repr
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.terrain import load_scene
from clamber.model.world import PHYSICS_STEP
from clamber.planning.planner import plan
from clamber.planning.records import (
    Budget,
    Method,
    Plan,
    PlanOptions,
)
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.run.folder import (
    SEQUENCE,
    save_plan,
    save_rollout,
    save_sequence,
    save_verdict,
)

Contacts = Literal["any", "demonstrated"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Climb:
    """One climb of a sweep, by the flags of `clamber climb`.

    Attributes:
        demo: A recording, or a built-in demonstration by name.
        robot: A built-in robot by name, or a robot.yaml.
        height: Height of the one box [m]; either this or `scene`.
        scene: A scene.yaml.
        method: How contact positions are optimised.
        speed: Largest joint speed [rad/s], or `max`.
        robust: Keep to contact changes that hold in the worst case, see `PlanOptions`.
        controller: `pid` or `mixed`.
        contacts: `any`: other contacts where the demonstrated ones have no stable plan;
            `demonstrated`: these only.
        budget: Time limit of all planning [s]; None: no limit.
        search: How far to search for other contacts.
        disturb: What the planner does not know.
    """

    demo: str = "climb"
    robot: str = "coman"
    height: float | None = None
    scene: str | None = None
    method: Method = field(default_factory=lambda: PlanOptions().method)
    speed: float | Literal["max"] = field(default_factory=lambda: PlanOptions().speed)
    robust: bool = False
    controller: ControlMode = DEFAULT_CONTROLLER
    contacts: Contacts = "any"
    budget: float | None = None
    search: Budget = field(default_factory=Budget)
    disturb: Disturbance = field(default_factory=Disturbance)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Check that there is one scene, and one bound.

        Raises:
            InputError: Height and scene, or neither; a budget below 0, or two.
        """
        if self.budget is not None and not self.budget >= 0:
            raise InputError("0 or more", field="budget", value=self.budget)
        if self.search.seconds is not None:
            raise InputError("no bound: that is `budget`", field="search.seconds")
        if (self.height is None) == (self.scene is None):
            raise InputError("height or scene, one of them", field="height")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClimbResult:
    """The outcome of a climb.

    Attributes:
        reached: The verdict.
        why: What failed first; empty where nothing did.
        seconds: Duration of the motion, to its end or the fall [s]; 0 without a plan.
        replans: How often the remaining motion was replanned during execution.
        effort: Largest effort of any joint, share of its limit.
    """

    reached: bool
    why: str = ""
    seconds: float = 0.0
    replans: int = 0
    effort: float = 0.0


_CLIMB: pydantic.TypeAdapter[Climb] = pydantic.TypeAdapter(Climb)
GROUPS = {"search": Budget, "disturb": Disturbance}  # flags such as `disturb.mass`
FLAGS = tuple(f.name for f in fields(Climb) if f.name not in GROUPS) + tuple(
    f"{group}.{f.name}"
    for group, kind in GROUPS.items()
    for f in fields(kind)
    if (group, f.name) != ("search", "seconds")  # that is `budget`
)


def climb_of(flags: Mapping[str, Any]) -> Climb:
    """The climb of flags by name, such as `{"height": 0.275, "disturb.mass": 1.1}`.

    Raises:
        InputError: There is no such flag, or its value cannot be used.
    """
    for name in flags:
        if name not in FLAGS:
            raise InputError(f"one of {', '.join(FLAGS)}", field="flag", value=name)
    tree: dict[str, Any] = {g: {} for g in GROUPS}
    for name, value in flags.items():
        group, _, own = name.rpartition(".")
        (tree[group] if group else tree)[own] = value
    try:
        return _CLIMB.validate_python(tree)
    except pydantic.ValidationError as e:
        raise input_error(e, None) from e


def command_of(climb: Climb) -> str:
    """The line that does it again: robot, scene, controller, and what differs."""
    words = ["clamber", "climb"]
    for name in FLAGS:
        group, _, own = name.rpartition(".")
        home = getattr(climb, group) if group else climb
        value = getattr(home, own)
        default = {
            f.name: f.default_factory() if callable(f.default_factory) else f.default
            for f in fields(home)
        }[own]
        if value is None or (value == default and name not in ("robot", "controller")):
            continue
        text = repr(value) if isinstance(value, float) else str(value)
        # A number like -5e-05 would be taken for a flag.
        words += [f"--{name}={text}"] if text.startswith("-") else [f"--{name}", text]
    return shlex.join(words)


def scene_of(height: float | None, path: str | Path | None) -> Scene:
    """The scene of a file, or the one box of that height.

    Raises:
        InputError: The file or the height cannot be used.
    """
    if path is not None:
        return load_scene(path)
    assert height is not None
    try:
        return Scene.from_height(height)
    except InputError as e:
        raise InputError(e.expected, "--height", value=height) from e


@checks_types
def run_climb(
    climb: Climb, *, folder: Path | None = None, progress: Progress = silent
) -> ClimbResult:
    """Detect, plan, simulate, judge.

    A scene out of the robot's reach and a plan that misses a step are results: the
    robot does not get there. An incomplete plan is not simulated.

    Args:
        climb: Recording, robot, scene and how.
        folder: Folder in which each stage's result is saved as soon as it is made.
        progress: Called with stage, share and note.

    Raises:
        InputError: Recording, robot or scene cannot be used.
        OSError: The folder cannot be written.
    """
    # One process does many climbs that differ in their disturbances alone.
    shared = replace(climb, controller="mixed", disturb=Disturbance())
    try:
        if folder is None:
            made = _planned(shared)
        else:
            made = _plan(shared, folder, progress)
        if not made.complete or made.trajectory is None:
            return ClimbResult(reached=False, why=f"no plan: {made.why_not}")
        rollout = simulate(
            made,
            controller=climb.controller,
            disturbance=climb.disturb,
            progress=progress,
        )
    except InputError as e:
        return ClimbResult(reached=False, why=f"no plan: {e}")
    verdict = judge(made, rollout)
    if folder is not None:
        progress("save run", 0.0, "")
        save_rollout(made, rollout, folder)
        save_verdict(verdict, folder)
        progress("save run", 1.0, "")
    wrong = [str(name) for name, c in verdict.criteria.items() if not c.ok]
    if rollout.fell:
        wrong.insert(0, "fell")
    elif rollout.stopped:
        wrong.insert(0, f"stopped: {rollout.stopped}")
    return ClimbResult(
        reached=verdict.reached,
        why="" if verdict.reached else wrong[0],
        seconds=round(len(rollout.ctrl) * PHYSICS_STEP, 6),
        replans=sum(isinstance(e, Replanned) for e in rollout.events),
        effort=round(verdict.criteria[Figure.EFFORT].value, 6),
    )


@functools.lru_cache(maxsize=2)
def _detected(demo: str) -> ContactSequence:
    return detect_contacts(load_demo(demo))


@functools.lru_cache(maxsize=4)
def _planned(climb: Climb) -> Plan:
    return _plan(climb, None, silent)


def _plan(climb: Climb, folder: Path | None, progress: Progress) -> Plan:
    """The plan of a climb; saved, with the sequence, where there is a folder for it."""
    robot, scene = load_robot(climb.robot), scene_of(climb.height, climb.scene)
    progress("detect", 0.0, "")
    sequence = _detected(climb.demo)
    made = plan(
        sequence,
        robot,
        scene,
        options=PlanOptions(
            method=climb.method, speed=climb.speed, robust=climb.robust
        ),
        contacts=climb.contacts,
        budget=replace(climb.search, seconds=climb.budget),
        progress=progress,
    )
    if folder is not None:
        progress("save", 0.0, "")
        save_sequence(sequence, folder / SEQUENCE)
        save_plan(made, folder)
        progress("save", 1.0, "")
    return made
