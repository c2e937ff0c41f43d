"""Time of one inverse-kinematics iteration, here and in placo, mink and Pink.

    python benchmarks/bench_ik.py

COMAN stands on both feet (two 6D constraints) while its hands go to two points (two 3D
tasks) and its centre of mass to the middle of its feet, close to a posture, within
joint and step limits. From the same postures, each library takes one full step, called
from Python: kinematics, rows, QP (DAQP; in placo qpmad) and integration. With pairs, a
row for each that is nearer than 0.10 m; mink alone takes the same pairs.

"In a solve" is what planning is made of: the time of whole solves in the core by their
iterations, trials that are taken back and the look at what was found included. Then two
tests of a posture, from q: the margin of the centre of mass (kinematics, points that
bear, their polygon, the distance to its border), and whether contact forces hold it.

Not the same in all: here contacts weigh 1e6 in the cost, elsewhere they are equalities.
placo needs pinocchio 3.8 and a NumPy older than the one pinned here. It is therefore no
part of `clamber[compare]`: `pip install placo` into an environment of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from clamber.contact.contact import Contact
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import World, build_world
from clamber.step.ik import (
    IK,
    STEP_ROTATION,
    STEP_TRANSLATION,
    PostureProblem,
    contact_clearance,
)
from clamber.step.tasks import Closed, Reaching, packed_contacts

POSTURES = 300
REPEATS = 20  # iterations from home, to see that all solve the same problem
HANDS = {"LHand": np.array([0.38, 0.20, 0.33]), "RHand": np.array([0.38, -0.20, 0.33])}
FEET = ("LFoot", "RFoot")
HAND, COM, POSTURE = 2.0, 0.3, 0.08  # weights
MARGIN = 0.01  # [m] between links, and between links and the scene
RANGE = 0.10  # [m] nearer pairs have a row, in all that have them

Step = Callable[[np.ndarray], np.ndarray]
UP = np.array([0.0, 0.0, 1.0])


def feet_middle(world: World) -> np.ndarray:
    """(3,) the middle of the soles, at the height of the centre of mass at home."""
    ik = IK(world)
    ik.kin.update(world.home)
    corners = np.concatenate([ik.kin.bearing_points(f, UP) for f in FEET])
    return np.array([*corners[:, :2].mean(axis=0), ik.kin.com[2]])


def contact_at(surface: str, p: np.ndarray) -> Contact:
    """Of a surface with the ground at `p` (3,)."""
    return Contact(
        surface=surface, support="ground", position=p, quaternion=np.eye(4)[0]
    )


def problem_of(ik: IK, *, collisions: bool) -> PostureProblem:
    """What all are asked for."""
    world = ik.world
    ik.kin.update(world.home)
    tasks = []
    for f in FEET:
        p = ik.kin.contact_point(f, UP)
        tasks.append(Closed(contact=contact_at(f, p), rotation=np.eye(3)))
    for hand, p in HANDS.items():
        # A surface's goal is where it would touch: a ball's lowest point.
        low = p - UP * world.surfaces[hand].radius
        at = contact_at(hand, low)
        tasks.append(Reaching(contact=at, rotation=np.eye(3), weight=HAND))
    clearance = np.full(len(world.pairs), -np.inf)
    if collisions:
        where = dict.fromkeys(FEET, "ground")
        clearance = contact_clearance(world, MARGIN, where)
    return PostureProblem(
        tasks=tuple(tasks),
        q_reference=world.home,
        clearance=clearance,
        balance=False,  # the others have no such rows
        com_target=feet_middle(world)[:2],
        com_weight=COM,
        posture_weight=POSTURE,
        base_weight=0.0,
    )


def clamber_step(world: World, *, collisions: bool) -> Step:
    ik = IK(world)
    problem = problem_of(ik, collisions=collisions)

    def step(q: np.ndarray) -> np.ndarray:
        return ik.kin.integrate(q, ik.step(problem, q))

    return step


def in_a_solve(world: World, inputs: list[np.ndarray], *, collisions: bool) -> float:
    """Median time of an iteration of a whole solve [us]."""
    ik, took = IK(world), []
    problem = problem_of(ik, collisions=collisions)
    for q in inputs:
        start = time.perf_counter()
        found = ik.solve(problem, q)
        took.append((time.perf_counter() - start) / found.iterations)
    return 1e6 * float(np.median(took))


def verdicts(world: World) -> dict[str, Callable[[np.ndarray], object]]:
    """Of a posture on both feet: margin of the centre of mass, forces."""
    ik = IK(world)
    problem = problem_of(ik, collisions=False)
    feet = [t.contact for t in problem.tasks if t.contact.surface in FEET]
    packed = packed_contacts(world, feet)
    return {
        "com_margin from q": lambda q: ik.residuals(problem, q).com_margin,
        "forces hold it, from q": lambda q: ik.core.is_stable(*packed, q),
    }


def mink_step(world: World, *, collisions: bool) -> Step:
    import mink

    m = world.model
    configuration = mink.Configuration(m, world.home)
    feet = []
    for f in FEET:
        task = mink.FrameTask(f, "body", position_cost=1.0, orientation_cost=1.0)
        task.set_target_from_configuration(configuration)
        feet.append(task)
    tasks: list = []
    for hand, p in HANDS.items():
        task = mink.FrameTask(hand, "geom", position_cost=HAND, orientation_cost=0.0)
        task.set_target(mink.SE3.from_translation(p))
        tasks.append(task)
    com = mink.ComTask(cost=[COM, COM, 0.0])
    com.set_target(feet_middle(world))
    posture = mink.PostureTask(m, cost=[0.0] * 6 + [POSTURE] * len(world.joints))
    posture.set_target(world.home)
    tasks += [com, posture]
    limits: list = [
        mink.ConfigurationLimit(m, gain=1.0),
        mink.VelocityLimit(m, dict.fromkeys(world.joints, STEP_ROTATION)),
    ]
    if collisions:
        feet_on_ground = {frozenset((f, "ground")) for f in FEET}
        pairs = [
            ([m.geom(a).name], [m.geom(b).name])
            for a, b in world.pairs.tolist()
            if frozenset((m.geom(a).name, m.geom(b).name)) not in feet_on_ground
        ]
        limits.append(
            mink.CollisionAvoidanceLimit(
                m,
                pairs,
                gain=1.0,
                minimum_distance_from_collisions=MARGIN,
                collision_detection_distance=RANGE,
            )
        )

    def step(q: np.ndarray) -> np.ndarray:
        configuration.update(q)
        try:
            v = mink.solve_ik(
                configuration,
                tasks,
                1.0,
                solver="daqp",
                damping=2e-4,
                limits=limits,
                constraints=feet,
            )
        except mink.exceptions.NoSolutionFound:
            return q
        return configuration.integrate(v, 1.0)

    return step


def between_orders(
    world: World, order: list[int], nq: int
) -> tuple[Step, Callable[[np.ndarray], np.ndarray]]:
    """To pinocchio's order of q and back: quaternions xyzw, joints at `order`."""

    def there(q: np.ndarray) -> np.ndarray:
        out = np.zeros(nq)
        out[:3], out[3:6], out[6] = q[:3], q[4:7], q[3]
        out[order] = q[world.qadr]
        return out

    def back(x: np.ndarray) -> np.ndarray:
        out = np.empty(len(x))
        out[:3], out[4:7], out[3] = x[:3], x[3:6], x[6]
        out[world.qadr] = x[order]
        return out

    return there, back


