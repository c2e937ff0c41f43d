"""Flags that several commands share."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args

import tyro

import clamber
from clamber.cli.output import (
    Output,
    Switch,
)
from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.model.progress import Progress

DEFAULT_HEIGHT = 0.275  # [m] of the box where no scene is given


def default_of(module: str, record: str, name: str) -> Any:
    """A field whose default is an options record's, looked up when it is needed."""
    return field(
        default_factory=lambda: getattr(
            getattr(import_module(f"clamber.{module}"), record)(), name
        )
    )


Flat = tyro.conf.OmitArgPrefixes


Printed = Annotated[Output, Flat]


REGISTRY = tyro.constructors.ConstructorRegistry()


@REGISTRY.primitive_rule
def _left_out(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """A number or a file that may be left out: no value stands for that."""
    kinds = get_args(info.type)
    kind, *others = [k for k in kinds if k is not NoneType] or [None]
    if NoneType not in kinds or others or kind not in (int, float, str, Path):
        return None
    word = "a whole number" if kind is int else "a number"

    def value(texts: list[str]) -> Any:
        try:
            return kind(texts[0])
        except ValueError as e:
            raise ValueError(f"expected {word}, got {texts[0]!r}") from e

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar={int: "N", float: "X", str: "TEXT", Path: "FILE"}[kind],
        instance_from_str=value,
        is_instance=lambda x: x is None or isinstance(x, kind),
        str_from_instance=lambda x: ["none" if x is None else str(x)],
    )


def shown(metavar: str, default: str | None = None) -> Any:
    """How a flag's value is called in help, and its default, where that is no value."""

    def hint(value: str) -> str:
        told = value if default is None else default
        return "" if told in ("", "none", "False") else f"(default: {told})"

    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


RobotName = Annotated[str, shown("NAME|FILE")]


Place = Annotated[Path | None, shown("DIR")]


RunFolder = Annotated[Path, tyro.conf.Positional, shown("RUN")]


@dataclass(frozen=True, kw_only=True)
class RecordingFlags:
    """What a recording file does not say: units, axes, names, scene."""

    fit_floor: Switch = False
    """Correct the heights of floor and boxes by whatever rests on them."""
    subject: Annotated[str | None, shown("NAME")] = None
    """Which person, where several were recorded."""
    body_model: Annotated[Path | None, shown("FILE")] = None
    """SMPL's body model (.npz, .pkl), for poses without joints."""
    demo_robot: Annotated[str | None, shown("NAME|FILE")] = None
    """Whose motion it is, where it is a robot's: a built-in robot or a robot.yaml."""

    def load(self, path: str, scene: clamber.Scene | None) -> clamber.Demonstration:
        """The recording."""
        return clamber.load_demo(
            path,
            scene=scene,
            fit_floor=self.fit_floor,
            subject=self.subject,
            body_model=self.body_model,
            robot=self.demo_robot,
        )


@dataclass(frozen=True, kw_only=True)
class WorldFlags:
    """Which robot, and where."""

    robot: RobotName = "coman"
    """A robot by name, or a robot.yaml."""
    height: Annotated[float | None, shown("METRES", f"{DEFAULT_HEIGHT}")] = None
    """One box of 1.0 x 1.2 m with this height, 0.23 m in front of the ankles."""
    scene: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FILE", help_behavior_hint="(instead of --height)"),
    ] = None
    """A scene.yaml, boxes as OBJ, MJCF, URDF or SDF, a mesh, or a cloud of points."""

    def load(self) -> tuple[clamber.Robot, clamber.Scene]:
        """Robot and scene, the scene first checked as the cheaper one."""
        scene = scene_of(self.height, self.scene)
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

    method: Literal["direct", "lbfgs", "gradient"] = default_of(
        "planning.records", "PlanOptions", "method"
    )
    """How contact positions are optimised."""
    speed: Annotated[float | Literal["max"], shown("RAD/S|max")] = default_of(
        "planning.records", "PlanOptions", "speed"
    )
    """Largest joint speed; max: as fast as torques and friction allow."""
    robust: Switch = False
    """Keep a margin for a mass, friction, CoM and contacts that are a little off."""
    budget: Annotated[float | None, shown("SECONDS", "no bound")] = None
    """For all planning; with a bound, what is found depends on the machine."""

    def options(self, **more: Any) -> clamber.PlanOptions:
        """With other options of planning."""
        return clamber.PlanOptions(
            method=self.method,
            speed=self.speed,
            robust=self.robust,
            **more,
        )

    def bound(self, **more: Any) -> clamber.Budget:
        """The budget, with other bounds."""
        try:
            return clamber.Budget(seconds=self.budget, **more)
        except InputError as e:
            name = str(e.field).removesuffix(".seconds")
            flag = "budget" if name == "search" else name
            raise InputError(e.expected, source=f"--{flag}", value=e.value) from e


@dataclass(frozen=True, kw_only=True)
class SearchFlags:
    """How far to look for contacts beyond the demonstrated ones."""

    tries: int = default_of("planning.records", "Budget", "tries")
    """Steps that are planned at most; 0: no search."""
    depth: int = default_of("planning.records", "Budget", "depth")
    """Contact changes of a sequence at most."""
    policy: Annotated[Path | None, shown("FILE", "the sequence's own")] = None
    """policy.json whose demonstrations say which contacts are tried first."""

    def read(self, planning: PlanningFlags) -> dict[str, Any]:
        """The arguments of the functions that search."""
        budget = planning.bound(tries=self.tries, depth=self.depth)
        return {"budget": budget, "counts": self._counts()}

    def _counts(self) -> Any:
        from clamber.planning.free import policy_counts

        if self.policy is None:
            return None
        return policy_counts(clamber.load_policy(self.policy))


@dataclass(frozen=True, kw_only=True)
class ExecutionFlags:
    """How to execute, and in which world."""

    controller: Literal["pid", "mixed"] = "mixed"
    """pid: open loop. mixed: compliant joints, contacts are measured, plans adapted."""
    disturb: Disturbance = field(default_factory=Disturbance)
    """What the planner does not know of the true world."""

    def simulate(
        self,
        plan: clamber.Plan,
        folder: Path,
        report: Progress,
        truth: Path | None,
        pause: float | None = None,
    ) -> tuple[clamber.Rollout, clamber.Verdict] | None:
        """Simulate, judge and save; None where there is nothing to simulate."""
        if plan.trajectory is None:
            return None
        rollout = clamber.simulate(
            plan,
            controller=self.controller,
            disturbance=self.disturb,
            true_scene=None if truth is None else clamber.load_scene(truth),
            pause=pause,
            progress=report,
        )
        report("save run", 0.0, "")
        clamber.save_rollout(plan, rollout, folder)
        report("save run", 0.8, "verdict")
        verdict = clamber.judge(plan, rollout)
        clamber.save_verdict(verdict, folder)
        report("save run", 1.0, "")
        return rollout, verdict


def scene_of(height: float | None, path: Path | None) -> clamber.Scene:
    """The scene of a file, or the one box of `--height`."""
    from clamber.study import climb

    if path is not None and height is not None:
        raise InputError("--height, --scene: give one of them alone")
    return climb.scene_of(DEFAULT_HEIGHT if height is None else height, path)
