"""File forms of records that are not written field by field: see docs/files.md."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clamber.contact.contact import ContactInterval, ContactSequence, Stance
from clamber.contact.policy import PelvisDistribution
from clamber.errors import validated
from clamber.execution.events import EVENTS, Event
from clamber.execution.verdict import Criterion
from clamber.model.robot import ROBOTS, Robot, RobotFile, robot_of
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy, rpy_from_matrix
from clamber.planning.records import State
from clamber.planning.trajectory import Trajectory
from clamber.run.codec import At, Codec, Form
from clamber.step.change import Failure
from clamber.step.ik import Residuals
from clamber.step.path import Phase
from clamber.step.posture import Keyframe
from clamber.step.stability import ContactState

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Timed:
    """A stance of a sequence, and from when to when it holds [s]."""

    t0: float
    t1: float
    stance: Stance


def _write_sequence(s: ContactSequence) -> dict[str, Any]:
    times = zip(s.stances, s.t, s.t[1:], strict=False)
    return {
        "source": s.source,
        "subject": s.subject,
        "scene": s.scene,
        "stances": [Timed(t0=a, t1=b, stance=x) for x, a, b in times],
        "intervals": s.intervals,
    }


def _read_sequence(at: At) -> ContactSequence:
    stances = at.key("stances")
    timed = CODEC.decode(tuple[Timed, ...], stances)
    if not timed:
        raise stances.error("at least one stance", [])
    for i, (a, b) in enumerate(itertools.pairwise(timed)):
        if a.t1 != b.t0:
            wrong = stances.list()[i + 1].key("t0")
            raise wrong.error(f"the end of the stance before, {a.t1}", b.t0)
    return ContactSequence(
        **CODEC.fields(ContactSequence, at, without=("stances", "t")),
        stances=tuple(x.stance for x in timed),
        t=np.array([*(x.t0 for x in timed), timed[-1].t1]),
    )


def _write_scene(scene: Scene) -> dict[str, Any]:
    """By the keys of `scene.yaml`."""
    return {
        "ground": {"friction": scene.ground_friction},
        "boxes": [
            {
                "name": b.name,
                "size": b.size,
                "position": b.centre - [0.0, 0.0, b.size[2] / 2],
                "rpy": _rpy(b.rotation),
                "friction": b.friction,
                "roughness": b.roughness,
            }
            for b in scene.boxes
        ],
        **({"meshes": scene.meshes} if scene.meshes else {}),
        "start": scene.start,
        "goal": scene.goal,
    }


def _read_scene(at: At) -> Scene:
    """As it was written: boxes of a recording may be called as no robot's can."""
    boxes = []
    for box in at.key("boxes").list():
        size, bottom = (CODEC.decode(Vector, box.key(n)) for n in ("size", "position"))
        boxes.append(
            Box(
                **CODEC.fields(Box, box, without=("size", "centre", "rotation")),
                size=np.array(size),
                centre=np.add(bottom, [0.0, 0.0, size[2] / 2]),
                rotation=matrix_from_rpy(CODEC.decode(Vector, box.key("rpy"))),
            )
        )
    friction = CODEC.decode(float, at.key("ground").key("friction"))
    rest = CODEC.fields(Scene, at, without=("boxes", "ground_friction"))
    return Scene(boxes=tuple(boxes), ground_friction=friction, **rest)


def _rpy(R: np.ndarray) -> np.ndarray:
    """Angles of a rotation [rad], rounded as people write them where that is exact."""
    rpy = rpy_from_matrix(R)
    rounded = rpy.round(9) + 0.0  # no negative zeros
    return rounded if np.array_equal(matrix_from_rpy(rounded), R) else rpy


def _write_robot(robot: Robot) -> dict[str, Any]:
    """By the keys of `robot.yaml`; a built-in one's model below `robots`."""
    built_in = robot.path.is_relative_to(ROBOTS)
    path = robot.path.relative_to(ROBOTS) if built_in else robot.path.absolute()
    names = ("root", "middle", "end", "surfaces")
    gains = ("kp", "kd", "ki")
    return {
        "version": 1,
        "name": robot.name,
        "model": path.as_posix(),
        "base": robot.base,
        "home": robot.home,
        "limbs": {n: {k: getattr(x, k) for k in names} for n, x in robot.limbs.items()},
        "surfaces": robot.prefixes,
        "effort": robot.effort,
        "gains": {n: dict(zip(gains, g, strict=True)) for n, g in robot.gains.items()},
        "impedance": {
            n: dict(zip(gains, g, strict=False)) for n, g in robot.impedance.items()
        },
        "self_positioning": robot.self_positioning,
    }


def _read_robot(at: At) -> Robot:
    return robot_of(validated(RobotFile, at.value, at.file), ROBOTS)


FORMS: dict[type, Form] = {
    Scene: Form(write=_write_scene, read=_read_scene),
    Robot: Form(write=_write_robot, read=_read_robot),
    ContactSequence: Form(write=_write_sequence, read=_read_sequence),
    Timed: Form(beside=("stance",)),
    Stance: Form(more=lambda s: {"region": s.region}),
    ContactInterval: Form(beside=("contact",)),
    ContactState: Form(beside=("contact",)),
    PelvisDistribution: Form(null={"sigma": math.inf}),
    State: Form(names={"q": "qpos"}),
    Failure: Form(
        more=lambda f: {"stance": f.step and f.step.stance, "reason": str(f)}
    ),
    Phase: Form(columns={"arc": 3}),
    Keyframe: Form(names={"q": "qpos"}, null={"com_margin": -math.inf}),
    Residuals: Form(null={"com_margin": -math.inf}),
    Trajectory: Form(names={"q": "qpos", "v": "qvel", "joints": "joint_names"}),
    Event: Form(kinds=tuple(EVENTS.values()), more=lambda e: {"text": str(e)}),
    Criterion: Form(null={"value": math.nan}),
}
CODEC = Codec(FORMS)