def urdf_of(world: World) -> str:
    """The robot's links, hinges and hands, as pinocchio reads them."""
    m, out = world.model, ['<robot name="robot">']

    def origin(p: np.ndarray, quat: np.ndarray) -> str:
        rpy = Rotation.from_quat(quat, scalar_first=True).as_euler("xyz")
        return f'<origin xyz="{p[0]} {p[1]} {p[2]}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/>'

    for b in range(world.base, m.nbody):
        body, name = m.body(b), m.body(b).name
        x, y, z = body.inertia
        out.append(
            f'<link name="{name}"><inertial>{origin(body.ipos, body.iquat)}'
            f'<mass value="{body.mass[0]}"/><inertia ixx="{x}" ixy="0" ixz="0"'
            f' iyy="{y}" iyz="0" izz="{z}"/></inertial></link>'
        )
        if b == world.base:
            continue
        hinge = m.joint(int(body.jntadr[0]))
        (low, high), (ax, ay, az) = hinge.range, hinge.axis
        out.append(
            f'<joint name="{hinge.name}" type="revolute">'
            f'<parent link="{m.body(int(body.parentid[0])).name}"/>'
            f'<child link="{name}"/>{origin(body.pos, body.quat)}'
            f'<axis xyz="{ax} {ay} {az}"/><limit lower="{low}" upper="{high}"'
            f' velocity="{STEP_ROTATION}" effort="50"/></joint>'
        )
    for hand in HANDS:
        s = world.surfaces[hand]
        out.append(
            f'<link name="{hand}"/><joint name="to_{hand}" type="fixed">'
            f'<parent link="{m.body(s.body).name}"/><child link="{hand}"/>'
            f"{origin(s.centre, np.eye(4)[0])}</joint>"
        )
    return "".join([*out, "</robot>"])


