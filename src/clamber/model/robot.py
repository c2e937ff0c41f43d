"""robot.yaml -> Robot: what planning needs beyond an MJCF or URDF.

Which geoms are surfaces, which chain is a limb, where it stands at the start.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import mujoco
import numpy as np
import pydantic

from clamber.errors import InputError, read_yaml, validated
from clamber.model.arguments import checks_types
from clamber.model.description import Description, compile_description, read_description
from clamber.model.records import short_repr
from clamber.model.wheels import MODELS, how_to_get

ROBOTS = Path(__file__).parent / "robots"
PROPOSED = Path("robots")  # below the current folder
ROBOT_FILE = "robot.yaml"
# [m] thigh and shank: of a robot with shorter legs (COMAN's are 0.427) the lengths that
# planning keeps, such as clearances and margins, are in proportion to them.
FULL_LEG = 0.42
LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg")


class _Strict(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")


class LimbFile(_Strict):
    """One of `limbs` of a robot file: landmarks are bodies, else geoms."""

    root: str
    middle: str
    end: str
    surfaces: list[str]


class GainsFile(_Strict):
    """Joint gains: [N m/rad], [N m s/rad], [N m/(rad s)]."""

    kp: float = pydantic.Field(default=600.0, gt=0)
    kd: float = pydantic.Field(default=20.0, ge=0)
    ki: float = pydantic.Field(default=9.0, ge=0)


class ImpedanceFile(_Strict):
    """Stiffness and damping of a compliant joint: [N m/rad], [N m s/rad]."""

    kp: float = pydantic.Field(gt=0)
    kd: float = pydantic.Field(ge=0)


class RobotFile(_Strict):
    """A robot as a person writes it (`robot.yaml`)."""

    version: int = 1
    name: str
    model: str
    base: str
    home: dict[str, float] = {}
    limbs: dict[Literal["left_arm", "right_arm", "left_leg", "right_leg"], LimbFile]
    surfaces: dict[str, str] = {}
    effort: dict[str, Annotated[float, pydantic.Field(gt=0)]] = {}
    gains: dict[str, GainsFile] = {"default": GainsFile()}
    impedance: dict[str, ImpedanceFile] = {}
    self_positioning: list[str] = []


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Limb:
    """A kinematic chain with its surfaces; `root` is the mass that contacts support."""

    name: str
    root: str
    middle: str
    end: str
    surfaces: tuple[str, ...]

    @property
    def is_arm(self) -> bool:
        """Arms carry the shoulders, legs the hips."""
        return self.name.endswith("arm")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Robot:
    """A humanoid as its files describe it.

    Attributes:
        name: The robot's name.
        path: The MJCF or URDF file.
        base: Name of the pelvis body.
        home: Joint angles of the posture it starts from [rad].
        limbs: By name, from `LIMBS`.
        prefixes: Prefix of the geom names of each surface.
        effort: Effort limits [N m] of joints, in place of the description's or where
            it has none.
        gains: (kp, kd, ki) by joint name, and `default`.
        impedance: (kp, kd) of the joints that mixed control makes compliant (4.31).
        self_positioning: Joints, usually the ankles, that comply with the ground while
            the arms bear load (4.32).
    """

    name: str
    path: Path
    base: str
    home: Mapping[str, float]
    limbs: Mapping[str, Limb]
    prefixes: Mapping[str, str]
    gains: Mapping[str, tuple[float, float, float]]
    effort: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    impedance: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: MappingProxyType({})
    )
    self_positioning: tuple[str, ...] = ()

    __repr__ = short_repr

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of all surfaces, limb by limb."""
        return tuple(s for limb in self.limbs.values() for s in limb.surfaces)

    def limb_of(self, surface: str) -> Limb:
        """The limb that a surface belongs to."""
        for limb in self.limbs.values():
            if surface in limb.surfaces:
                return limb
        raise KeyError(f"no surface {surface!r}; there are {list(self.surfaces)}")


RobotLike = Robot | str | Path  # a robot, or what `load_robot` makes one of


@checks_types
def load_robot(name_or_path: RobotLike) -> Robot:
    """Read a robot by name, or a `robot.yaml`.

    Args:
        name_or_path: A built-in one, such as `coman`; the name of one that `clamber
            robot init` wrote to `robots/` below the current folder; or the file. A
            `Robot` is returned as it is.

    Raises:
        InputError: No such robot, or a field of its file cannot be used.
    """
    if isinstance(name_or_path, Robot):
        return name_or_path
    path, given = Path(name_or_path), str(name_or_path)
    if not path.suffix:
        path = _named(given)
    elif path.suffix not in (".yaml", ".yml"):
        expected = "a robot.yaml beside the model, which names its limbs and surfaces"
        raise InputError(expected, "--robot", value=given)
    file = validated(RobotFile, read_yaml(path), path)
    missing = set(LIMBS) - set(file.limbs)
    if missing:
        raise InputError("all four limbs", path, "limbs", sorted(missing))
    model_path = path.parent / file.model
    if not model_path.is_file():
        raise InputError("an MJCF or URDF file", path, "model", file.model)
    robot = robot_of(file, path.parent)
    _check(robot, path)
    return robot


