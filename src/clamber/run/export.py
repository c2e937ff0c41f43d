"""Run folder -> one file that other people's tools read: CSV, MCAP or npz.

What is exported is what was followed: the reference of the run, at a whole fraction of
its 1 kHz, with its contact schedule and, where physics has run, the forces on its
surfaces. On request a motion from the posture that was measured on the robot to the
first one comes before it.

Shapes: T samples, na joints, nS surfaces, nb bodies of the robot.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from clamber.errors import InputError, MissingDependency
from clamber.execution.simulation import Rollout
from clamber.model.arguments import checks_types
from clamber.model.kinematics import Kinematics
from clamber.model.records import short_repr
from clamber.model.world import World
from clamber.planning.trajectory import RATE, Trajectory
from clamber.run.codec import whole_file
from clamber.run.folder import ROLLOUT, load_plan, load_rollout, trajectory_of
from clamber.run.lead_in import SPEED, States, lead_in_motion, measured_posture

Format = Literal["csv", "mcap", "npz"]
Layout = Literal["mjlab", "holosoma"]
# [Hz] of each format: controllers go through positions and velocities by cubic splines,
# and states of a rollout are recorded at 100; trainers step their policies at 50.
DEFAULT_RATE: Mapping[str, int] = {"csv": 100, "mcap": 100, "npz": 50}
WORLD = "world"  # the fixed frame of MCAP's messages


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Motion:
    """The sampled motion that is exported.

    Attributes:
        world: As planned.
        rate: [Hz].
        reference: T samples of what was followed.
        states: What physics made of it, where it has run; else the same.
        contact: (T, nS) bool; surfaces in the order of `world`.
        force: (T, nS, 3) on each surface in physics [N], in the world; zero in the
            lead-in, which physics has not run; None where there is no rollout.
        lead_in: Samples before the run itself.
    """

    world: World
    rate: int
    reference: States
    states: States
    contact: np.ndarray
    force: np.ndarray | None
    lead_in: int = 0

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Exported:
    """The file that was written.

    Attributes:
        file: Its path.
        rate: Sampling rate [Hz].
        samples: Number of samples.
        lead_in: Duration of the motion before the run itself [s].
        forces: Whether it has contact forces: it does once physics has run.
    """

    file: Path
    rate: int
    samples: int
    lead_in: float
    forces: bool


@checks_types
def export_run(
    folder: str | Path,
    *,
    to: Format,
    out: str | Path | None = None,
    rate: int | None = None,
    lead_in: str | Path | Mapping[str, float] | None = None,
    lead_in_speed: float = SPEED,
    layout: Layout | None = None,
) -> Exported:
    """Write the motion of a run for other tools.

    Args:
        folder: A run folder that holds a plan.
        to: `csv`; `mcap`: ROS 2 messages; `npz`: for whole-body tracking.
        out: The file; `motion.<to>` in the run folder by default.
        rate: Sampling rate [Hz], a divisor of 1000; 100 for `csv` and `mcap`, 50 for
            `npz` by default.
        lead_in: Measured joint angles [rad] by name, the file that holds them, or
            `home`: a motion from there to the first posture comes first.
        lead_in_speed: Largest joint speed of that motion [rad/s].
        layout: What `joint_pos` and `joint_vel` of an npz hold: the joints alone, as
            mjlab reads (the default), or qpos and qvel, as holosoma reads.

    Raises:
        InputError: There is nothing to export, or an argument cannot be used.
        MissingDependency: `mcap` without its packages.
    """
    if layout is not None and to != "npz":
        text = "no layout for this format: it goes with --to npz"
        raise InputError(text, "--layout", value=layout)
    folder = Path(folder)
    file = folder / f"motion.{to}" if out is None else Path(out)
    motion = load_motion(
        folder,
        rate=DEFAULT_RATE[to] if rate is None else rate,
        lead_in=lead_in,
        lead_in_speed=lead_in_speed,
    )
    try:
        with whole_file(file) as draft:
            if to == "csv":
                _write_csv(motion, draft)
            elif to == "mcap":
                _write_mcap(motion, draft)
            else:
                _write_npz(motion, draft, layout or "mjlab")
    except OSError as e:
        text = f"a file that can be written ({e.strerror or e})"
        raise InputError(text, "--out", value=str(file)) from e
    return Exported(
        file=file,
        rate=motion.rate,
        samples=len(motion.contact),
        lead_in=motion.lead_in / motion.rate,
        forces=motion.force is not None,
    )


# What is exported.


def load_motion(
    folder: str | Path,
    *,
    rate: int,
    lead_in: str | Path | Mapping[str, float] | None = None,
    lead_in_speed: float = SPEED,
) -> Motion:
    """Read what a run followed, at `rate` [Hz]; the arguments of `export_run`.

    A run that fell ends where it fell.

    Raises:
        InputError: As `export_run`.
    """
    folder = Path(folder)
    if rate <= 0 or RATE % rate:
        text = f"a divisor of {RATE:.0f} Hz, as 50 or 100"
        raise InputError(text, "--rate", value=rate)
    plan = load_plan(folder)
    reference = trajectory_of(plan, folder)
    rollout = load_rollout(folder) if (folder / ROLLOUT).exists() else None
    motion = _sampled(plan.world, reference, rollout, rate)
    if lead_in is None:
        return motion
    lead = lead_in_motion(
        plan.world,
        measured_posture(plan.world, lead_in),
        motion.reference,
        stance=plan.start.stance,
        rate=rate,
        speed=lead_in_speed,
    )
    n, force = len(lead.q), motion.force
    if force is not None:
        force = np.concatenate([np.zeros((n, *force.shape[1:])), force])
    first = np.repeat(motion.contact[:1], n, axis=0)
    return replace(
        motion,
        reference=lead.then(motion.reference),
        states=lead.then(motion.states),
        contact=np.concatenate([first, motion.contact]),
        force=force,
        lead_in=n,
    )


def _sampled(
    world: World, reference: Trajectory, rollout: Rollout | None, rate: int
) -> Motion:
    """The reference on the grid of `rate`; states and forces held since the last one.

    Sample k of the reference is the command of physics step k.
    """
    t, n = reference, len(reference.time)
    if rollout is not None:
        t = rollout.followed or t
        n = min(len(t.time), len(rollout.ctrl))
    k = np.arange(0, n, round(RATE / rate))
    followed = states = States(q=t.q[k], v=t.v[k], tau=t.tau[k])
    force = None
    if rollout is not None:
        if rollout.followed is not None:
            v = _with_base_velocity(Kinematics(world), followed, rate)
            followed = replace(followed, v=v)
        j = k // rollout.stride
        order = [rollout.world.model.actuator(name).id for name in world.joints]
        effort = rollout.actuator_force[j][:, order]
        states = States(q=rollout.qpos[j], v=rollout.qvel[j], tau=effort)
        force = rollout.contact_force[j]
    return Motion(
        world=world,
        rate=rate,
        reference=followed,
        states=states,
        contact=t.contact[k],
        force=force,
    )


def _with_base_velocity(kin: Kinematics, x: States, rate: int) -> np.ndarray:
    """`v` (T, nv) with that of the base by differences of q: execution keeps none."""
    out, last = x.v.copy(), len(x.q) - 1
    for k in range(len(x.q)):
        a, b = max(k - 1, 0), min(k + 1, last)
        if b > a:
            out[k, :6] = kin.difference(x.q[a], x.q[b])[:6] * rate / (b - a)
    return out


# CSV.


def _write_csv(m: Motion, path: Path) -> None:
    """One row a sample; numbers in their shortest exact form, units in the header."""
    w, x, n = m.world, m.reference, len(m.contact)
    header = ["time [s]"]
    header += [f"base {a} [m]" for a in "xyz"] + [f"base q{a} [-]" for a in "wxyz"]
    header += [f"base v{a} [m/s]" for a in "xyz"]
    header += [f"base w{a} [rad/s]" for a in "xyz"]
    columns = [np.arange(n)[:, None] / m.rate, x.q[:, :7], x.v[:, :6]]
    for what, values in (
        ("position [rad]", x.q[:, w.qadr]),
        ("velocity [rad/s]", x.v[:, w.dadr]),
        ("torque [N m]", x.tau),
    ):
        header += [f"{j} {what}" for j in w.joints]
        columns.append(values)
    header += [f"{s} contact [-]" for s in w.surfaces]
    forces = np.zeros((n, 0))
    if m.force is not None:
        header += [f"{s} force {a} [N]" for s in w.surfaces for a in "xyz"]
        forces = m.force.reshape(n, -1)
    numbers = np.concatenate(columns, axis=1).tolist()
    flags = m.contact.astype(int).tolist()
    rows = zip(numbers, flags, forces.tolist(), strict=True)
    with path.open("w", newline="") as stream:
        out = csv.writer(stream, lineterminator="\n")
        out.writerow(header)
        out.writerows([*a, *b, *c] for a, b, c in rows)


# npz.


def body_states(
    world: World, q: np.ndarray, v: np.ndarray
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Names of the robot's bodies, (T, nb, 3) positions, (T, nb, 4) orientations wxyz.

    Then (T, nb, 3) velocities of the frames' origins and (T, nb, 3) angular velocities,
    all in the world.
    """
    m = world.model
    bodies = np.flatnonzero(m.body_rootid == m.body_rootid[world.base])
    data = mujoco.MjData(m)
    position = np.empty((len(q), len(bodies), 3))
    orientation = np.empty((len(q), len(bodies), 4))
    twist = np.empty((len(q), len(bodies), 6))
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for k in range(len(q)):
        data.qpos[:], data.qvel[:] = q[k], v[k]
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_comVel(m, data)
        position[k], orientation[k] = data.xpos[bodies], data.xquat[bodies]
        for i, b in enumerate(bodies):
            mujoco.mj_objectVelocity(m, data, kind, int(b), twist[k, i], 0)
    names = [m.body(int(b)).name for b in bodies]
    return names, position, orientation, twist[..., 3:], twist[..., :3]


