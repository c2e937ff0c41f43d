"""Run folders: every record of a job on disk, and back.

A file is written beside its place and renamed, so that an interrupted run leaves whole
files only. The same records give the same bytes: JSON keeps the order in which it is
written and floats in their shortest exact form, and numpy dates what lies in an `.npz`
1980. Seconds that something took go to `timings.json` alone.

Shapes: T samples, nS surfaces, nc bearing points, N steps, M recorded states.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import IO, Annotated, Any, Literal, TypeVar, get_args, get_type_hints
from xml.etree import ElementTree

import mujoco
import numpy as np
import pydantic

from clamber.contact.contact import (
    Contact,
    ContactInterval,
    ContactSequence,
    Region,
    Stance,
)
from clamber.contact.policy import (
    DemoPolicy,
    GeneralPolicy,
    Option,
    PelvisDistribution,
    Place,
)
from clamber.contact.steps import Seeds, Skipped, Step
from clamber.errors import InputError, Status, input_error, read_yaml, unreadable
from clamber.execution.events import EVENTS, Event, event_fields
from clamber.execution.simulation import Rollout
from clamber.execution.verdict import Criterion, Figure, Verdict
from clamber.model.kinematics import Kinematics
from clamber.model.propose import Proposal, robot_yaml
from clamber.model.robot import LIMBS, ROBOTS, Limb, Robot, RobotFile
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy
from clamber.model.shapes import MESH_FOLDER
from clamber.model.world import World, index_world
from clamber.planning.records import Fallback, Iteration, Plan, PlanOptions, State
from clamber.planning.substitutes import Replanned
from clamber.planning.trajectory import Samples, Segment, Trajectory
from clamber.step.change import Change, Failure
from clamber.step.ik import Residuals
from clamber.step.path import contact_phases
from clamber.step.posture import Keyframe
from clamber.step.stability import ContactState, contact_points
from clamber.step.statics import Phase, StaticEquilibrium

VERSION = 1
SEQUENCE = "sequence.json"
POLICY = "policy.json"
PLAN = "plan.json"
TRAJECTORY = "trajectory.npz"
SCENE = "scene.xml"
ROBOT = "robot.yaml"
ASSETS = "assets"
TIMINGS = "timings.json"
ROLLOUT = "rollout.npz"
VERDICT = "verdict.json"
EXECUTION = "execution.json"
REPLANNED = "replan.json"
PLANNED_SCENE = "planned.xml"  # where physics ran another world than was planned for
PLANNED_TRAJECTORY = "planned.npz"  # where another one was followed in the end
RUN_MAKERS = "`clamber climb` or `clamber plan` makes one"
_MAKERS = {
    SEQUENCE: "contacts",
    POLICY: "learn",
    PLAN: "plan",
    TRAJECTORY: "plan",
    SCENE: "plan",
    TIMINGS: "plan",
    ROLLOUT: "simulate",
    EXECUTION: "simulate",
    VERDICT: "simulate",
    PLANNED_SCENE: "simulate",
    PLANNED_TRAJECTORY: "simulate",
}
VERSIONS_OF = ("clamber", "mujoco", "numpy", "scipy", "daqp")
_OF_AN_EARLIER_PLAN = (
    TRAJECTORY,
    ROLLOUT,
    VERDICT,
    TIMINGS,
    EXECUTION,
    PLANNED_SCENE,
    PLANNED_TRAJECTORY,
    REPLANNED,
)
_NOT_IN_ROLLOUT = {"world", "followed", "events", "fell", "rests_on"}
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,
    TypeError,  # a single array, which is no context
)
_Model = TypeVar("_Model", bound=pydantic.BaseModel)
_Record = TypeVar("_Record")

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pose = tuple[float, float, float, float, float, float, float]


# Folders and whole files.


def new_run_folder(out: Path | None, command: str) -> Path:
    """Make the folder of a run.

    Args:
        out: The folder asked for, which may exist; None for `runs/<command>` below the
            current folder, or the first of `-2`, `-3` ... that is free.
        command: Such as `climb`.

    Raises:
        InputError: It cannot be made, or nothing can be written into it.
    """
    try:
        if out is not None:
            folder = Path(out)
            folder.mkdir(parents=True, exist_ok=True)
        else:
            folder = next_free_folder(Path("runs"), command)
        with _whole(folder / ".writable"):
            pass
        (folder / ".writable").unlink()
    except OSError as e:
        raise InputError(
            f"a folder that can be written ({e.strerror or e})",
            source="--out",
            value=str(out if out is not None else Path("runs") / command),
        ) from e
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


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name beside `path`, same ending, that becomes `path` if the block completes."""
    draft = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield draft
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[IO[bytes]]:
    with whole_file(path) as draft, draft.open("wb") as stream:
        yield stream


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, `version` first; numbers that are not finite become null."""
    text = json.dumps(
        _plain({"version": VERSION, **content}), indent=1, allow_nan=False
    )
    with _whole(path) as stream:
        stream.write(_rows_on_one_line(text).encode() + b"\n")


def _rows_on_one_line(text: str) -> str:
    """Indented JSON with each list of numbers on a line of its own."""
    out: list[str] = []
    lines = iter(text.splitlines())
    for line in lines:
        if not line.endswith("["):
            out.append(line)
            continue
        items = []
        for item in lines:
            word = item.strip()
            if word[:1] not in set("-0123456789n]"):  # something nested: as it is
                out += [line, *items, item]
                break
            items.append(item)
            if word.startswith("]"):
                out.append(line + " ".join(x.strip() for x in items[:-1]) + word)
                break
    return "\n".join(out)


def _plain(x: Any) -> Any:
    """Numbers, strings, lists and dictionaries of the same content."""
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, np.ndarray):
        return _plain(x.tolist())
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    if isinstance(x, np.generic):
        return _plain(x.item())
    if isinstance(x, float) and not math.isfinite(x):
        return None
    return x


def _read_json(path: Path, kind: type[_Model]) -> _Model:
    """Read and check a JSON file.

    Raises:
        InputError: Missing, not JSON, another version, or a field that does not fit.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as e:
        raise unreadable(path, e, _maker(path)) from e
    except ValueError as e:
        raise InputError(f"a whole JSON file ({e}); {_maker(path)}", source=path) from e
    if not isinstance(content, dict):
        raise InputError(
            "an object of fields", source=path, value=type(content).__name__
        )
    if content.get("version") != VERSION:
        raise InputError(
            f"version {VERSION} of the format",
            source=path,
            field="version",
            value=content.get("version", "absent"),
        )
    try:
        return kind.model_validate(content)
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e


