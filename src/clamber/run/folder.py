"""Run folders: the files of a run, and what each means.

What was planned is in `plan.json`, `planned.xml` and `planned.npz`, and stays. What ran
is in `scene.xml`, `trajectory.npz`, `rollout.npz`, `execution.json` and `verdict.json`;
until something has run, the first two are as planned. Seconds that something took go to
`timings.json` alone: all else is the same from run to run. `docs/files.md` names what
is in the files, `codec` says how records are written.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from clamber.contact.contact import ContactSequence
from clamber.contact.policy import GeneralPolicy
from clamber.errors import InputError, unreadable
from clamber.execution.reference import in_steps
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Verdict
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.robot import Robot
from clamber.model.scene import Scene
from clamber.model.world import World, index_world
from clamber.planning.planner import Replanned
from clamber.planning.records import Fallback, Plan
from clamber.planning.samples import runs_as_arrays, runs_of_arrays, sampled
from clamber.planning.trajectory import Trajectory
from clamber.run.codec import (
    VERSION,
    At,
    read_json,
    read_npz,
    whole_file,
    write_json,
    write_npz,
)
from clamber.run.forms import CODEC
from clamber.step.change import Change
from clamber.step.posture import Keyframe
from clamber.step.robust import robust_margin
from clamber.step.stability import statics_at
from clamber.step.statics import static_equilibrium

SEQUENCE = "sequence.json"
POLICY = "policy.json"
PLAN = "plan.json"
PLANNED_SCENE = "planned.xml"
PLANNED_TRAJECTORY = "planned.npz"
TRAJECTORY = "trajectory.npz"
SCENE = "scene.xml"
ASSETS = "assets"
TIMINGS = "timings.json"
ROLLOUT = "rollout.npz"
VERDICT = "verdict.json"
EXECUTION = "execution.json"
REPLANNED = "replan.json"
RUN_MAKERS = "`clamber climb` or `clamber plan` makes one"
_OF_A_RUN = (TRAJECTORY, SCENE, ROLLOUT, EXECUTION, VERDICT)
_OF_A_PLAN = (PLAN, PLANNED_SCENE, PLANNED_TRAJECTORY, TIMINGS, REPLANNED)
_MAKERS = {SEQUENCE: "contacts", POLICY: "learn"} | dict.fromkeys(_OF_A_PLAN, "plan")
_MAKERS |= dict.fromkeys(_OF_A_RUN, "simulate")
VERSIONS_OF = ("clamber", "mujoco", "numpy", "scipy", "daqp")
_NOT_IN_PLAN = ("world", "trajectory", "timings", "start", "changes")
_OF_RUNS = ("q", "v", "tau")  # what is sampled of a planned trajectory
_IN_EXECUTION = ("events", "fell", "rests_on")
_NOT_IN_ROLLOUT = ("world", "followed", "plan", *_IN_EXECUTION)
_NOT_IN_EXECUTION = tuple(
    f.name for f in fields(Rollout) if f.name not in _IN_EXECUTION
)


# Folders.


@checks_types
def new_run_folder(out: str | Path | None, command: str) -> Path:
    """Make the folder of a run.

    Args:
        out: The folder asked for, which may exist; None for `runs/<command>` below the
            current folder, or the first of `-2`, `-3` ... that is free.
        command: Such as `climb`.

    Raises:
        InputError: It cannot be made, or nothing can be written into it.
    """
    try:
        folder = Path(out) if out else next_free_folder(Path("runs"), command)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".writable").touch()
        (folder / ".writable").unlink()
    except OSError as e:
        asked = str(out or Path("runs") / command)
        text = f"a folder that can be written ({e.strerror or e})"
        raise InputError(text, "--out", value=asked) from e
    return folder


def next_free_folder(parent: Path, command: str) -> Path:
    """Make `command` in a folder, or the first of `-2`, `-3` ... that is free."""
    parent.mkdir(parents=True, exist_ok=True)
    n = 1
    while True:
        folder = parent / (command if n == 1 else f"{command}-{n}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()  # of two runs that begin at once, one makes it
            return folder
        n += 1


def _file_of(path: str | Path, name: str) -> Path:
    """The file itself, or that of its name in a folder."""
    path = Path(path)
    return path / name if path.is_dir() else path


def _maker(path: Path) -> str:
    """The command that writes a missing, broken or outdated file."""
    command = _MAKERS.get(path.name)
    return f"`clamber {command}` writes it" if command else "check the path"


def _read(path: Path, *, versions: Collection[int] = (VERSION,)) -> At:
    return read_json(path, maker=_maker(path), versions=versions)


# Sequences and policies, alone.


@checks_types
def save_sequence(sequence: ContactSequence, path: str | Path) -> None:
    """Write `sequence.json`.

    Args:
        sequence: At the person's scale, as detected.
        path: The file.
    """
    write_json(Path(path), CODEC.encode(sequence))


@checks_types
def load_sequence(path: str | Path) -> ContactSequence:
    """Read a `sequence.json`, or that of a run folder.

    Args:
        path: The file or the folder.

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    at = _read(_file_of(path, SEQUENCE), versions=(1, VERSION))
    return CODEC.decode(ContactSequence, at)