def _write_npz(m: Motion, path: Path, layout: Layout) -> None:
    """Arrays without pickle, by the names that trackers read."""
    w, q, v = m.world, m.reference.q, m.reference.v
    names, position, orientation, linear, angular = body_states(w, q, v)
    joints = layout == "mjlab"
    arrays: dict[str, Any] = {
        "fps": np.array([m.rate]),
        "qpos": q,
        "qvel": v,
        "joint_names": np.array(w.joints),
        "joint_pos": q[:, w.qadr] if joints else q,
        "joint_vel": v[:, w.dadr] if joints else v,
        "joint_torque": m.reference.tau,
        "body_names": np.array(names),
        "body_pos_w": position,
        "body_quat_w": orientation,
        "body_lin_vel_w": linear,
        "body_ang_vel_w": angular,
        "surfaces": np.array(list(w.surfaces)),
        "contact": m.contact,
    }
    if m.force is not None:
        arrays["contact_force"] = m.force
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


# MCAP: ROS 2's messages, as its bag files hold them.

_RULE = "=" * 80
_TIME = "builtin_interfaces/Time", "int32 sec\nuint32 nanosec"
_DURATION = "builtin_interfaces/Duration", "int32 sec\nuint32 nanosec"
_HEADER = "std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id"
_VECTOR = "geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"
_QUATERNION = (
    "geometry_msgs/Quaternion",
    "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
)
_POINT = (
    "trajectory_msgs/JointTrajectoryPoint",
    "float64[] positions # [rad]\n"
    "float64[] velocities # [rad/s]\n"
    "float64[] accelerations # [rad/s^2]\n"
    "float64[] effort # [N m]\n"
    "builtin_interfaces/Duration time_from_start",
)
_WRENCH = (
    "geometry_msgs/Wrench",
    "geometry_msgs/Vector3 force # [N]\ngeometry_msgs/Vector3 torque # [N m]",
)
_TRANSFORM = (
    "geometry_msgs/Transform",
    "geometry_msgs/Vector3 translation # [m]\ngeometry_msgs/Quaternion rotation",
)
_STAMPED = (
    "geometry_msgs/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
)
# A message: its own fields, then the types that they mention.
SCHEMAS: Mapping[str, tuple[str, tuple[tuple[str, str], ...]]] = {
    "trajectory_msgs/msg/JointTrajectory": (
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint[] points",
        (_HEADER, _POINT, _TIME, _DURATION),
    ),
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position # [rad]\n"
        "float64[] velocity # [rad/s]\nfloat64[] effort # [N m]",
        (_HEADER, _TIME),
    ),
    "tf2_msgs/msg/TFMessage": (
        "geometry_msgs/TransformStamped[] transforms",
        (_STAMPED, _HEADER, _TRANSFORM, _VECTOR, _QUATERNION, _TIME),
    ),
    "std_msgs/msg/Bool": ("bool data", ()),
    "geometry_msgs/msg/WrenchStamped": (
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
        (_HEADER, _WRENCH, _VECTOR, _TIME),
    ),
}