def _maker(path: Path) -> str:
    """What to do where a file is missing or broken: the command that writes it."""
    command = _MAKERS.get(path.name)
    return f"`clamber {command}` writes it" if command else "check the path"


def _write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """As `np.savez_compressed` does; what is sampled, block after block."""
    kind = zipfile.ZIP_DEFLATED
    with _whole(path) as stream, zipfile.ZipFile(stream, "w", kind) as archive:
        for name, x in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                if not isinstance(x, Samples):
                    np.lib.format.write_array(file, np.asarray(x), allow_pickle=False)
                    continue
                about = {"descr": "<f8", "fortran_order": False, "shape": x.shape}
                np.lib.format.write_array_header_1_0(file, about)
                for block in x.blocks():
                    file.write(block.astype("<f8").tobytes())


class _Arrays:
    """The arrays of an `.npz`; what is missing or of another shape is the user's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as f:
                self._arrays = {k: f[k] for k in f.files}
        except _UNREADABLE as e:
            reason = e.strerror if isinstance(e, OSError) and e.strerror else e
            if "pickle" in str(e):  # what numpy takes any other content for
                reason = "it holds something else"
            raise InputError(
                f"a whole .npz file ({reason}); {_maker(path)}", source=path
            ) from e

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def get(self, name: str, *shape: int | None) -> np.ndarray:
        """The array; None in a shape fits any length."""
        if name not in self._arrays:
            raise InputError("an array: there is none", source=self.path, field=name)
        x = self._arrays[name]
        fits = len(x.shape) == len(shape) and all(
            n in (None, m) for n, m in zip(shape, x.shape, strict=True)
        )
        if not fits:
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            raise InputError(
                f"({wanted})", source=self.path, field=f"shape of {name}", value=x.shape
            )
        if x.dtype.kind == "f" and not np.all(np.isfinite(x)):
            raise InputError("finite numbers only", source=self.path, field=name)
        return x


# Scenes, contacts and sequences.


class _BoxFile(pydantic.BaseModel):
    name: str
    size: Vector
    position: Vector
    rpy: Vector
    friction: float
    roughness: float = 0.0


class _GroundFile(pydantic.BaseModel):
    friction: float


class _SceneFile(pydantic.BaseModel):
    ground: _GroundFile
    boxes: list[_BoxFile]
    start: Vector
    goal: list[float] | None

    def scene(self) -> Scene:
        boxes = [
            Box(
                name=b.name,
                size=np.array(b.size),
                position=np.array(b.position) + np.array([0.0, 0.0, b.size[2] / 2]),
                rotation=matrix_from_rpy(b.rpy),
                friction=b.friction,
                roughness=b.roughness,
            )
            for b in self.boxes
        ]
        return Scene(
            boxes=tuple(boxes),
            ground_friction=self.ground.friction,
            start=np.array(self.start),
            goal=None if self.goal is None else np.array(self.goal),
        )


def scene_fields(scene: Scene) -> dict[str, Any]:
    """A scene by the keys of `scene.yaml`."""
    return {
        "ground": {"friction": scene.ground_friction},
        "boxes": [
            {
                "name": b.name,
                "size": b.size,
                "position": b.position - [0.0, 0.0, b.size[2] / 2],
                "rpy": _rpy(b.rotation),
                "friction": b.friction,
                "roughness": b.roughness,
            }
            for b in scene.boxes
        ],
        "start": scene.start,
        "goal": scene.goal,
    }


def _rpy(R: np.ndarray) -> list[float]:
    """Fixed-axis angles of R = Rz(yaw) Ry(pitch) Rx(roll) [rad]."""
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:  # yaw and roll turn about the same axis
        return [math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0]
    angles = [math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])]
    return [a + 0.0 for a in angles]  # no negative zeros


class _ContactFile(pydantic.BaseModel):
    surface: str
    support: str
    position: Vector
    quaternion: Quaternion
    edge: int | None = None
    link: Quaternion | None = None
    fixed: bool = False

    def contact(self) -> Contact:
        return Contact(
            surface=self.surface,
            support=self.support,
            position=np.array(self.position),
            quaternion=np.array(self.quaternion),
            edge=self.edge,
            link=None if self.link is None else np.array(self.link),
            fixed=self.fixed,
        )


def contact_fields(c: Contact) -> dict[str, Any]:
    """A contact by the keys of `sequence.json`; `edge`, `link`, `fixed` where it is."""
    out: dict[str, Any] = {
        "surface": c.surface,
        "support": c.support,
        "position": c.position,
        "quaternion": c.quaternion,
    }
    return out | {
        k: v
        for k, v in (("edge", c.edge), ("link", c.link), ("fixed", c.fixed or None))
        if v is not None
    }


class _StateOfFile(pydantic.BaseModel):
    contacts: list[_ContactFile]
    posture: dict[str, Vector] = {}
    pelvis: Pose | None = None

    def stance(self) -> Stance:
        return Stance(
            contacts=tuple(c.contact() for c in self.contacts),
            posture={n: np.array(v) for n, v in self.posture.items()},
            pelvis=None if self.pelvis is None else np.array(self.pelvis),
        )


class _StanceFile(_StateOfFile):
    t0: float
    t1: float


class _IntervalFile(_ContactFile):
    part: str
    is_surface: bool
    t0: float
    t1: float


class _SequenceFile(pydantic.BaseModel):
    source: str
    subject: dict[str, float] | None
    scene: _SceneFile
    stances: list[_StanceFile] = pydantic.Field(min_length=1)
    intervals: list[_IntervalFile] = []

    def sequence(self, path: Path) -> ContactSequence:
        for i, (a, b) in enumerate(zip(self.stances, self.stances[1:], strict=False)):
            if a.t1 != b.t0:
                raise InputError(
                    f"the end of the stance before, {a.t1}",
                    source=path,
                    field=f"stances.{i + 1}.t0",
                    value=b.t0,
                )
        try:
            return ContactSequence(
                source=self.source,
                subject=self.subject,
                scene=self.scene.scene(),
                stances=tuple(s.stance() for s in self.stances),
                t=np.array([s.t0 for s in self.stances] + [self.stances[-1].t1]),
                intervals=tuple(
                    ContactInterval(
                        part=x.part,
                        is_surface=x.is_surface,
                        t0=x.t0,
                        t1=x.t1,
                        contact=x.contact(),
                    )
                    for x in self.intervals
                ),
            )
        except (ValueError, KeyError) as e:
            raise InputError(
                f"stances that fit together ({e.args[0]})", source=path
            ) from e


def _stance_fields(stance: Stance) -> dict[str, Any]:
    """Contacts and posture of a stance; its pelvis where it has one."""
    out: dict[str, Any] = {
        "contacts": [contact_fields(c) for c in stance.contacts],
        "posture": stance.posture,
    }
    return out if stance.pelvis is None else out | {"pelvis": stance.pelvis}


def sequence_fields(sequence: ContactSequence) -> dict[str, Any]:
    """A contact sequence by the keys of `sequence.json`."""
    return {
        "source": sequence.source,
        "subject": sequence.subject,
        "scene": scene_fields(sequence.scene),
        "stances": [
            {"region": s.region, "t0": sequence.t[i], "t1": sequence.t[i + 1]}
            | _stance_fields(s)
            for i, s in enumerate(sequence.stances)
        ],
        "intervals": [
            {
                "part": x.part,
                "is_surface": x.is_surface,
                "t0": x.t0,
                "t1": x.t1,
                **contact_fields(x.contact),
            }
            for x in sequence.intervals
        ],
    }


def save_sequence(sequence: ContactSequence, path: str | Path) -> None:
    """Write `sequence.json`."""
    _write_json(Path(path), sequence_fields(sequence))


def _file_of(path: str | Path, name: str) -> Path:
    """The file itself, or that of its name in a folder."""
    path = Path(path)
    return path / name if path.is_dir() else path


def load_sequence(path: str | Path) -> ContactSequence:
    """Read a `sequence.json`, or that of a run folder.

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    file = _file_of(path, SEQUENCE)
    return _read_json(file, _SequenceFile).sequence(file)