def policy_summary(policy: GeneralPolicy) -> dict[str, Any]:
    """A general policy in plain numbers and words, without its demo policies."""
    summary = CODEC.object(policy, without=("demos", "secondary"))
    return summary | {
        "sources": list(policy.sources),
        "secondary": [policy_summary(s) for s in policy.secondary],
    }


@checks_types
def save_policy(policy: GeneralPolicy, path: str | Path) -> None:
    """Write `policy.json`: the general policy and the demo policies behind it.

    Args:
        policy: The policy.
        path: The file.
    """
    write_json(Path(path), CODEC.encode(policy))


@checks_types
def load_policy(path: str | Path) -> GeneralPolicy:
    """Read a `policy.json`, or that of a folder.

    Args:
        path: The file or the folder.

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    at = _read(_file_of(path, POLICY), versions=(1, VERSION))
    return CODEC.decode(GeneralPolicy, at)


# Plans.


@checks_types
def save_plan(plan: Plan, folder: str | Path) -> None:
    """Write a plan, and the scene and the trajectory that are to run.

    Results that the folder holds of an earlier plan are removed. `plan.json` comes
    last: where it is, the others are.

    Args:
        plan: Complete or not.
        folder: Made where there is none.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*_OF_A_PLAN, *_OF_A_RUN):
        (folder / name).unlink(missing_ok=True)
    for name in (PLANNED_SCENE, SCENE):
        _save_world(plan.world, folder / name)
    with ThreadPoolExecutor(1) as pool:  # packing takes no interpreter
        packed = pool.submit(_save_motion, plan.trajectory, folder)
        save_timings(folder, plan.timings)
        written = _plan_fields(plan, folder)
        packed.result()
    write_json(folder / PLAN, written)


def _save_motion(trajectory: Trajectory | None, folder: Path) -> None:
    """Writes the planned trajectory, and the one to be executed."""
    if trajectory is not None:
        save_trajectory(trajectory, folder / PLANNED_TRAJECTORY)
        save_trajectory(in_steps(trajectory), folder / TRAJECTORY)


def _plan_fields(plan: Plan, folder: Path) -> dict[str, Any]:
    kin, robot = Kinematics(plan.world), plan.world.robot
    fields = CODEC.encode(robot)
    inputs = {"robot": json.dumps(fields).encode()}
    for name, path in ("robot_model", robot.path), ("sequence", folder / SEQUENCE):
        if path.is_file():
            inputs[name] = path.read_bytes()
    return {
        "versions": {n: importlib.metadata.version(n) for n in VERSIONS_OF},
        "inputs": {n: hashlib.sha256(x).hexdigest() for n, x in inputs.items()},
        "robot": fields,
        "prefixes": dict(robot.prefixes),
        **CODEC.object(plan, without=_NOT_IN_PLAN),
        "keyframes": [_keyframe_fields(k, kin) for k in plan.keyframes],
        "changes": [CODEC.object(c, without=("keyframe",)) for c in plan.changes],
    }


def _keyframe_fields(k: Keyframe, kin: Kinematics) -> dict[str, Any]:
    """A keyframe by the keys of `plan.json`; its margins, and which forces hold it."""
    points, load, torque = statics_at(kin, k.q, k.stance)
    acting = {"surfaces": points.names, "points": points.points}
    out = CODEC.encode(k)
    out["robust_margin"] = robust_margin(kin, k.q, k.stance)
    held = static_equilibrium(points, load, torque=torque)
    out["static_equilibrium"] = CODEC.encode(held) | CODEC.encode(acting)
    return out