def _named(name: str) -> Path:
    """The file of a robot that is built in, or was proposed in the current folder.

    Raises:
        InputError: There is none; where a wheel has its model, what gets it.
    """
    for folder in (ROBOTS, PROPOSED):
        if name and (folder / name / ROBOT_FILE).is_file():
            return folder / name / ROBOT_FILE
    if name in MODELS:
        expected = f"a robot.yaml, which {how_to_get(name)} makes"
        raise InputError(expected, "--robot", value=name)
    known = [p.parent.name for p in sorted(ROBOTS.glob(f"*/{ROBOT_FILE}"))]
    near = difflib.get_close_matches(name, [*known, *MODELS], n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    expected = f"a robot.yaml, or one of {', '.join([*known, *MODELS])}{hint}"
    raise InputError(expected, "--robot", value=name)


def robot_of(file: RobotFile, folder: Path) -> Robot:
    """The robot of a file whose model is below a folder, or elsewhere by a whole path.

    Args:
        file: With all four limbs.
        folder: Of the model.
    """
    limbs = {
        n: Limb(
            name=n, root=f.root, middle=f.middle, end=f.end, surfaces=tuple(f.surfaces)
        )
        for n in LIMBS
        for f in (file.limbs[n],)
    }
    gains = {"default": GainsFile(), **file.gains}
    return Robot(
        name=file.name,
        path=folder / file.model,
        base=file.base,
        home=dict(file.home),
        limbs=limbs,
        prefixes={
            s: file.surfaces.get(s, s) for limb in limbs.values() for s in limb.surfaces
        },
        effort=dict(file.effort),
        gains={n: (g.kp, g.kd, g.ki) for n, g in gains.items()},
        impedance={n: (g.kp, g.kd) for n, g in file.impedance.items()},
        self_positioning=tuple(file.self_positioning),
    )


def _check(robot: Robot, source: Path) -> None:
    """Compile the robot alone and look up every name that its file mentions."""
    description = read_description(robot.path)
    model, file = compile_description(description, robot.path), robot.path.name
    bodies = {model.body(i).name for i in range(model.nbody)}
    geoms = {model.geom(i).name for i in range(model.ngeom)}
    joints = {model.joint(i).name for i in range(model.njnt)}
    if robot.base not in bodies:
        raise InputError(f"a body of {file}", source, "base", robot.base)
    named = {
        "home": robot.home,
        "effort": robot.effort,
        "gains": [n for n in robot.gains if n != "default"],
        "impedance": robot.impedance,
        "self_positioning": robot.self_positioning,
    }
    for where, names in named.items():
        if unknown := [n for n in names if n not in joints]:
            raise InputError(f"a joint of {file}", source, where, unknown[0])
    _check_joints(robot, model, description, source)
    for limb in robot.limbs.values():
        where = f"limbs.{limb.name}"
        for place in ("root", "middle", "end"):
            value = getattr(limb, place)
            if value not in bodies | geoms | set(robot.surfaces):
                expected = f"a body or geom of {file}"
                raise InputError(expected, source, f"{where}.{place}", value)
        for s in limb.surfaces:
            prefix = robot.prefixes[s]
            if not any(has_prefix(g, prefix) for g in geoms):
                expected = (
                    f"a surface: geoms of {file} whose names begin with {prefix!r}"
                )
                raise InputError(expected, source, f"{where}.surfaces", s)


def _check_joints(
    robot: Robot, model: mujoco.MjModel, description: Description, source: Path
) -> None:
    """Hinges with effort limits, each on its own, below one floating base."""
    kinds = mujoco.mjtJoint
    for j in range(model.njnt):
        name, kind = model.joint(j).name, kinds(int(model.jnt_type[j]))
        where = f"joint {name!r}"
        if kind == kinds.mjJNT_FREE:
            owner = model.body(int(model.jnt_bodyid[j])).name
            if owner != robot.base:
                expected = f"the body that floats, {owner}"
                raise InputError(expected, source, "base", robot.base)
            continue
        if kind != kinds.mjJNT_HINGE:
            expected = "hinges alone; lock other joints by leaving them out"
            what = kind.name.removeprefix("mjJNT_").lower()
            raise InputError(expected, robot.path, where, what)
        if name in description.mimics:
            other = description.mimics[name]
            expected = f"joints that move on their own (it follows {other!r}):"
            raise InputError(f"{expected} leave it out", robot.path, where)
        if name not in robot.effort and not np.any(model.jnt_actfrcrange[j]):
            raise InputError(
                "its largest torque [N m]: the description has none"
                " (actuatorfrcrange, or a URDF's effort)",
                source,
                f"effort.{name}",
            )


def length_scale(hip: np.ndarray, knee: np.ndarray, ankle: np.ndarray) -> float:
    """Factor on planning's lengths, at most 1, for a leg with joints there (3,) [m]."""
    leg = float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))
    return min(1.0, leg / FULL_LEG)


def has_prefix(geom: str, prefix: str) -> bool:
    """Whether a geom has a name, alone or with a suffix."""
    return geom == prefix or geom.startswith(prefix + "_")


def world_name(robot: Robot, geom: str) -> str:
    """The name that a geom of the description has in the world."""
    for surface, prefix in robot.prefixes.items():
        if prefix != surface and has_prefix(geom, prefix):
            return surface + geom.removeprefix(prefix)
    return geom