def pink_step(world: World) -> Step:
    import pink
    import pinocchio as pin
    from pink.limits import ConfigurationLimit, VelocityLimit

    model = pin.buildModelFromXML(urdf_of(world), pin.JointModelFreeFlyer())
    base = slice(0, 7)
    model.lowerPositionLimit[base], model.upperPositionLimit[base] = -np.inf, np.inf
    speed = np.full(model.nv, STEP_ROTATION)
    speed[:3] = STEP_TRANSLATION
    model.velocityLimit = speed
    order = [model.joints[model.getJointId(j)].idx_q for j in world.joints]
    to_pin, from_pin = between_orders(world, order, model.nq)
    configuration = pink.Configuration(model, model.createData(), to_pin(world.home))
    feet = []
    for f in FEET:
        task = pink.FrameTask(f, position_cost=1.0, orientation_cost=1.0)
        task.set_target_from_configuration(configuration)
        feet.append(task)
    tasks: list = []
    for hand, p in HANDS.items():
        task = pink.FrameTask(hand, position_cost=HAND, orientation_cost=0.0)
        task.set_target(pin.SE3(np.eye(3), p))
        tasks.append(task)
    com = pink.tasks.ComTask(cost=[COM, COM, 0.0])
    com.set_target(feet_middle(world))
    posture = pink.PostureTask(cost=POSTURE)
    posture.set_target(to_pin(world.home))
    tasks += [com, posture]
    limits = [ConfigurationLimit(model, config_limit_gain=1.0), VelocityLimit(model)]

    def step(q: np.ndarray) -> np.ndarray:
        configuration.update(to_pin(q))
        v = pink.solve_ik(
            configuration,
            tasks,
            1.0,
            solver="daqp",
            damping=2e-4,
            limits=limits,
            constraints=feet,
            safety_break=False,
        )
        return from_pin(configuration.integrate(v, 1.0))

    return step


def placo_step(world: World) -> Step:
    import placo

    robot = placo.RobotWrapper("", placo.Flags.ignore_collisions, urdf_of(world))
    order = [robot.get_joint_offset(j) for j in world.joints]
    to_placo, from_placo = between_orders(world, order, len(robot.state.q))
    robot.state.q = to_placo(world.home)
    robot.update_kinematics()
    solver = placo.KinematicsSolver(robot)
    solver.dt = 1.0
    solver.enable_joint_limits(True)
    solver.enable_velocity_limits(True)
    for f in FEET:
        foot = solver.add_frame_task(f, robot.get_T_world_frame(f))
        foot.configure(f, "hard", 1.0, 1.0)
    for hand, p in HANDS.items():
        solver.add_position_task(hand, p).configure(hand, "soft", HAND**2)
    com = solver.add_com_task(feet_middle(world))
    com.mask.set_axises("xy", "task")
    com.configure("com", "soft", COM**2)
    posture = solver.add_joints_task()
    home = dict(zip(world.joints, world.home[world.qadr].tolist(), strict=True))
    posture.set_joints(home)
    posture.configure("posture", "soft", POSTURE**2)
    solver.add_regularization_task(2e-4)

    def step(q: np.ndarray) -> np.ndarray:
        robot.state.q = to_placo(q)
        robot.update_kinematics()
        solver.solve(True)
        return from_placo(robot.state.q)

    return step


