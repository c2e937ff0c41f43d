"""World, trajectory, controller -> rollout -> verdict: what physics makes of a plan.

Nothing but `mj_step` touches the simulated state; the rollout holds the command of
every step, so that plain MuJoCo arrives at the same states from the first one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from clamber.contact.steps import on_feet
from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.execution.executive import Event, Execution, Tracking
from clamber.execution.perturbed import disturbed_world, push_of
from clamber.execution.sensors import Sensors
from clamber.execution.servo import ControlMode, driven_world
from clamber.model.scene import GROUND, Scene
from clamber.model.se3 import wrap, yaw_of
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.records import Plan
from clamber.planning.trajectory import Trajectory
from clamber.step.stability import STANDING_SHARE, standing_share

STRIDE = 10  # physics steps between two recorded states
SETTLE = 1.0  # [s] the end must hold this long
END_SPEED = 0.05  # [m/s] of the pelvis at the end
TILT_TOL = np.radians(20.0)  # pelvis against the plan at the end
HEIGHT_TOL = 0.08  # [m] pelvis against the plan at the end
UNINTENDED_TOL = 0.01  # share of all support on parts that are no surface
SHARE_ON_PLAN = 0.97  # of the weight, at the end, on the surfaces planned
OVERLAP_TOL = 0.010  # [m] of the robot with itself or with the scene
GOAL_TOL = 0.15  # [m] pelvis against a goal in the scene
YAW_TOL = np.radians(15.0)
FALLEN_TILT = np.radians(45.0)  # pelvis against its reference: it has fallen
FALLEN_HEIGHT = 0.20  # [m]
DEFAULT_CONTROLLER: ControlMode = "mixed"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Rollout:
    """What physics did.

    Attributes:
        ctrl: (N, nu) commands, one for each step.
        stride: Steps between two recorded states.
        time: (M,) [s]; qpos (M, nq), qvel (M, nv): the state BEFORE steps 0, stride ...
        actuator_force: (M, nu) [N m]; contact_force: (M, nS, 3) [N] on each surface, in
            the world; unintended: (M,) normal force on other parts [N].
        surfaces: Names of the nS surfaces.
        overlap: Deepest overlap of any contact [m].
        end_share: Vertical force, share of the weight, by `surface@support` over the
            last second; other parts are called `other`.
        unintended_share: Normal impulse on other parts over that on all.
        self_overlap: Deepest overlap of the robot with itself [m]; self_pair: where.
        unintended_parts: The same share by part.
        end_speed: Largest pelvis speed over the last second [m/s].
        world: The one that physics ran.
        push: (N, 3) force on the pelvis [N], in the world; None where nothing pushed.
        followed: What was last followed, where that is not the plan.
        events: What was felt on the way, and what was done about it.
        fell: The run ended at once because the robot fell.
        stopped: Why the robot stopped in a stance on the way; empty where it did not.
        rests_on: Surfaces in contact at the end, as executed, by `surface@support`.
    """

    world: World
    ctrl: np.ndarray
    stride: int
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    actuator_force: np.ndarray
    contact_force: np.ndarray
    unintended: np.ndarray
    surfaces: tuple[str, ...]
    overlap: float
    self_overlap: float
    self_pair: str
    end_share: dict[str, float]
    unintended_share: float
    unintended_parts: dict[str, float]
    end_speed: float
    push: np.ndarray | None = None
    followed: Trajectory | None = None
    events: tuple[Event, ...] = ()
    fell: bool = False
    stopped: str = ""
    rests_on: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Criterion:
    """One figure with its limit."""

    value: float
    limit: float
    ok: bool


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Verdict:
    """Whether physics got the robot there, and by which figures."""

    reached: bool
    criteria: dict[str, Criterion]


def simulate(
    plan: Plan,
    *,
    controller: ControlMode = DEFAULT_CONTROLLER,
    disturbance: Disturbance | None = None,
    truth: Scene | None = None,
    progress: Callable[[str, float, str], None] | None = None,
) -> Rollout:
    """Run the trajectory of a plan in MuJoCo.

    Args:
        plan: What to do.
        controller: `pid` follows the trajectory open loop, PID on every joint; `mixed`
            makes some joints compliant and feels its contacts (`execution`).
        disturbance: How the true world differs from the planned one, and how well it
            is sensed.
        truth: The true scene, where it is not the planned one.
        progress: Called with stage, share and note.

    Raises:
        ValueError: The plan has no trajectory.
        InputError: A start is disturbed that is not the scene's.
    """
    if plan.trajectory is None:
        raise ValueError("the plan has no trajectory")
    d = disturbance or Disturbance()
    if plan.midway is not None and (d.x, d.y, d.yaw) != (0.0, 0.0, 0.0):
        raise InputError(
            "0: the plan begins in the middle of a climb, not at the scene's start",
            field="disturb.x, y, yaw",
            value=(d.x, d.y, d.yaw),
        )
    world = driven_world(disturbed_world(plan.world, d, truth), controller)
    pilot = (Tracking if controller == "pid" else Execution)(plan, world)
    sensors = Sensors(
        world, noise=d.noise, delay=d.delay, rng=np.random.default_rng([d.seed, 1])
    )
    push = push_of(d, float(plan.trajectory.time[-1]))
    report = progress or (lambda stage, share, note: None)
    start = world.home if plan.midway is None else plan.midway.q
    planned = len(plan.trajectory.time)
    return _run(world, start, pilot, sensors, push, planned, report)


def _run(
    world: World,
    start: np.ndarray,
    pilot: Tracking | Execution,
    sensors: Sensors,
    push: np.ndarray | None,
    planned: int,
    report: Callable[[str, float, str], None],
) -> Rollout:
    model = world.model
    data = mujoco.MjData(model)
    data.qpos[:] = start
    surfaces = tuple(world.surfaces)
    meter = _ContactMeter(world, surfaces)
    ctrl, qpos, qvel, effort, force, unintended = [], [], [], [], [], []
    overlap = speed = 0.0
    tail = round(SETTLE / PHYSICS_STEP)
    order = np.array([model.actuator(j).id for j in world.joints])
    fell, k = False, 0
    while not fell:
        first = k % STRIDE == 0
        if first:
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
        row = np.zeros(model.nu)
        row[order] = pilot.command(sensors.read(data))
        ctrl.append(row)
        data.ctrl[:] = row
        if push is not None:
            data.xfrc_applied[world.base, :3] = push[k] if k < len(push) else 0.0
        mujoco.mj_step(model, data)
        end = pilot.left < tail
        if data.ncon:
            overlap = max(overlap, -float(data.contact.dist.min()))
        if end:
            speed = max(speed, float(np.linalg.norm(data.qvel[:3])))
        if first or end:
            forces, other = meter.measure(data, end=end, total=first)
            if first:
                effort.append(data.actuator_force.copy())
                force.append(forces)
                unintended.append(other)
                fell = has_fallen(data.qpos, pilot.reference)
        if k % 1000 == 0:
            share = min(k / max(planned, k + pilot.left), 1.0)
            report("simulate", share, f"{k * PHYSICS_STEP:.0f} s")
        k += 1
        if pilot.left == 0:
            break
    report("simulate", 1.0, "")
    states = np.array(qpos)
    self_overlap, pair = deepest_self_overlap(world, states)
    weight = world.mass * 9.81 * min(tail, k)
    return Rollout(
        world=world,
        ctrl=np.array(ctrl),
        stride=STRIDE,
        time=np.arange(len(states)) * STRIDE * PHYSICS_STEP,
        qpos=states,
        qvel=np.array(qvel),
        actuator_force=np.array(effort),
        contact_force=np.array(force),
        unintended=np.array(unintended),
        surfaces=surfaces,
        overlap=overlap,
        self_overlap=self_overlap,
        self_pair=pair,
        end_share={k: v / weight for k, v in sorted(meter.end.items())},
        unintended_share=float(meter.other / max(meter.total, 1e-9)),
        unintended_parts={
            k: v / max(meter.total, 1e-9) for k, v in sorted(meter.parts.items())
        },
        end_speed=speed,
        push=None if push is None else _padded(push, k),
        followed=pilot.followed,
        events=tuple(pilot.events),
        fell=fell,
        stopped=pilot.stopped,
        rests_on=pilot.rests_on,
    )


def has_fallen(q: np.ndarray, reference: np.ndarray) -> bool:
    """The pelvis has tilted or sunk far from its reference: the run need not go on."""
    tilt = np.arccos(np.clip(_up(q[3:7]) @ _up(reference[3:7]), -1.0, 1.0))
    return bool(tilt > FALLEN_TILT or q[2] < reference[2] - FALLEN_HEIGHT)


def _padded(x: np.ndarray, n: int) -> np.ndarray:
    """The first `n` rows, zeros where there are fewer."""
    out = np.zeros((n, *x.shape[1:]))
    out[: min(n, len(x))] = x[:n]
    return out


class _ContactMeter:
    """Sums contact forces by surface, straight from the solver's contacts."""

    def __init__(self, world: World, surfaces: tuple[str, ...]) -> None:
        m = world.model
        self.model = m
        self.row = np.full(m.ngeom, -1)
        for i, s in enumerate(surfaces):
            self.row[list(world.surfaces[s].geoms)] = i
        self.surfaces = surfaces
        self.support_of = world.support_of_geom
        self.env = m.body_weldid[m.geom_bodyid] == 0
        self.end: dict[str, float] = {}
        self.parts: dict[str, float] = {}
        self.total = self.other = 0.0
        self._force = np.zeros(6)

    def measure(
        self, data: mujoco.MjData, *, end: bool, total: bool
    ) -> tuple[np.ndarray, float]:
        """(nS, 3) forces on the surfaces, and that on all else; adds to sums."""
        forces, other = np.zeros((len(self.surfaces), 3)), 0.0
        for i in range(data.ncon):
            c = data.contact[i]
            a, b = int(c.geom1), int(c.geom2)
            if self.env[a] == self.env[b]:
                continue
            mujoco.mj_contactForce(self.model, data, i, self._force)
            support, geom, sign = (a, b, 1.0) if self.env[a] else (b, a, -1.0)
            world_force = sign * (self._force[:3] @ c.frame.reshape(3, 3))
            row = self.row[geom]
            if row >= 0:
                forces[row] += world_force
            else:
                other += self._force[0]
            if total:
                self.total += self._force[0]
                if row < 0:
                    self.other += self._force[0]
                    part = self.model.geom(geom).name
                    self.parts[part] = self.parts.get(part, 0.0) + self._force[0]
            if end:
                name = self.surfaces[row] if row >= 0 else "other"
                key = f"{name}@{self.support_of[support]}"
                self.end[key] = self.end.get(key, 0.0) + float(world_force[2])
        return forces, other