@checks_types
def load_plan(folder: str | Path, *, without: Collection[str] = ()) -> Plan:
    """Read what `save_plan` wrote: the same plan.

    Args:
        folder: The run folder.
        without: Files not to read, `planned.npz` or `timings.json`; they may then be
            broken.

    Raises:
        InputError: A file is missing, broken, or does not fit the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"a run folder; {RUN_MAKERS}", folder)
    at = _read(folder / PLAN)
    known = _plan_of(at)
    robot = CODEC.decode(Robot, at.key("robot"))
    world = _load_world(folder / PLANNED_SCENE, robot, known["sequence"].scene)
    trajectory, path = None, folder / PLANNED_TRAJECTORY
    if PLANNED_TRAJECTORY not in without and (path.exists() or known["complete"]):
        trajectory = load_trajectory(path, world)
    timings: dict[str, float] = {}
    if TIMINGS not in without and (folder / TIMINGS).exists():
        timings = _load_timings(folder)
    plan = Plan(world=world, trajectory=trajectory, timings=timings, **known)
    for field, q in _postures(plan):
        if q.shape[-1] != world.model.nq:
            expected = f"{world.model.nq} numbers, the coordinates of {PLANNED_SCENE}"
            raise InputError(expected, at.file, field, f"{q.shape[-1]} numbers")
    for i, k in enumerate(plan.keyframes):
        for c in k.stance:
            if c.surface not in world.surfaces or c.support not in world.supports:
                field, value = f"keyframes.{i}.contacts", f"{c.surface} on {c.support}"
                expected = f"a surface of the robot on a support of {PLANNED_SCENE}"
                raise InputError(expected, at.file, field, value)
    return plan


def _postures(plan: Plan) -> Iterator[tuple[str, np.ndarray]]:
    """Every posture of a plan, (..., nq), and the name of its field."""
    for i, k in enumerate(plan.keyframes):
        yield f"keyframes.{i}.qpos", k.q
    for i, c in enumerate(plan.changes):
        for j, phase in enumerate(c.phases):
            yield f"changes.{i}.phases.{j}.q", phase.q
    if plan.state is not None:
        yield "state.qpos", plan.state.q


def _plan_of(at: At) -> dict[str, Any]:
    """The fields of a plan that `plan.json` holds."""
    keyframes = CODEC.decode(tuple[Keyframe, ...], at.key("keyframes"))
    changes = at.key("changes").list()
    if len(keyframes) != len(changes) + 1:
        expected = f"{len(changes) + 1}, one more than there are changes"
        raise at.key("keyframes").error(expected, f"{len(keyframes)} keyframes")
    return CODEC.fields(Plan, at, without=_NOT_IN_PLAN) | {
        "start": keyframes[0],
        "changes": tuple(
            Change(**CODEC.fields(Change, of, without=("keyframe",)), keyframe=k)
            for of, k in zip(changes, keyframes[1:], strict=True)
        ),
    }


def fallback_note(written: Mapping[str, Any]) -> str:
    """A sentence on the fallback of a `plan.json`; empty without one."""
    fields = written.get("fallback")
    if fields is None:
        return ""
    return str(CODEC.decode(Fallback, At(fields, Path(PLAN), "fallback")))


def trajectory_of(plan: Plan, source: Path) -> Trajectory:
    """The trajectory of a plan that is to be played.

    Raises:
        InputError: It got no motion; `source` is the folder that it came from.
    """
    if plan.trajectory is None:
        text = (
            "a plan that got as far as a trajectory; the last line of `clamber plan`"
            " says why this one did not"
        )
        raise InputError(text, source)
    return plan.trajectory


def save_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory: all samples, or where it is planned what gives them."""
    runs = runs_as_arrays(*(getattr(trajectory, n) for n in _OF_RUNS))
    without = () if runs is None else _OF_RUNS
    write_npz(Path(path), CODEC.arrays(trajectory, without) | (runs or {}))


def load_trajectory(path: str | Path, world: World) -> Trajectory:
    """Read a trajectory of that world.

    Raises:
        InputError: It is missing, broken or another robot's.
    """
    m, na, ns = world.model, len(world.joints), len(world.surfaces)
    path = Path(path)
    shapes = {
        **{"time": ("T",), "qpos": ("T", m.nq), "qvel": ("T", m.nv)},
        **{"tau": ("T", na), "contact": ("T", ns), "keyframes": ("K",)},
        **{"joint_names": (na,), "surfaces": (ns,)},
    }
    arrays = read_npz(path, maker=_maker(path))
    runs = _sampled(arrays, shapes, path) if "run_sizes" in arrays else {}
    known = CODEC.from_arrays(Trajectory, arrays, path, shapes, without=runs)
    read = Trajectory(**known, **runs)
    _check_names(At(read.joints, path, "joint_names"), world.joints)
    _check_names(At(read.surfaces, path, "surfaces"), world.surfaces)
    return read


