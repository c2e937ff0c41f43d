"""World, trajectory, controller -> rollout: what physics makes of a plan.

Nothing but `mj_step` touches the simulated state; the rollout holds the command of
every step, so that plain MuJoCo arrives at the same states from the first one.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from clamber import _core
from clamber.errors import InputError
from clamber.execution.disturbance import Disturbance
from clamber.execution.events import Event, Stopped
from clamber.execution.executive import Executive
from clamber.execution.open_loop import OpenLoop
from clamber.execution.perturbed import perturbed_world, push_of
from clamber.execution.reference import STEPS
from clamber.execution.sensors import BLOCK, Sensors
from clamber.execution.servo import ControlMode, driven_world
from clamber.model.arguments import checks_types
from clamber.model.progress import Progress, silent
from clamber.model.records import short_repr
from clamber.model.shown import Viewed
from clamber.model.terrain import SceneLike, load_scene
from clamber.model.world import PHYSICS_STEP, World
from clamber.planning.records import Plan
from clamber.planning.trajectory import Trajectory

STRIDE = 10  # physics steps between two recorded states
AHEAD = 10.0  # [s] longer than planned that memory is laid by for
END = 1.0  # [s] at the end that every step of is recorded
FALLEN_TILT = float(np.radians(45.0))  # pelvis against its reference: it has fallen
FALLEN_HEIGHT = 0.20  # [m]
DEFAULT_CONTROLLER: ControlMode = "mixed"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Rollout(Viewed):
    """Result of a simulation, as measured.

    Commands are multiples of a microradian; states and forces have single precision.
    Contacts of the robot with the scene are listed after steps 0, stride, 2 stride ...
    and after every step of the last second, in the order of time.

    Attributes:
        world: The one that physics ran.
        ctrl: (N, nu) commands, one for each step.
        stride: Steps between two recorded states.
        time: (M,) [s] BEFORE steps 0, stride ...
        qpos, qvel: (M, nq), (M, nv) the state then.
        actuator_force: (M, nu) [N m]; contact_force: (M, nS, 3) [N] on each surface, in
            the world; unintended: (M,) normal force on other links [N].
        surfaces: Names of the nS surfaces.
        penetration: (M,) deepest of any contact since the state before [m].
        contact_step: (K,) step after which each contact was listed.
        contact_geoms: (K, 2) its geoms, of the robot and of the scene.
        contact_load: (K, 2) its normal and vertical force on the robot [N].
        end_speed: (n,) speed of the pelvis after each step of the last second [m/s].
        push: (N, 3) disturbance force on the pelvis, in the world [N]; None where
            there is none.
        followed: The reference as it was last adapted; None where it is the plan's.
        events: What was measured during execution, and the reaction to it.
        fell: The robot fell, which ended the run.
        rests_on: Contacts at the end, as executed, each as `surface@support`.
        plan: The plan that was executed; None for a rollout read from disk.
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
    penetration: np.ndarray
    contact_step: np.ndarray
    contact_geoms: np.ndarray
    contact_load: np.ndarray
    end_speed: np.ndarray
    push: np.ndarray | None = None
    followed: Trajectory | None = None
    events: tuple[Event, ...] = ()
    fell: bool = False
    rests_on: tuple[str, ...] = ()
    plan: Plan | None = None

    __repr__ = short_repr

    @property
    def stopped(self) -> str:
        """Why execution stopped before the end of the plan; empty where it did not."""
        return next((e.why for e in self.events if isinstance(e, Stopped)), "")