def deepest_self_overlap(
    world: World, qpos: np.ndarray, every: int = 5
) -> tuple[float, str]:
    """Deepest overlap of the robot with itself in states (M, nq) [m], and where."""
    from clamber.model.kinematics import Kinematics

    kin = Kinematics(world)
    env = world.model.body_weldid[world.model.geom_bodyid] == 0
    own = ~env[world.pairs].any(axis=1)
    worst, pair = 0.0, ""
    for q in qpos[::every]:
        kin.update(q)
        near = kin.proximity(0.0, own)
        if len(near.distance) and -near.distance.min() > worst:
            i = int(np.argmin(near.distance))
            worst = -float(near.distance[i])
            pair = " and ".join(
                world.model.geom(int(g)).name for g in world.pairs[near.pairs[i]]
            )
    return worst, pair


def judge(plan: Plan, rollout: Rollout) -> Verdict:
    """Did the robot end where the plan says, on what it planned to rest on?"""
    assert plan.trajectory is not None
    world = plan.world
    followed = rollout.followed or plan.trajectory
    planned, last = followed.q[-1], rollout.qpos[-1]
    final = plan.keyframes[-1].stance
    on_plan = sum(rollout.end_share.get(key, 0.0) for key in rollout.rests_on)
    on_ground = sum(v for k, v in rollout.end_share.items() if k.endswith("@" + GROUND))
    on_boxes = sum(rollout.end_share.values()) - on_ground
    up, up_planned = (_up(q[3:7]) for q in (last, planned))
    tilt = float(np.arccos(np.clip(up @ up_planned, -1.0, 1.0)))
    supports = rollout.world.supports
    over = [
        supports[c.support].height(last[:3]) for c in final if c.support in supports
    ]
    order = [world.model.actuator(j).id for j in world.joints]
    share = np.abs(rollout.actuator_force[:, order]) / rollout.world.tau_max
    effort = float(share.max(initial=0.0))
    goal = {
        "did not fall": _at_least(float(not rollout.fell), 1.0),
        "did not stop on the way": _at_least(float(not rollout.stopped), 1.0),
        "planned to the last stance": _at_least(float(plan.complete), 1.0),
        "share of the weight at the end on planned contacts": _at_least(
            on_plan, SHARE_ON_PLAN
        ),
        "pelvis speed at the end [m/s]": _at_most(rollout.end_speed, END_SPEED),
        "pelvis tilt at the end against the plan [rad]": _at_most(
            tilt, float(TILT_TOL)
        ),
        "pelvis height at the end against the plan [m]": _at_most(
            float(abs(last[2] - planned[2])), HEIGHT_TOL
        ),
        "share of support on parts that are no surface": _at_most(
            rollout.unintended_share, UNINTENDED_TOL
        ),
        "deepest overlap with the scene [m]": _at_most(rollout.overlap, OVERLAP_TOL),
        "deepest overlap with itself [m]": _at_most(rollout.self_overlap, OVERLAP_TOL),
        "largest effort, share of the limit": _at_most(effort, 1.0 + 1e-6),
    }
    if on_feet(world, final):
        goal["pelvis over its feet at the end, share of its first height"] = _at_least(
            standing_share(rollout.world, final, last), STANDING_SHARE
        )
    if world.scene.goal is None:
        goal["share of the weight at the end on obstacles"] = _at_least(on_boxes, 0.98)
        goal["pelvis above its support at the end [m]"] = _at_least(
            float(min(over, default=last[2])), 0.05
        )
    else:
        xy = world.scene.goal[:2]
        goal["pelvis to the goal [m]"] = _at_most(
            float(np.linalg.norm(last[:2] - xy)), GOAL_TOL
        )
        if len(world.scene.goal) == 3:
            off = float(abs(wrap(yaw_of(last[3:7]) - world.scene.goal[2])))
            goal["yaw to the goal [rad]"] = _at_most(off, float(YAW_TOL))
    return Verdict(reached=all(c.ok for c in goal.values()), criteria=goal)


def _up(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def _at_most(value: float, limit: float) -> Criterion:
    return Criterion(value=value, limit=limit, ok=bool(value <= limit))


def _at_least(value: float, limit: float) -> Criterion:
    return Criterion(value=value, limit=limit, ok=bool(value >= limit))