# Policies.


class _OptionFile(pydantic.BaseModel):
    name: str
    region: Place
    surfaces: tuple[str, ...]
    repeats: int
    initiation: tuple[Region, ...]
    held: tuple[str, ...]
    termination: Place


class _PelvisFile(pydantic.BaseModel):
    mean: Vector
    sigma: tuple[float | None, float | None, float | None]
    samples: int

    def distribution(self) -> PelvisDistribution:
        sigma = [math.inf if s is None else s for s in self.sigma]
        return PelvisDistribution(
            mean=np.array(self.mean), sigma=np.array(sigma), samples=self.samples
        )


class _DemoFile(pydantic.BaseModel):
    source: str
    scene: _SceneFile
    subject: dict[str, float]
    states: list[_StateOfFile]
    actions: tuple[str | None, ...]

    def demo(self) -> DemoPolicy:
        return DemoPolicy(
            source=self.source,
            scene=self.scene.scene(),
            subject=self.subject,
            states=tuple(s.stance() for s in self.states),
            actions=self.actions,
        )


class _GeneralFile(pydantic.BaseModel):
    options: list[_OptionFile]
    over_top: _PelvisFile
    near_edge: _PelvisFile
    goal: tuple[str, ...]
    reach: dict[str, float]
    demos: list[_DemoFile]
    notes: tuple[str, ...] = ()
    secondary: list[_GeneralFile] = []

    def policy(self, path: Path, field: str) -> GeneralPolicy:
        """The record; what does not fit is named by its field of the file."""

        def made(where: str, make: Callable[[], _Record]) -> _Record:
            try:
                return make()
            except (ValueError, KeyError) as e:
                text = f"a policy that fits together ({e.args[0]})"
                raise InputError(text, source=path, field=f"{field}{where}") from e

        return made(
            "options",
            lambda: GeneralPolicy(
                options=tuple(
                    made(f"options.{i}", lambda o=o: Option(**o.model_dump()))
                    for i, o in enumerate(self.options)
                ),
                over_top=made("over_top", self.over_top.distribution),
                near_edge=made("near_edge", self.near_edge.distribution),
                goal=self.goal,
                reach=self.reach,
                demos=tuple(
                    made(f"demos.{i}", d.demo) for i, d in enumerate(self.demos)
                ),
                notes=self.notes,
                secondary=tuple(
                    s.policy(path, f"{field}secondary.{i}.")
                    for i, s in enumerate(self.secondary)
                ),
            ),
        )


def policy_summary(policy: GeneralPolicy) -> dict[str, Any]:
    """A general policy in plain numbers and words, without its demo policies."""
    summary = {k: v for k, v in policy_fields(policy).items() if k != "demos"}
    summary["sources"] = policy.sources
    summary["secondary"] = [policy_summary(s) for s in policy.secondary]
    return _plain(summary)


def policy_fields(policy: GeneralPolicy) -> dict[str, Any]:
    """A general policy by the keys of `policy.json`."""
    return {
        "options": [asdict(o) for o in policy.options],
        "over_top": _pelvis_fields(policy.over_top),
        "near_edge": _pelvis_fields(policy.near_edge),
        "goal": policy.goal,
        "reach": policy.reach,
        "notes": policy.notes,
        "demos": [
            {
                "source": d.source,
                "scene": scene_fields(d.scene),
                "subject": d.subject,
                "states": [{"region": s.region} | _stance_fields(s) for s in d.states],
                "actions": d.actions,
            }
            for d in policy.demos
        ],
        "secondary": [policy_fields(s) for s in policy.secondary],
    }


def _pelvis_fields(d: PelvisDistribution) -> dict[str, Any]:
    return {"mean": d.mean, "sigma": d.sigma, "samples": d.samples}


def save_policy(policy: GeneralPolicy, path: str | Path) -> None:
    """Write `policy.json`: the general policy and the demo policies behind it."""
    _write_json(Path(path), policy_fields(policy))


def load_policy(path: str | Path) -> GeneralPolicy:
    """Read a `policy.json`, or that of a folder.

    Raises:
        InputError: The file or one of its fields cannot be used.
    """
    file = _file_of(path, POLICY)
    return _read_json(file, _GeneralFile).policy(file, "")