def postures(world: World, rng: np.random.Generator) -> list[np.ndarray]:
    """Around home, within the limits."""
    out = []
    for _ in range(POSTURES):
        q = world.home.copy()
        q[:3] += rng.uniform(-0.02, 0.02, 3)
        q[world.qadr] += rng.uniform(-0.1, 0.1, len(world.qadr))
        q[world.qadr] = q[world.qadr].clip(
            world.q_min[world.dadr] + 1e-3, world.q_max[world.dadr] - 1e-3
        )
        out.append(q)
    return out


def median_us(step: Step, inputs: list[np.ndarray]) -> tuple[float, int]:
    """Median time of a step, and from how many postures there was none."""
    took, failed = [], 0
    for q in inputs:
        start = time.perf_counter()
        after = step(q)
        took.append(time.perf_counter() - start)
        failed += np.array_equal(after, q)
    return 1e6 * float(np.median(took)), failed


def open_by(world: World, step: Step) -> tuple[float, float]:
    """Error of the hands and drift of the feet after some iterations from home [mm]."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = q = world.home
    mujoco.mj_kinematics(world.model, data)
    before = {f: data.body(f).xpos.copy() for f in FEET}
    for _ in range(REPEATS):
        q = step(q)
    data.qpos[:] = q
    mujoco.mj_kinematics(world.model, data)
    hands = max(np.linalg.norm(data.geom(h).xpos - p) for h, p in HANDS.items())
    feet = max(np.linalg.norm(data.body(f).xpos - p) for f, p in before.items())
    return 1e3 * float(hands), 1e3 * float(feet)


def main() -> None:
    world = build_world(load_robot("coman"), Scene.from_height(0.275))
    inputs, pairs = postures(world, np.random.default_rng(0)), len(world.pairs)
    rows: list[tuple[str, Callable[[], Step]]] = [
        ("clamber", lambda: clamber_step(world, collisions=False)),
        ("placo", lambda: placo_step(world)),
        ("mink", lambda: mink_step(world, collisions=False)),
        ("Pink", lambda: pink_step(world)),
        (f"clamber, {pairs} pairs", lambda: clamber_step(world, collisions=True)),
        (f"mink, {pairs} pairs", lambda: mink_step(world, collisions=True)),
    ]
    print(f"{POSTURES} postures; after {REPEATS} iterations from home: hands, feet")
    print(f"{'':28}{'median':>10}{'ratio':>8}{'hands':>11}{'feet':>11}")
    ours = 0.0
    for name, make in rows:
        try:
            step = make()
        except ImportError:
            print(f"{name:28}   not installed")
            continue
        median_us(step, inputs[:20])
        us, failed = median_us(step, inputs)
        ours = us if name.startswith("clamber") else ours
        hands, feet = open_by(world, step)
        print(
            f"{name:28}{us:7.1f} us{us / ours:7.1f}x{hands:8.2f} mm{feet:8.3f} mm"
            f"{f'   {failed} without a step' if failed else ''}"
        )
    for what, collisions in (("no pairs", False), (f"{pairs} pairs", True)):
        us = in_a_solve(world, inputs, collisions=collisions)
        print(f"{f'in a solve, {what}':28}{us:7.1f} us")
    for name, job in verdicts(world).items():
        took = []
        for q in inputs:
            start = time.perf_counter()
            job(q)
            took.append(time.perf_counter() - start)
        print(f"{name:28}{1e6 * float(np.median(took)):7.1f} us")


if __name__ == "__main__":
    main()
