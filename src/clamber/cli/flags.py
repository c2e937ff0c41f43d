"""Flags that several commands share."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import clamber
from clamber.cli.output import (
    Output,
    Report,
)
from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance

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


def shown(metavar: str, default: str | None = None) -> Any:
    """How a flag's value is called in help, and its default, where that is no value."""
    hint = None if default is None else f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


Place = Annotated[Path | None, shown("DIR")]


RunFolder = Annotated[Path, tyro.conf.Positional, shown("RUN")]


@dataclass(frozen=True, kw_only=True)
class RecordingFlags:
    """What a recording does not say of itself."""

    fit_floor: bool = False
    """Correct the heights of floor and boxes by whatever rests on them."""
    subject: str | None = None
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
    """A scene.yaml, or boxes as OBJ, MJCF, URDF or SDF."""

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
    """Largest joint speed; max: as fast as joints and contacts bear."""


@dataclass(frozen=True, kw_only=True)
class SearchFlags:
    """How far to look for contacts that nobody demonstrated."""

    tries: int = default_of("planning.records", "Budget", "tries")
    """Steps that are planned at most; 0: no search."""
    depth: int = default_of("planning.records", "Budget", "depth")
    """Contact changes of a sequence at most."""
    seconds: Annotated[
        float | None, tyro.conf.arg(help_behavior_hint="(default: no bound)")
    ] = None
    """Of all planning; with a bound, what is found depends on the machine."""
    policy: Annotated[
        Path | None,
        tyro.conf.arg(help_behavior_hint="(default: the sequence's own)"),
    ] = None
    """policy.json whose demonstrations say which contacts are tried first."""

    def read(self) -> dict[str, Any]:
        """The arguments of the functions that search."""
        return {"budget": self._budget(), "counts": self._counts()}

    def _budget(self) -> clamber.Budget:
        try:
            return clamber.Budget(
                tries=self.tries, depth=self.depth, seconds=self.seconds
            )
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
    """pid: open loop. mixed: compliant joints, contacts are measured, plans adapted."""
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