# Plans.


class _StateFile(_ContactFile):
    projected_distance: float
    contact_angle: float
    phase: Phase


class _EquilibriumFile(pydantic.BaseModel):
    feasible: bool
    margin: float
    limiting: str | None
    forces: list[Vector]
    torques: list[float] | None = None


class _ResidualsFile(pydantic.BaseModel):
    contact: float
    distance: float
    balance: float
    limits: float
    worst_pair: int


def _known(status: str) -> str:
    if status not in Status.__members__:
        raise ValueError(f"one of {', '.join(Status.__members__)}")
    return status


_StatusName = Annotated[str, pydantic.AfterValidator(_known)]


class _KeyframeFile(pydantic.BaseModel):
    qpos: list[float]
    contacts: list[_StateFile]
    com: Vector
    com_margin: float | None
    static_equilibrium: _EquilibriumFile
    residuals: _ResidualsFile
    method: str
    iterations: int
    cost_before: float
    cost_after: float
    status: _StatusName

    def keyframe(self) -> Keyframe:
        e = self.static_equilibrium
        margin = -math.inf if self.com_margin is None else self.com_margin
        return Keyframe(
            q=np.array(self.qpos),
            contacts=tuple(
                ContactState(
                    contact=c.contact(),
                    projected_distance=c.projected_distance,
                    contact_angle=c.contact_angle,
                    phase=c.phase,
                )
                for c in self.contacts
            ),
            com=np.array(self.com),
            com_margin=margin,
            equilibrium=StaticEquilibrium(
                feasible=e.feasible,
                margin=e.margin,
                limiting=e.limiting,
                forces=np.array(e.forces).reshape(-1, 3),
                torques=None if e.torques is None else np.array(e.torques),
            ),
            residuals=Residuals(**self.residuals.model_dump(), com_margin=margin),
            status=Status[self.status],
            method=self.method,
            iterations=self.iterations,
            cost_before=self.cost_before,
            cost_after=self.cost_after,
        )


class _SkippedFile(pydantic.BaseModel):
    stance: int
    reason: str


class _PlaceFile(pydantic.BaseModel):
    """Where a robot is."""

    done: int = pydantic.Field(ge=0)
    qpos: list[float]
    contacts: list[_ContactFile]
    loaded: list[str]

    def state(self) -> State:
        stance = tuple(c.contact() for c in self.contacts)
        return State(
            done=self.done,
            stance=stance,
            loaded=tuple(c for c in stance if c.surface in self.loaded),
            q=np.array(self.qpos),
        )


Postures = list[list[float]]


class _StepFile(pydantic.BaseModel):
    index: int | None
    stance: int
    target: _StateOfFile
    limb: str
    breaks: tuple[str, ...]
    makes: _ContactFile | None
    fixed: bool
    seeds: dict[Literal["shifted", "touching"], list[float]] = {}
    base_rotation: list[Vector] | None = None
    reference: list[float] | None = None
    stands_up: bool

    def step(self) -> Step:
        return Step(
            index=self.index,
            stance=self.stance,
            target=self.target.stance(),
            limb=self.limb,
            breaks=self.breaks,
            makes=None if self.makes is None else self.makes.contact(),
            fixed=self.fixed,
            seeds=Seeds(**{k: np.array(q) for k, q in self.seeds.items()}),
            base_rotation=_array(self.base_rotation),
            reference=_array(self.reference),
            stands_up=self.stands_up,
        )


def _array(x: Sequence[Any] | None) -> np.ndarray | None:
    return None if x is None else np.array(x)


class _ChangeFile(pydantic.BaseModel):
    step: _StepFile
    margin: float
    held: list[_ContactFile]
    rolling: list[_ContactFile]
    shift: Postures
    swing: Postures
    settle: Postures
    arc: list[Vector]

    def change(self, before: Keyframe, after: Keyframe) -> Change:
        step = self.step.step()
        phases = contact_phases(
            before.stance,
            tuple(c.contact() for c in self.held),
            tuple(c.contact() for c in self.rolling),
            step.makes,
            [np.array(q) for q in (self.shift, self.swing, self.settle)],
            np.array(self.arc).reshape(-1, 3),
        )
        return Change(step=step, keyframe=after, phases=phases, margin=self.margin)


class _FailureFile(pydantic.BaseModel):
    status: _StatusName
    step: _StepFile | None
    detail: str

    def failure(self) -> Failure:
        step = None if self.step is None else self.step.step()
        return Failure(status=Status[self.status], step=step, detail=self.detail)


class _FallbackFile(pydantic.BaseModel):
    reason: str
    source: Literal["alternatives", "search", "secondary"] | None
    surfaces: tuple[str, ...]
    tried: str


class _IterationFile(pydantic.BaseModel):
    option: str
    cost: float


class _PlanFile(pydantic.BaseModel):
    options: dict[str, Any]
    robot: RobotFile
    sequence: _SequenceFile
    keyframes: list[_KeyframeFile] = pydantic.Field(min_length=1)
    changes: list[_ChangeFile]
    skipped: list[_SkippedFile]
    failures: list[_FailureFile]
    complete: bool
    state: _PlaceFile | None = None
    fallback: _FallbackFile | None = None
    policy: _GeneralFile | None = None
    iterations: list[_IterationFile] = []


class _TimingsFile(pydantic.BaseModel):
    seconds: dict[str, float]


def save_plan(plan: Plan, folder: str | Path) -> None:
    """Write `plan.json`, `trajectory.npz`, `scene.xml` with assets and `timings.json`.

    Results that the folder holds of an earlier plan are removed. `plan.json` comes
    last: where it is, the others are.
    """
    folder = Path(folder)
    for name in (PLAN, *_OF_AN_EARLIER_PLAN):
        (folder / name).unlink(missing_ok=True)
    _save_world(plan.world, folder, SCENE)
    if plan.trajectory is not None:
        save_trajectory(plan.trajectory, folder / TRAJECTORY)
    save_timings(folder, plan.timings)
    _write_json(folder / PLAN, _plan_fields(plan, folder))