@checks_types
def simulate(
    plan: Plan,
    *,
    controller: ControlMode = DEFAULT_CONTROLLER,
    disturbance: Disturbance | None = None,
    true_scene: SceneLike | None = None,
    pause: float | None = None,
    progress: Progress | None = None,
) -> Rollout:
    """Run the trajectory of a plan in MuJoCo.

    Args:
        plan: The plan to execute.
        controller: `pid` follows the trajectory open loop, PID on every joint; `mixed`
            makes some joints compliant and reacts to contacts (`executive`).
        disturbance: How the perturbed world differs from the planned one, and how well
            it is sensed.
        true_scene: The scene that physics runs, unknown to the planner; None: the
            planned one.
        pause: Time at which the robot is told to slow down and to stand still for 10 s
            [s]; None: never. `mixed` only.
        progress: Called with stage, share and note.

    Raises:
        ValueError: The plan has no trajectory.
        InputError: A start is disturbed that is not the scene's.
    """
    if plan.trajectory is None:
        raise ValueError("the plan has no trajectory")
    d = disturbance or Disturbance()
    if plan.state is not None and (d.x, d.y, d.yaw) != (0.0, 0.0, 0.0):
        raise InputError(
            "0: the plan begins in the middle of a climb, not at the scene's start",
            field="disturb.x, y, yaw",
            value=(d.x, d.y, d.yaw),
        )
    if pause is not None and not pause >= 0.0:
        raise InputError("0 s or more", field="pause", value=pause)
    if pause is not None and controller == "pid":
        raise InputError(
            "none: pid goes on, whatever it is told", field="pause", value=pause
        )
    truth = None if true_scene is None else load_scene(true_scene)
    world = driven_world(perturbed_world(plan.world, d, truth), controller)
    share, report = 0.0, progress or silent
    if controller == "pid":
        follower = OpenLoop(plan, world)
    else:
        follower = Executive(
            plan,
            world,
            lambda _, done, note: report("simulate", share, note),
            pause=pause,
        )
    rng = np.random.default_rng([d.seed, 1])
    sensors = Sensors(world, noise=d.noise, delay=d.delay, rng=rng)
    push = push_of(d, float(plan.trajectory.time[-1]))
    model = world.model
    data = mujoco.MjData(model)
    start = world.home if plan.state is None else plan.state.q
    data.qpos[:] = start.astype(np.float32)  # as it is written down
    loop = _core.Loop(
        data,
        follower.core,
        sensors.core,
        sensors.forces,
        order=[model.actuator(j).id for j in world.joints],
        step_size=STEPS["q"],
        base=world.base,
        stride=STRIDE,
        tail=round(END / PHYSICS_STEP),
        tilt=FALLEN_TILT,
        height=FALLEN_HEIGHT,
        push=push,
        steps=len(plan.trajectory.time) + round(AHEAD / PHYSICS_STEP),
    )
    runs, step = True, loop.step
    while runs:
        k = loop.count
        share = min(k / max(len(plan.trajectory.time), k + follower.left), 1.0)
        report("simulate", share, f"{k * PHYSICS_STEP:.0f} s")
        sensors.draw()
        for _ in range(BLOCK):
            runs = step(follower)
            if not runs:
                break
            mujoco.mj_step(model, data)
    report("simulate", 1.0, "")
    if isinstance(follower, Executive):
        follower.close()
    recorded = loop.recorded()
    return Rollout(
        world=world,
        stride=STRIDE,
        time=np.arange(len(recorded["qpos"])) * STRIDE * PHYSICS_STEP,
        **recorded,
        surfaces=tuple(world.surfaces),
        push=None if push is None else _padded(push, loop.count),
        followed=follower.followed,
        events=tuple(follower.events),
        fell=loop.fell,
        rests_on=follower.rests_on,
        plan=plan,
    )


def has_fallen(q: np.ndarray, reference: np.ndarray) -> bool:
    """The pelvis has tilted or sunk far from its reference: the run need not go on."""
    return _core.has_fallen(q, reference, FALLEN_TILT, FALLEN_HEIGHT)


def _padded(x: np.ndarray, n: int) -> np.ndarray:
    """The first `n` rows, zeros where there are fewer."""
    out = np.zeros((n, *x.shape[1:]))
    out[: min(n, len(x))] = x[:n]
    return out