def _write_mcap(m: Motion, path: Path) -> None:
    """The trajectory as two messages at time zero, all else sample by sample."""
    try:
        from mcap_ros2.writer import Writer
    except ImportError as e:
        raise MissingDependency("mcap-ros2-support", "export") from e
    base = m.world.model.body(m.world.base).name
    with path.open("wb") as stream, Writer(stream) as writer:
        schemas = {
            name: writer.register_msgdef(name, _message_definition(name))
            for name in SCHEMAS
        }

        def write(
            topic: str, kind: str, stamp: int, message: Mapping[str, Any]
        ) -> None:
            writer.write_message(topic, schemas[kind], message, stamp, stamp)

        for topic, effort in (
            ("/joint_trajectory", False),
            ("/joint_trajectory_with_torques", True),
        ):
            kind = "trajectory_msgs/msg/JointTrajectory"
            write(topic, kind, 0, _trajectory_message(m, with_effort=effort))
        x = m.states
        for k in range(len(x.q)):
            ns = k * (1_000_000_000 // m.rate)
            header = {"stamp": _time(ns), "frame_id": WORLD}
            joints = {
                "header": header,
                "name": list(m.world.joints),
                "position": x.q[k, m.world.qadr].tolist(),
                "velocity": x.v[k, m.world.dadr].tolist(),
                "effort": x.tau[k].tolist(),
            }
            write("/joint_states", "sensor_msgs/msg/JointState", ns, joints)
            transform = {
                "translation": _xyz(x.q[k, :3]),
                "rotation": {**_xyz(x.q[k, 4:7]), "w": float(x.q[k, 3])},
            }
            moved = {"header": header, "child_frame_id": base, "transform": transform}
            write("/tf", "tf2_msgs/msg/TFMessage", ns, {"transforms": [moved]})
            for i, surface in enumerate(m.world.surfaces):
                closed = {"data": bool(m.contact[k, i])}
                write(f"/contact/{surface}", "std_msgs/msg/Bool", ns, closed)
                if m.force is not None:
                    wrench = {"force": _xyz(m.force[k, i]), "torque": _xyz(np.zeros(3))}
                    message = {"header": header, "wrench": wrench}
                    kind = "geometry_msgs/msg/WrenchStamped"
                    write(f"/force/{surface}", kind, ns, message)


def _trajectory_message(m: Motion, *, with_effort: bool) -> dict[str, Any]:
    """A `JointTrajectory`; stamp zero starts it at once.

    Torques are not in the one that `joint_trajectory_controller` is sent: it refuses
    those, unless it commands efforts.
    """
    x = m.reference
    points = [
        {
            "positions": x.q[k, m.world.qadr].tolist(),
            "velocities": x.v[k, m.world.dadr].tolist(),
            "effort": x.tau[k].tolist() if with_effort else [],
            "time_from_start": _time(k * (1_000_000_000 // m.rate)),
        }
        for k in range(len(x.q))
    ]
    header = {"stamp": _time(0), "frame_id": ""}
    return {"header": header, "joint_names": list(m.world.joints), "points": points}


def _message_definition(name: str) -> str:
    """The text of a message's definition with all that it mentions."""
    own, others = SCHEMAS[name]
    return (
        "\n".join([own, *(f"{_RULE}\nMSG: {n}\n{text}" for n, text in others)]) + "\n"
    )


def _time(ns: int) -> dict[str, int]:
    return {"sec": ns // 1_000_000_000, "nanosec": ns % 1_000_000_000}


def _xyz(x: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", x.tolist(), strict=True))