def _plan_fields(plan: Plan, folder: Path) -> dict[str, Any]:
    world = plan.world
    robot = _robot_fields(world.robot)
    hashes = {"robot": _sha256(json.dumps(_plain(robot)).encode())}
    for name, path in (
        ("robot_model", world.robot.path),
        ("sequence", folder / SEQUENCE),
    ):
        if path.is_file():
            hashes[name] = _sha256(path.read_bytes())
    kin = Kinematics(world)
    return {
        "complete": plan.complete,
        "options": asdict(plan.options),
        "versions": {n: importlib.metadata.version(n) for n in VERSIONS_OF},
        "inputs": hashes,
        "robot": robot,
        "prefixes": dict(world.robot.prefixes),
        "keyframes": [keyframe_fields(k, kin) for k in plan.keyframes],
        "changes": [_change_fields(c) for c in plan.changes],
        "skipped": [asdict(s) for s in plan.skipped],
        "failures": [_failure_fields(f) for f in plan.failures],
        "sequence": sequence_fields(plan.sequence)
        | {"scene": scene_fields(world.scene)},
    } | _other_plan_fields(plan)


def _other_plan_fields(plan: Plan) -> dict[str, Any]:
    """What a plan has that is not of a whole climb as demonstrated."""
    out: dict[str, Any] = {}
    if plan.fallback is not None:
        out["fallback"] = asdict(plan.fallback)
    if plan.state is not None:
        out["state"] = {
            "done": plan.state.done,
            "qpos": plan.state.q,
            "contacts": [contact_fields(c) for c in plan.state.stance],
            "loaded": [c.surface for c in plan.state.loaded],
        }
    if plan.policy is not None:
        out["policy"] = policy_fields(plan.policy)
        out["iterations"] = [asdict(i) for i in plan.iterations]
    return out


def _step_fields(s: Step) -> dict[str, Any]:
    """A step by the keys of `plan.json`."""
    seeds = {"shifted": s.seeds.shifted, "touching": s.seeds.touching}
    return {
        "index": s.index,
        "stance": s.stance,
        "target": _stance_fields(s.target),
        "limb": s.limb,
        "breaks": s.breaks,
        "makes": None if s.makes is None else contact_fields(s.makes),
        "fixed": s.fixed,
        "seeds": {k: q for k, q in seeds.items() if q is not None},
        "base_rotation": s.base_rotation,
        "reference": s.reference,
        "stands_up": s.stands_up,
    }


def _change_fields(c: Change) -> dict[str, Any]:
    """A contact change by the keys of `plan.json`; its keyframe stands elsewhere."""
    shift, swing, settle = c.phases
    return {
        "step": _step_fields(c.step),
        "margin": c.margin,
        "held": [contact_fields(x) for x in swing.contacts],
        "rolling": [contact_fields(x) for x in shift.contacts[len(swing.contacts) :]],
        "shift": shift.q,
        "swing": swing.q,
        "settle": settle.q,
        "arc": swing.arc,
    }


def _failure_fields(f: Failure) -> dict[str, Any]:
    """A failure by the keys of `plan.json`, and as a sentence."""
    return {
        "stance": None if f.step is None else f.step.stance,
        "reason": str(f),
        "status": f.status.name,
        "detail": f.detail,
        "step": None if f.step is None else _step_fields(f.step),
    }


def fallback_note(written: Mapping[str, Any]) -> str:
    """What the fields of a `plan.json` say of its fallback; empty without one."""
    fields = written.get("fallback")
    return "" if fields is None else str(Fallback(**fields))


def _robot_fields(robot: Robot) -> dict[str, Any]:
    """A robot by the keys of `robot.yaml`; a built-in one's model below `robots`."""
    built_in = robot.path.is_relative_to(ROBOTS)
    path = robot.path.relative_to(ROBOTS) if built_in else robot.path.absolute()
    return {
        "version": VERSION,
        "name": robot.name,
        "model": path.as_posix(),
        "base": robot.base,
        "home": robot.home,
        "limbs": {
            n: {
                "root": x.root,
                "middle": x.middle,
                "end": x.end,
                "surfaces": x.surfaces,
            }
            for n, x in robot.limbs.items()
        },
        "surfaces": robot.prefixes,
        "effort": robot.effort,
        "gains": {
            n: dict(zip(("kp", "kd", "ki"), g, strict=True))
            for n, g in robot.gains.items()
        },
        "impedance": {
            n: dict(zip(("kp", "kd"), g, strict=True))
            for n, g in robot.impedance.items()
        },
        "self_positioning": robot.self_positioning,
    }


def keyframe_fields(k: Keyframe, kin: Kinematics) -> dict[str, Any]:
    """A keyframe by the keys of `plan.json`."""
    kin.update(k.q)
    points = contact_points(kin, k.stance)
    e = k.equilibrium
    return {
        "qpos": k.q,
        "contacts": [
            contact_fields(c.contact)
            | {
                "projected_distance": c.projected_distance,
                "contact_angle": c.contact_angle,
                "phase": c.phase,
            }
            for c in k.contacts
        ],
        "com": k.com,
        "com_margin": k.com_margin,
        "static_equilibrium": {
            "feasible": e.feasible,
            "margin": e.margin,
            "limiting": e.limiting,
            "surfaces": points.names,
            "points": points.points,
            "forces": e.forces,
            "torques": e.torques,
        },
        "residuals": {n: getattr(k.residuals, n) for n in _ResidualsFile.model_fields},
        "method": k.method,
        "iterations": k.iterations,
        "cost_before": k.cost_before,
        "cost_after": k.cost_after,
        "status": k.status.name,
    }


def _save_world(world: World, folder: Path, name: str) -> None:
    xml = _with_assets(world, folder)
    with _whole(folder / name) as stream:
        stream.write(xml.encode())