def _sampled(
    arrays: Mapping[str, np.ndarray], shapes: Mapping[str, Any], path: Path
) -> dict[str, Any]:
    """Samples of a trajectory that was written by its generating segments.

    Raises:
        InputError: They are not those of this robot or do not fit together.
    """
    try:
        out = sampled(runs_of_arrays(arrays))
    except (ValueError, KeyError, IndexError, TypeError) as e:
        text = f"whole runs of a planned trajectory ({e}); {_maker(path)}"
        raise InputError(text, path, "run_sizes") from e
    rows = len(arrays.get("time", ()))
    for name, key in ("q", "qpos"), ("v", "qvel"), ("tau", "tau"):
        wanted = rows, shapes[key][1]
        if out[name].shape != wanted:
            raise InputError(f"the shape {wanted}", path, key, out[name].shape)
    return out


def _check_names(found: At, wanted: Iterable[str]) -> None:
    """Refuse names that are not those of the scene."""
    if found.value != tuple(wanted):
        expected = f"those of the scene, {', '.join(wanted)}"
        raise found.error(expected, ", ".join(map(str, found.value)))


def save_timings(folder: str | Path, seconds: Mapping[str, float]) -> None:
    """Add to the seconds by stage in `timings.json`."""
    path = Path(folder) / TIMINGS
    known = _load_timings(Path(folder)) if path.exists() else {}
    write_json(path, {"seconds": {**known, **seconds}})


def _load_timings(folder: Path) -> dict[str, float]:
    return CODEC.decode(dict[str, float], _read(folder / TIMINGS).key("seconds"))


# Worlds and robots.


def _load_world(path: Path, robot: Robot, scene: Scene) -> World:
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
        text = _with_folder(path.read_text(), path.parent.resolve())
        world = index_world(model, text, robot, scene)
        for limb in robot.limbs.values():
            for name in (limb.root, limb.middle, limb.end):
                world.landmark(name)
        return world
    except OSError as e:
        raise unreadable(path, e, _maker(path)) from e
    except (ValueError, KeyError, IndexError) as e:
        reason = " ".join(str(e.args[0] if e.args else e).split())
        text = f"the robot and the boxes of {PLAN} as MJCF ({reason}); {_maker(path)}"
        raise InputError(text, path) from e


def _save_world(world: World, path: Path) -> None:
    """Write the world's MJCF; files that it names are copied beside it."""
    text = world.xml
    if "file=" in text:
        root = ElementTree.fromstring(text)
        for content, name in _with_assets(root, world.robot.path.parent).items():
            (path.parent / ASSETS).mkdir(exist_ok=True)
            with whole_file(path.parent / ASSETS / name) as draft:
                draft.write_bytes(content)
        text = ElementTree.tostring(root, encoding="unicode") + "\n"
    with whole_file(path) as draft:
        draft.write_text(text)


def _with_folder(text: str, folder: Path) -> str:
    """An MJCF whose files are named from the root: worlds seek theirs by the robot."""
    if "file=" not in text:
        return text
    root = ElementTree.fromstring(text)
    for element in root.iter():
        for key, name in element.attrib.items():
            if key.startswith("file"):
                element.set(key, str(folder / name))
    return ElementTree.tostring(root, encoding="unicode")


def _with_assets(root: ElementTree.Element, base: Path) -> dict[bytes, str]:
    """Name files in `ASSETS` in place of those below `base`: their contents by name."""
    dirs: dict[str, str] = {}
    for compiler in root.iter("compiler"):
        for key in ("assetdir", "meshdir", "texturedir"):
            if key in compiler.attrib:
                dirs[key] = compiler.attrib.pop(key)
    names: dict[bytes, str] = {}
    for element in root.iter():
        for key, name in list(element.attrib.items()):
            if not key.startswith("file") or element.tag == "compiler":
                continue
            kind = "texturedir" if element.tag == "texture" else "meshdir"
            source = base / dirs.get(kind, dirs.get("assetdir", "")) / name
            content = source.read_bytes()
            if content not in names:
                stem, suffix, n = source.stem, source.suffix, 2
                unique = stem + suffix
                while unique in names.values():
                    unique, n = f"{stem}-{n}{suffix}", n + 1
                names[content] = unique
            element.set(key, f"{ASSETS}/{names[content]}")
    return names


def save_replanned(found: Replanned, folder: str | Path) -> None:
    """Write `replan.json`: the plans, the best first, and what was tried for them."""
    plans = [
        {
            "surfaces": r.surfaces,
            "source": r.source,
            "cost": r.cost,
            "stable": r.stable,
            "moves": [str(c.step) for c in r.plan.changes],
            "missed": [str(f) for f in r.plan.failures],
        }
        for r in found.ranked
    ]
    tried = {"differences": found.differences, "plans": plans, "tried": found.tried}
    write_json(Path(folder) / REPLANNED, CODEC.encode(tried))