def _with_assets(world: World, folder: Path) -> str:
    """The world's MJCF; files that it names are copied beside it."""
    if "file=" not in world.xml:
        return world.xml
    root = ElementTree.fromstring(world.xml)
    base = world.robot.path.parent
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
                taken = set(names.values())
                stem, suffix, n = Path(name).stem, Path(name).suffix, 2
                unique = stem + suffix
                while unique in taken:
                    unique, n = f"{stem}-{n}{suffix}", n + 1
                names[content] = unique
            element.set(key, f"{ASSETS}/{names[content]}")
    (folder / ASSETS).mkdir(exist_ok=True)
    for content, name in names.items():
        with _whole(folder / ASSETS / name) as stream:
            stream.write(content)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def save_proposal(proposal: Proposal, folder: str | Path) -> None:
    """Write `robot.yaml`, the model that it names, and meshes into a folder."""
    files = {f"{MESH_FOLDER}/{n}": content for n, content in proposal.files.items()}
    files[proposal.fields["model"]] = proposal.mjcf.encode()
    files[ROBOT] = robot_yaml(proposal).encode()
    for name, content in files.items():
        (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
        with _whole(Path(folder) / name) as stream:
            stream.write(content)


def load_plan(folder: str | Path, *, without: Collection[str] = ()) -> Plan:
    """Read what `save_plan` wrote.

    World and trajectory are the planned ones, whatever a run has made of them since.

    Args:
        folder: The run folder.
        without: Of `trajectory.npz` and `timings.json`, what is not read: it may be
            broken then.

    Raises:
        InputError: A file is missing, broken, or does not fit the others.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"a run folder; {RUN_MAKERS}", source=folder)
    path = folder / PLAN
    file = _read_json(path, _PlanFile)
    try:
        options = pydantic.TypeAdapter(PlanOptions).validate_python(file.options)
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    sequence = file.sequence.sequence(path)
    scene, followed = _planned(folder)
    world = _load_world(scene, _robot(file.robot), sequence.scene)
    nq = world.model.nq
    if len(file.changes) + 1 != len(file.keyframes):
        raise InputError(
            "a change between neighbouring keyframes", source=path, field="changes"
        )
    for field, q in _postures(file):
        if len(q) != nq:
            raise InputError(
                f"{nq} numbers, as many as {SCENE} has coordinates",
                source=path,
                field=field,
                value=f"{len(q)} numbers",
            )
    for i, k in enumerate(file.keyframes):
        for c in k.contacts:
            known = c.surface in world.surfaces and c.support in world.supports
            if not known:
                raise InputError(
                    f"a surface of the robot on a support of {SCENE}",
                    source=path,
                    field=f"keyframes.{i}.contacts",
                    value=f"{c.surface} on {c.support}",
                )
    trajectory = None
    if TRAJECTORY not in without and (followed.exists() or file.complete):
        trajectory = load_trajectory(followed, world)
    timings: dict[str, float] = {}
    if TIMINGS not in without and (folder / TIMINGS).exists():
        timings = _read_json(folder / TIMINGS, _TimingsFile).seconds
    keys = [k.keyframe() for k in file.keyframes]
    return Plan(
        world=world,
        options=options,
        sequence=sequence,
        start=keys[0],
        changes=tuple(
            c.change(before, after)
            for c, before, after in zip(file.changes, keys, keys[1:], strict=False)
        ),
        skipped=tuple(Skipped(**s.model_dump()) for s in file.skipped),
        failures=tuple(f.failure() for f in file.failures),
        trajectory=trajectory,
        complete=file.complete,
        timings=timings,
        state=None if file.state is None else file.state.state(),
        fallback=None
        if file.fallback is None
        else Fallback(**file.fallback.model_dump()),
        policy=None if file.policy is None else file.policy.policy(path, "policy."),
        iterations=tuple(Iteration(**i.model_dump()) for i in file.iterations),
    )


def _postures(file: _PlanFile) -> Iterator[tuple[str, list[float]]]:
    """Every posture of a plan and the name of its field."""
    if file.state is not None:
        yield "state.qpos", file.state.qpos
    for i, k in enumerate(file.keyframes):
        yield f"keyframes.{i}.qpos", k.qpos
    for i, c in enumerate(file.changes):
        for name in ("shift", "swing", "settle"):
            for q in getattr(c, name):
                yield f"changes.{i}.{name}", q


def _planned(folder: Path) -> tuple[Path, Path]:
    """Scene and trajectory as planned: a run may have put others in their place."""
    scene, trajectory = folder / PLANNED_SCENE, folder / PLANNED_TRAJECTORY
    return (
        scene if scene.exists() else folder / SCENE,
        trajectory if trajectory.exists() else folder / TRAJECTORY,
    )


def _robot(file: RobotFile) -> Robot:
    return Robot(
        name=file.name,
        path=ROBOTS / file.model,
        base=file.base,
        home=file.home,
        limbs={
            n: Limb(
                name=n,
                root=x.root,
                middle=x.middle,
                end=x.end,
                surfaces=tuple(x.surfaces),
            )
            for n in LIMBS
            if (x := file.limbs.get(n))
        },
        prefixes=file.surfaces,
        effort=file.effort,
        gains={n: (g.kp, g.kd, g.ki) for n, g in file.gains.items()},
        impedance={n: (g.kp, g.kd) for n, g in file.impedance.items()},
        self_positioning=tuple(file.self_positioning),
    )


def trajectory_of(plan: Plan, source: Path) -> Trajectory:
    """The trajectory of a plan that is to be played.

    Raises:
        InputError: It got no motion; `source` is the folder that it came from.
    """
    if plan.trajectory is None:
        raise InputError(
            "a plan that got as far as a trajectory; the last line of `clamber plan`"
            " says why this one did not",
            source=source,
        )
    return plan.trajectory


def _load_world(path: Path, robot: Robot, scene: Scene) -> World:
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
        world = index_world(model, path.read_text(), robot, scene)
        for limb in robot.limbs.values():
            for name in (limb.root, limb.middle, limb.end):
                world.landmark(name)
        return world
    except OSError as e:
        raise unreadable(path, e, _maker(path)) from e
    except (ValueError, KeyError, IndexError) as e:
        reason = " ".join(str(e.args[0] if e.args else e).split())
        raise InputError(
            f"the robot and the boxes of {PLAN} as MJCF ({reason}); {_maker(path)}",
            source=path,
        ) from e


def save_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write `trajectory.npz`."""
    x = trajectory
    _write_npz(
        Path(path),
        {
            "time": x.time,
            "qpos": x.q,
            "qvel": x.v,
            "joint_names": x.joints,
            "surfaces": x.surfaces,
            "contact": x.contact,
            "tau": x.tau,
            "keyframes": x.keyframes,
            "segments": [json.dumps(_segment_fields(x)) for x in x.segments],
        },
    )


def _segment_fields(x: Segment) -> dict[str, Any]:
    makes = None if x.makes is None else contact_fields(x.makes)
    fields = {k: np.asarray(v).tolist() for k, v in (makes or {}).items()}
    return asdict(replace(x, makes=None)) | {"makes": fields or None}


class _SegmentFile(pydantic.BaseModel):
    kind: str
    change: int | None
    begin: int
    end: int
    makes: _ContactFile | None

    def segment(self) -> Segment:
        makes = None if self.makes is None else self.makes.contact()
        return Segment(**self.model_dump(exclude={"makes"}), makes=makes)


def load_trajectory(path: str | Path, world: World) -> Trajectory:
    """Read a `trajectory.npz` of that world.

    Raises:
        InputError: It is missing, broken or another robot's.
    """
    f = _Arrays(Path(path))
    time = f.get("time", None)
    n, m = len(time), world.model
    joints = tuple(f.get("joint_names", len(world.joints)).tolist())
    surfaces = tuple(f.get("surfaces", None).tolist())
    for field, names, wanted in (
        ("joint_names", joints, world.joints),
        ("surfaces", surfaces, tuple(world.surfaces)),
    ):
        if names != wanted:
            raise InputError(
                f"those of {SCENE}, {', '.join(wanted)}",
                source=f.path,
                field=field,
                value=", ".join(names),
            )
    return Trajectory(
        time=time,
        q=f.get("qpos", n, m.nq),
        v=f.get("qvel", n, m.nv),
        tau=f.get("tau", n, len(joints)),
        contact=f.get("contact", n, len(surfaces)).astype(bool),
        surfaces=surfaces,
        joints=joints,
        keyframes=f.get("keyframes", None),
        segments=_segments(f),
    )


def _segments(f: _Arrays) -> tuple[Segment, ...]:
    try:
        rows = [_SegmentFile.model_validate_json(x) for x in f.get("segments", None)]
    except pydantic.ValidationError as e:
        raise InputError("segments as JSON", source=f.path, field="segments") from e
    return tuple(x.segment() for x in rows)


def save_timings(folder: str | Path, seconds: Mapping[str, float]) -> None:
    """Add to the seconds by stage in `timings.json`."""
    path = Path(folder) / TIMINGS
    known: dict[str, float] = {}
    if path.exists():
        known = _read_json(path, _TimingsFile).seconds
    _write_json(path, {"seconds": {**known, **seconds}})


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


# Other contacts, and where a robot is.


def save_replanned(found: Replanned, folder: str | Path) -> None:
    """Write `replan.json`: what was tried, the best first, and what the search did."""
    e = found.explored
    _write_json(
        Path(folder) / REPLANNED,
        {
            "differences": found.differences,
            "plans": [
                {
                    "surfaces": r.surfaces,
                    "cost": r.cost,
                    "stable": r.stable,
                    "moves": [str(c.step) for c in r.plan.changes],
                    "missed": [str(f) for f in r.plan.failures],
                }
                for r in found.ranked
            ],
            "search": None
            if e is None
            else {"states": e.states, "tries": e.tries, "stop": e.stop.value},
        },
    )


class _StateOnDisk(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid")
    version: int = VERSION
    position: Vector
    quaternion: Quaternion
    joints: dict[str, float]
    contacts: dict[str, str] | None = None


def load_state(
    plan: Plan, folder: str | Path, where: str
) -> tuple[np.ndarray, dict[str, str] | None]:
    """Posture (nq,) and the support of each surface in contact, None if not said.

    Args:
        plan: That the robot was following.
        folder: Its run.
        where: A state file (YAML or JSON: `position` and `quaternion` of the base,
            `joints` by name, `contacts` as supports by surface), or a time of the run's
            rollout [s].

    Raises:
        InputError: The file or one of its fields cannot be used, or nothing was
            recorded at that time.
    """
    try:
        seconds = float(where)
    except ValueError:
        return _state_of(plan.world, Path(where))
    rollout = load_rollout(folder)
    if not 0.0 <= seconds <= rollout.time[-1]:
        raise InputError(
            f"a time of the rollout, 0 to {rollout.time[-1]:g} s",
            source="--from",
            value=seconds,
        )
    return rollout.qpos[int(np.searchsorted(rollout.time, seconds))], None


def _state_of(world: World, path: Path) -> tuple[np.ndarray, dict[str, str] | None]:
    try:
        state = _StateOnDisk.model_validate(read_yaml(path))
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    numbers = (*state.position, *state.quaternion, *state.joints.values())
    if not np.all(np.isfinite(numbers)):
        raise InputError("finite numbers only", source=path)
    size = float(np.linalg.norm(state.quaternion))
    if abs(size - 1.0) > 0.01:
        raise InputError(
            "a unit quaternion, w first",
            source=path,
            field="quaternion",
            value=state.quaternion,
        )
    for name in (*state.joints, *world.joints):
        if (name in state.joints) != (name in world.joints):
            raise InputError(
                f"the joints of {world.robot.name}: {', '.join(world.joints)}",
                source=path,
                field=f"joints.{name}",
                value=state.joints.get(name, "missing"),
            )
    q = world.home.copy()
    q[:3], q[3:7] = state.position, np.array(state.quaternion) / size
    q[world.qadr] = [state.joints[n] for n in world.joints]
    return q, state.contacts


# Rollouts and verdicts.


def save_rollout(plan: Plan, rollout: Rollout, folder: str | Path) -> None:
    """Write what physics did, and what it ran.

    `rollout.npz` has the arrays by name, `execution.json` the events. `scene.xml` and
    `trajectory.npz` become what physics ran and what was last followed; where those are
    not the planned ones, the planned ones are kept as `planned.xml`, `planned.npz`.
    """
    folder = Path(folder)
    same_world = rollout.world.xml == plan.world.xml
    assert plan.trajectory is not None
    if not same_world:
        _save_world(plan.world, folder, PLANNED_SCENE)
    _save_world(rollout.world, folder, SCENE)
    if rollout.followed is not None:
        save_trajectory(plan.trajectory, folder / PLANNED_TRAJECTORY)
    save_trajectory(rollout.followed or plan.trajectory, folder / TRAJECTORY)
    if same_world:
        (folder / PLANNED_SCENE).unlink(missing_ok=True)
    if rollout.followed is None:
        (folder / PLANNED_TRAJECTORY).unlink(missing_ok=True)
    arrays: dict[str, Any] = {}
    for field in fields(rollout):
        value = getattr(rollout, field.name)
        if field.name in _NOT_IN_ROLLOUT or value is None:
            continue
        arrays[field.name] = value
    _write_npz(folder / ROLLOUT, arrays)
    _write_json(
        folder / EXECUTION,
        {
            "scene": scene_fields(rollout.world.scene),
            "events": [event_fields(e) for e in rollout.events],
            "fell": rollout.fell,
            "stopped": rollout.stopped,
            "rests_on": rollout.rests_on,
        },
    )


def load_rollout(folder: str | Path, *, with_events: bool = True) -> Rollout:
    """Read what `save_rollout` wrote.

    Args:
        folder: The run folder.
        with_events: Without them, `execution.json` may be broken: nothing is said of
            events or a fall, and the scene is the planned one.

    Raises:
        InputError: A file is missing or broken.
    """
    folder = Path(folder)
    f = _Arrays(folder / ROLLOUT)
    steps, states = len(f.get("ctrl", None, None)), len(f.get("time", None))
    nu, ns = f.get("ctrl", None, None).shape[1], len(f.get("surfaces", None))
    shapes: dict[str, tuple[int | None, ...]] = {
        "ctrl": (steps, nu),
        "qpos": (states, None),
        "qvel": (states, None),
        "actuator_force": (states, nu),
        "contact_force": (states, ns, 3),
        "unintended": (states,),
        "contact_step": (None,),
        "contact_geoms": (None, 2),
        "contact_load": (None, 2),
        "end_speed": (None,),
    }
    values: dict[str, Any] = {}
    for name, kind in get_type_hints(Rollout).items():
        if name in _NOT_IN_ROLLOUT or name == "push":
            continue
        if kind is np.ndarray:
            shape = shapes.get(name, (states,))
            values[name] = f.get(name, *shape)
        elif kind is Any or get_args(kind):
            values[name] = tuple(f.get(name, None).tolist())
        else:
            values[name] = kind(f.get(name).item())
    if "push" in f:
        values["push"] = f.get("push", steps, 3)
    planned = _read_json(folder / PLAN, _PlanFile)
    if with_events:
        file = _read_json(folder / EXECUTION, _ExecutionFile)
    else:
        file = _ExecutionFile(
            scene=planned.sequence.scene, events=[], fell=False, stopped="", rests_on=[]
        )
    world = _load_world(folder / SCENE, _robot(planned.robot), file.scene.scene())
    m = world.model
    for name, n in (("qpos", m.nq), ("qvel", m.nv), ("ctrl", m.nu)):
        if values[name].shape[1] != n:
            raise InputError(
                f"{n} columns, as {SCENE} has it",
                source=f.path,
                field=name,
                value=f"{values[name].shape[1]} columns",
            )
    if values["surfaces"] != tuple(world.surfaces):
        raise InputError(
            f"those of {SCENE}, {', '.join(world.surfaces)}",
            source=f.path,
            field="surfaces",
            value=", ".join(values["surfaces"]),
        )
    followed = None
    if (folder / PLANNED_TRAJECTORY).exists():
        followed = load_trajectory(folder / TRAJECTORY, world)
    return Rollout(
        **values,
        world=world,
        followed=followed,
        events=tuple(e.event() for e in file.events),
        fell=file.fell,
        rests_on=tuple(file.rests_on),
    )


class _EventFile(pydantic.BaseModel, extra="allow"):
    type: str
    time: float
    text: str

    @pydantic.model_validator(mode="after")
    def _is_one(self) -> _EventFile:
        if self.type not in EVENTS:
            raise ValueError(f"one of {', '.join(EVENTS)}")
        self.event()
        return self

    def event(self) -> Event:
        fields = {"time": self.time, **(self.model_extra or {})}
        return pydantic.TypeAdapter(EVENTS[self.type]).validate_python(fields)


class _ExecutionFile(pydantic.BaseModel):
    scene: _SceneFile
    events: list[_EventFile]
    fell: bool
    stopped: str
    rests_on: list[str]


class _CriterionFile(pydantic.BaseModel):
    value: float | None
    limit: float
    ok: bool


class _VerdictFile(pydantic.BaseModel):
    reached: bool
    criteria: dict[Figure, _CriterionFile]


def save_verdict(verdict: Verdict, folder: str | Path) -> None:
    """Write `verdict.json`."""
    _write_json(Path(folder) / VERDICT, verdict_fields(verdict))


def verdict_fields(verdict: Verdict) -> dict[str, Any]:
    """A verdict by the keys of `verdict.json`."""
    return {
        "reached": verdict.reached,
        "criteria": {n: asdict(c) for n, c in verdict.criteria.items()},
    }


def load_verdict(folder: str | Path) -> Verdict:
    """Read the `verdict.json` of a run folder.

    Raises:
        InputError: It is missing or broken.
    """
    file = _read_json(Path(folder) / VERDICT, _VerdictFile)
    return Verdict(
        reached=file.reached,
        criteria={
            n: Criterion(
                value=math.nan if c.value is None else c.value, limit=c.limit, ok=c.ok
            )
            for n, c in file.criteria.items()
        },
    )


# Files by themselves.


_KINDS: dict[str, type[pydantic.BaseModel]] = {
    PLAN: _PlanFile,
    SEQUENCE: _SequenceFile,
    EXECUTION: _ExecutionFile,
    VERDICT: _VerdictFile,
    TIMINGS: _TimingsFile,
}


def load_fields(folder: str | Path, name: str) -> dict[str, Any]:
    """What a JSON file of a run folder says, as it is written, once it is checked.

    For what is shown of a run whose other files are missing or broken.

    Args:
        folder: The run folder.
        name: `plan.json`, `sequence.json`, `execution.json`, `verdict.json` or
            `timings.json`.

    Raises:
        InputError: It is missing or broken.
    """
    path = Path(folder) / name
    _read_json(path, _KINDS[name])
    text = path.read_text()
    try:  # what is read as it is written has numbers for numbers
        _KINDS[name].model_validate_json(text, strict=True)
    except pydantic.ValidationError as e:
        raise input_error(e, path) from e
    return json.loads(text)