# Rollouts and verdicts.


@checks_types
def save_rollout(plan: Plan, rollout: Rollout, folder: str | Path) -> None:
    """Write a rollout, with the world that physics ran and the adapted reference.

    Args:
        plan: The plan that was executed, as `save_plan` wrote it there.
        rollout: Its simulation.
        folder: The run folder.
    """
    folder = Path(folder)
    _save_world(rollout.world, folder / SCENE)
    followed = rollout.followed or in_steps(trajectory_of(plan, folder))
    with ThreadPoolExecutor(1) as pool:
        packed = pool.submit(save_trajectory, followed, folder / TRAJECTORY)
        write_npz(folder / ROLLOUT, CODEC.arrays(rollout, without=_NOT_IN_ROLLOUT))
        packed.result()
    write_json(
        folder / EXECUTION,
        {
            "scene": CODEC.encode(rollout.world.scene),
            **CODEC.object(rollout, without=_NOT_IN_EXECUTION),
            "fell": rollout.fell,
            "stopped": rollout.stopped,
            "as_planned": rollout.followed is None,
        },
    )


@checks_types
def load_rollout(folder: str | Path, *, with_events: bool = True) -> Rollout:
    """Read what `save_rollout` wrote.

    Args:
        folder: The run folder.
        with_events: Read `execution.json` too. Without it, which may then be broken,
            there are no events and no fall, and the scene is the planned one.

    Raises:
        InputError: A file is missing or broken.
    """
    folder = Path(folder)
    path = folder / ROLLOUT
    arrays = read_npz(path, maker=_maker(path))
    plan = _read(folder / PLAN)
    scene, written = plan.key("sequence").key("scene"), {}
    as_planned = False
    if with_events:
        execution = _read(folder / EXECUTION)
        scene, written = execution.key("scene"), _execution_of(execution)
        as_planned = execution.object().get("as_planned") is True
    robot = CODEC.decode(Robot, plan.key("robot"))
    world = _load_world(folder / SCENE, robot, CODEC.decode(Scene, scene))
    m, surfaces = world.model, tuple(world.surfaces)
    shapes = {
        **{"ctrl": ("N", m.nu), "push": ("N", 3), "surfaces": (len(surfaces),)},
        **{"time": ("M",), "qpos": ("M", m.nq), "qvel": ("M", m.nv)},
        **{"actuator_force": ("M", m.nu), "contact_force": ("M", len(surfaces), 3)},
        **{"unintended": ("M",), "penetration": ("M",), "end_speed": ("n",)},
        **{"contact_step": ("K",), "contact_geoms": ("K", 2), "contact_load": ("K", 2)},
    }
    read = CODEC.from_arrays(Rollout, arrays, path, shapes, without=_NOT_IN_ROLLOUT)
    _check_names(At(read["surfaces"], path, "surfaces"), surfaces)
    ran = load_trajectory(folder / TRAJECTORY, world)
    followed = None if as_planned else ran
    return Rollout(**read, **written, world=world, followed=followed)


def _execution_of(at: At) -> dict[str, Any]:
    """The fields of a rollout that `execution.json` holds."""
    return CODEC.fields(Rollout, at, without=_NOT_IN_EXECUTION)


@checks_types
def save_verdict(verdict: Verdict, folder: str | Path) -> None:
    """Write `verdict.json`.

    Args:
        verdict: The verdict on the folder's rollout.
        folder: The run folder.
    """
    write_json(Path(folder) / VERDICT, CODEC.encode(verdict))


def load_verdict(folder: str | Path) -> Verdict:
    """Read the `verdict.json` of a run folder.

    Raises:
        InputError: It is missing or broken.
    """
    return CODEC.decode(Verdict, _read(Path(folder) / VERDICT))


def load_fields(folder: str | Path, name: str) -> dict[str, Any]:
    """Fields of a JSON file of a run folder, checked.

    For what is shown of a run whose other files are missing or broken.

    Args:
        folder: The run folder.
        name: `plan.json`, `execution.json` or `timings.json`.

    Raises:
        InputError: It is missing or broken.
    """
    folder = Path(folder)
    if name == TIMINGS:
        return {"seconds": _load_timings(folder)}
    at = _read(folder / name)
    if name == PLAN:
        _plan_of(at)
    else:
        _execution_of(at)
        CODEC.decode(Scene, at.key("scene"))
    return at.value
