"""Every row of the QP against finite differences; what is solved against MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.robot import load_robot
from clamber.model.scene import Box, Scene
from clamber.model.se3 import (
    frame_from_normal,
    matrix_from_rpy,
    quat_from_matrix,
    rotation_vector,
)
from clamber.model.world import World, build_world
from clamber.step.ik import (
    ARMS_FROM_LEGS,
    DAMPING,
    IK,
    PENALTY,
    STEP_ROTATION,
    STEP_TRANSLATION,
    PostureProblem,
    contact_clearance,
)
from clamber.step.polygon import support_ellipse, support_polygon
from clamber.step.tasks import (
    EDGE_INSET,
    EDGE_ROOM,
    EDGE_WEIGHT,
    ROUGHNESS_WEIGHT,
    Closed,
    OnEdge,
    Reaching,
    Sliding,
    SurfaceTask,
)

UP = np.array([0.0, 0.0, 1.0])
BALLS = ("LHand", "RElbow", "LKnee")
SUPPORTS = ("ground", "yawed", "tilted")
STEP = 1e-6
IN_PLACE = np.eye(3)


@pytest.fixture(scope="module")
def world() -> World:
    boxes = tuple(
        Box(
            name=name,
            size=np.array([0.8, 1.0, 0.3]),
            centre=np.array([x, 0.1, 0.1]),
            rotation=matrix_from_rpy(rpy),
        )
        for name, x, rpy in (
            ("yawed", 0.75, (0, 0, 0.5)),
            ("tilted", -1.0, (0.2, -0.3, 1)),
        )
    )
    return build_world(load_robot("coman"), Scene(boxes=boxes, start=np.zeros(3)))


@pytest.fixture(scope="module")
def ik(world) -> IK:
    return IK(world)


@pytest.fixture(scope="module")
def plain() -> IK:
    """The robot before the plain box of 0.275 m."""
    return IK(build_world(load_robot("coman"), Scene.from_height(0.275)))


def bent(world: World, seed: int) -> np.ndarray:
    """(nq,) around home, leaning and with all joints moved."""
    rng = np.random.default_rng(seed)
    q = world.home.copy()
    q[:3] += rng.uniform(-0.05, 0.05, 3)
    q[3:7] = quat_from_matrix(matrix_from_rpy(rng.uniform(-0.4, 0.4, 3)))
    q[world.qadr] += rng.uniform(-0.3, 0.3, len(world.qadr))
    dof = world.dadr
    q[world.qadr] = np.clip(q[world.qadr], world.q_min[dof], world.q_max[dof])
    return q


def task_at(
    ik: IK, q: np.ndarray, surface: str, support: str, kind=Closed, **more
) -> SurfaceTask:
    """A task that is met where the surface is at `q`; `more` of it or its contact."""
    kin, w = ik.kin, ik.world
    kin.update(q)
    s = w.surfaces[surface]
    R = kin.rotation(s.body) @ (s.rotation if s.rotation is not None else np.eye(3))
    edge, link = more.pop("edge", None), more.pop("link", None)
    if link is not None:
        link = quat_from_matrix(kin.rotation(s.body))
    contact = Contact(
        surface=surface,
        support=support,
        position=kin.contact_point(surface, w.supports[support].normal, edge),
        quaternion=quat_from_matrix(R),
        edge=edge,
        link=link,
    )
    kind = kind if edge is None else OnEdge
    return kind(contact=contact, rotation=R, **more)


def moved(task: SurfaceTask, by=(0.0, 0.0, 0.0), turn=IN_PLACE) -> SurfaceTask:
    """The same task elsewhere."""
    contact = replace(task.contact, position=task.contact.position + by)
    return replace(task, contact=contact, rotation=turn @ task.rotation)


def problem_of(world: World, *tasks: SurfaceTask, **changes) -> PostureProblem:
    """Only these tasks: nothing else pulls, and nothing can collide."""
    nothing = {
        "clearance": np.full(len(world.pairs), -np.inf),
        "q_reference": world.home,
        "balance": False,
        "posture_weight": 0.0,
        "com_weight": 0.0,
        "base_weight": 0.0,
    }
    return PostureProblem(tasks=tasks, **(nothing | changes))


def hard_rows(qp, nv: int) -> tuple[np.ndarray, np.ndarray]:
    return qp.C, qp.e


def soft_limits(qp, nv: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return qp.A, qp.lo[nv:], qp.hi[nv:]


def slope(ik: IK, q: np.ndarray, v: np.ndarray, f, step: float = STEP) -> np.ndarray:
    """Derivative of f along the tangent vector v."""
    kin = ik.kin
    high, low = f(kin.integrate(q, step * v)), f(kin.integrate(q, -step * v))
    return (np.array(high) - np.array(low)) / (2 * step)


def jacobian(ik: IK, q: np.ndarray, f, step: float = STEP) -> np.ndarray:
    return np.stack(
        [slope(ik, q, e, f, step) for e in np.eye(ik.world.model.nv)], axis=-1
    )


def random_in_contact(ik: IK, problem, q, rng) -> np.ndarray:
    """A random tangent vector that keeps all contacts closed."""
    A, _ = hard_rows(ik.build(problem, q), ik.world.model.nv)
    v = rng.normal(size=ik.world.model.nv)
    return v - np.linalg.pinv(A) @ (A @ v) if len(A) else v


# Hard rows: J dq = e with J = -de/dq.

HELD = [
    *[(s, p, {}) for s in BALLS for p in SUPPORTS],
    *[(s, p, {"link": True}) for s in BALLS for p in SUPPORTS],
    *[("LFoot", p, {}) for p in SUPPORTS],
    *[("RFoot", p, {"edge": e}) for e in range(4) for p in ("ground", "tilted")],
    *[("LKnee", p, {"kind": Sliding}) for p in SUPPORTS],
    *[("RFoot", p, {"kind": Sliding}) for p in SUPPORTS],
]
ROWS = {"edge": 5, "flat": 6, "ball": 3, "free flat": 3, "free ball": 1}


@pytest.mark.parametrize(("surface", "support", "kind"), HELD, ids=str)
def test_rows_of_a_contact_are_the_derivative_of_its_error(ik, surface, support, kind):
    w = ik.world
    q = bent(w, 1)
    goal = task_at(ik, q, surface, support, **kind)
    problem = problem_of(w, goal)
    nv = w.model.nv
    J, e = hard_rows(ik.build(problem, q), nv)
    name = "flat" if w.surfaces[surface].is_flat else "ball"
    if "kind" in kind:
        name = "free " + name
    assert len(J) == ROWS["edge" if "edge" in kind else name]
    if "kind" not in kind:
        np.testing.assert_allclose(e, 0.0, atol=1e-7)  # the contact is closed
    numeric = jacobian(ik, q, lambda x: -hard_rows(ik.build(problem, x), nv)[1])
    np.testing.assert_allclose(J, numeric, atol=2e-7)
    assert np.linalg.matrix_rank(J) == len(J)


@pytest.mark.parametrize("surface", ["LHand", "LFoot"])
def test_an_open_contact_asks_for_the_step_that_closes_it(ik, surface):
    """J dq = e asks for p + J dq = target: the sign of e is that of the gap."""
    q = bent(ik.world, 2)
    goal = task_at(ik, q, surface, "ground")
    gap = np.array([0.03, -0.02, 0.04])
    problem = problem_of(ik.world, moved(goal, gap))
    J, e = hard_rows(ik.build(problem, q), ik.world.model.nv)
    np.testing.assert_allclose(e[:3], gap, atol=1e-12)
    ik.kin.update(q)
    s = ik.world.surfaces[surface]
    n = ik.world.supports["ground"].normal
    p = ik.kin.contact_point(surface, n)
    centre = p + s.radius * n
    np.testing.assert_allclose(J[:3], ik.kin.point_jacobian(s.body, centre), atol=1e-12)


def test_a_flat_contact_asks_for_the_turn_that_lays_it_flat(ik):
    q = bent(ik.world, 3)
    goal = task_at(ik, q, "LFoot", "ground")
    turn = np.array([0.02, -0.01, 0.03])
    R = Rotation.from_rotvec(turn).as_matrix()
    problem = problem_of(ik.world, moved(goal, turn=R))
    _, e = hard_rows(ik.build(problem, q), ik.world.model.nv)
    np.testing.assert_allclose(e[3:], turn, atol=1e-9)


def test_a_rolling_contact_follows_its_link_along_a_finite_turn(ik):
    """Turned about one axis by much, the rows still predict how the error goes on."""
    w = ik.world
    q = w.home.copy()
    goal = task_at(ik, q, "LKnee", "ground", link=True)
    problem = problem_of(w, goal)
    v = np.zeros(w.model.nv)
    v[[0, 4]] = 0.3, 0.8  # forwards, and the pelvis about its own y
    nv = w.model.nv
    later = ik.kin.integrate(q, v)
    J, _ = hard_rows(ik.build(problem, later), nv)
    numeric = slope(ik, later, v, lambda x: -hard_rows(ik.build(problem, x), nv)[1])
    np.testing.assert_allclose(J @ v, numeric, atol=1e-7)


def test_a_wheel_that_rolls_keeps_its_contact_closed(ik):
    """The ball moves r theta while it turns by theta: no error at any angle."""
    w = ik.world
    ik.kin.update(w.home)
    s = w.surfaces["LKnee"]
    goal = task_at(ik, w.home, "LKnee", "ground", link=True)
    centre = ik.kin.point(s.body, s.centre).copy()
    for theta in (-1.0, 0.3, 1.4):
        R = Rotation.from_rotvec([0.0, theta, 0.0])
        q = w.home.copy()
        turned = R * Rotation.from_quat(w.home[3:7], scalar_first=True)
        q[3:7] = turned.as_quat(scalar_first=True)
        rolled = centre + np.array([s.radius * theta, 0.0, 0.0])
        q[:3] = rolled + R.apply(w.home[:3] - centre)
        residuals = ik.residuals(problem_of(w, goal), q)
        assert residuals.contact == pytest.approx(0.0, abs=1e-9)
        held = replace(
            goal, contact=replace(goal.contact, link=None)
        )  # rolls not: open
        open_by = ik.residuals(problem_of(w, held), q).contact
        assert open_by == pytest.approx(s.radius * abs(theta), abs=1e-9)


# Soft tasks: c is the gradient of the cost, H its curvature where the task is met.


def soft_problems(ik: IK, q: np.ndarray, off: float) -> dict[str, PostureProblem]:
    """One task each; its error at `q` is of the size of `off` [m, rad]."""
    w, kin = ik.world, ik.kin
    turn = Rotation.from_rotvec(off * np.array([0.6, -0.5, 0.62])).as_matrix()
    shift = off * np.array([0.5, -0.7, 0.5])

    def off_by(task: SurfaceTask) -> SurfaceTask:
        return moved(task, shift, turn)

    problems = {
        "target of a ball": problem_of(
            w, off_by(task_at(ik, q, "LHand", "ground", Reaching, weight=2.0))
        ),
        "target of a foot": problem_of(
            w, off_by(task_at(ik, q, "RFoot", "ground", Reaching, weight=3.0))
        ),
        "pelvis": problem_of(w, base_weight=0.4),
        "posture": problem_of(w, posture_weight=0.3, q_reference=q.copy()),
    }
    knee = task_at(ik, q, "LKnee", "tilted", Sliding, reference=1.5)
    problems["reference of a free contact"] = problem_of(w, off_by(knee))
    kin.update(q)
    R_WB = turn @ kin.rotation(w.base)
    problems["pelvis"] = replace(problems["pelvis"], base_rotation=R_WB)
    reference = q.copy()
    reference[w.qadr] += off * np.linspace(-1.0, 1.0, len(w.qadr))
    problems["posture"] = replace(problems["posture"], q_reference=reference)

    def unit(a: str, b: str) -> np.ndarray:
        d = kin.landmark(b)[1] - kin.landmark(a)[1]
        return turn @ d / np.linalg.norm(d)

    limbs = w.robot.limbs
    for name, limb, a, b in (
        ("left_upper_arm", "left_arm", "root", "middle"),
        ("right_forearm", "right_arm", "middle", "end"),
        ("right_thigh", "right_leg", "root", "middle"),
        ("left_shank", "left_leg", "middle", "end"),
    ):
        u = unit(getattr(limbs[limb], a), getattr(limbs[limb], b))
        problems[name] = problem_of(w, directions={name: u}, direction_weight=0.5)
    middle = {
        n: 0.5
        * (
            kin.landmark(limbs[f"left_{n}"].root)[1]
            + kin.landmark(limbs[f"right_{n}"].root)[1]
        )
        for n in ("arm", "leg")
    }
    trunk = middle["arm"] - middle["leg"]
    u = turn @ trunk / np.linalg.norm(trunk)
    problems["trunk"] = problem_of(w, directions={"trunk": u}, direction_weight=0.5)
    s = w.surfaces["RHand"]
    arm = kin.landmark(limbs["right_arm"].root)[1] - kin.point(s.body, s.centre)
    lean = turn @ arm / np.linalg.norm(arm)
    problems["lean"] = problem_of(w, lean=("RHand", lean, 0.7))
    return problems


SOFT_TASKS = (
    "target of a ball",
    "target of a foot",
    "reference of a free contact",
    "pelvis",
    "posture",
    "left_upper_arm",
    "right_forearm",
    "right_thigh",
    "left_shank",
    "trunk",
    "lean",
)
# Rotation errors and lengths that are frozen while a step is taken leave second-order
# terms: the gradient of the cost may be off by this share of the error.
TOLERANCE = {
    "target of a ball": 1e-6,
    "posture": 1e-6,
    "reference of a free contact": 1e-4,
}


def posture_for(ik: IK, task: str) -> np.ndarray:
    """A bent posture; a free contact touches its support, else the merit counts it."""
    q = bent(ik.world, 4)
    if task == "reference of a free contact":
        ik.kin.update(q)
        s = ik.world.supports["tilted"]
        q[:3] += s.position - ik.kin.contact_point("LKnee", s.normal)
    return q


@pytest.mark.parametrize("task", SOFT_TASKS)
def test_the_linear_term_is_the_gradient_of_the_cost(ik, task):
    off = 0.02
    q = posture_for(ik, task)
    problem = soft_problems(ik, q, off)[task]
    qp = ik.build(problem, q)
    numeric = jacobian(ik, q, lambda x: ik.build(problem, x).merit, 1e-5)
    size = np.abs(numeric).max()
    assert size > 1e-5
    tolerance = TOLERANCE.get(task, 1.5 * off)
    np.testing.assert_allclose(qp.c, numeric, atol=tolerance * size)


@pytest.mark.parametrize("task", SOFT_TASKS)
def test_the_quadratic_term_is_the_curvature_where_the_task_is_met(ik, task, rng):
    w, h = ik.world, 1e-5
    q = posture_for(ik, task)
    problem = soft_problems(ik, q, 0.0)[task]
    qp = ik.build(problem, q)
    assert qp.merit == pytest.approx(0.0, abs=1e-12)
    for _ in range(5):
        v = random_in_contact(ik, problem, q, rng)
        if task == "trunk":
            v[6:9] = 0.0  # the waist changes the trunk's length, which is held still
        if task == "lean":
            v[9:] = 0.0  # so do the arm's joints; the base turns it as a whole
        ends = [
            ik.build(problem, ik.kin.integrate(q, s * h * v)).merit for s in (1, -1)
        ]
        curvature = sum(ends) / h**2
        expected = v @ (qp.H - DAMPING * np.eye(w.model.nv)) @ v
        assert expected == pytest.approx(curvature, rel=2e-3)
        assert curvature > 0


def test_the_reference_of_a_free_contact_acts_within_its_plane(ik):
    """Off the support by any height, only the shift along it is drawn back."""
    w = ik.world
    q = posture_for(ik, "reference of a free contact")
    support = w.supports["tilted"]
    n = support.normal
    goal = task_at(ik, q, "LKnee", "tilted", Sliding, reference=2.0)
    above = moved(goal, 0.3 * n)
    qp = ik.build(problem_of(w, above), q)
    np.testing.assert_allclose(qp.c, 0.0, atol=1e-9)
    beside = moved(goal, 0.1 * support.rotation[:, 1])
    qp = ik.build(problem_of(w, beside), q)
    expected = -4.0 * 0.1 * support.rotation[:, 1]  # towards it: the base's own motion
    np.testing.assert_allclose(qp.c[:3], expected, atol=1e-9)


def test_a_surface_on_its_edge_would_rather_lie_flat(ik):
    """About its own edge it may turn, softly drawn back: 1/2 (0.3 turn)^2."""
    w, q = ik.world, ik.world.home
    goal = task_at(ik, q, "LFoot", "ground", edge=1)
    s = w.surface("LFoot", 1)
    ik.kin.update(q)
    axis = ik.kin.rotation(s.body) @ (s.corners[1] - s.corners[0])
    axis /= np.linalg.norm(axis)
    turned = Rotation.from_rotvec(0.2 * axis).as_matrix()
    problem = problem_of(w, moved(goal, turn=turned))
    qp = ik.build(problem, q)
    _, e = hard_rows(qp, w.model.nv)
    np.testing.assert_allclose(e, 0.0, atol=1e-7)  # the turn is no violation
    assert qp.merit == pytest.approx(0.5 * (0.3 * 0.2) ** 2)
    _, rot = ik.kin.jacobians(s.body, goal.contact.position)
    np.testing.assert_allclose(qp.c, 0.09 * -0.2 * axis @ rot, atol=1e-9)
    assert ik.residuals(problem, q).contact == pytest.approx(0.0, abs=1e-7)


def test_a_free_sole_may_turn_about_the_normal_and_would_rather_not(ik):
    w, q = ik.world, ik.world.home
    goal = task_at(ik, q, "RFoot", "ground", Sliding)
    yawed = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    problem = problem_of(w, moved(goal, turn=yawed))
    qp = ik.build(problem, q)
    np.testing.assert_allclose(hard_rows(qp, w.model.nv)[1], 0.0, atol=1e-6)
    assert qp.merit == pytest.approx(0.5 * (0.3 * 0.4) ** 2, abs=1e-6)
    assert ik.residuals(problem, q).contact == pytest.approx(0.0, abs=1e-6)
    tilted = Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix()
    problem = problem_of(w, moved(goal, turn=tilted))
    assert ik.residuals(problem, q).contact == pytest.approx(0.1, abs=1e-6)


def test_outside_the_support_ellipse_the_centre_of_mass_is_drawn_in(ik):
    w = ik.world
    problem = stance(ik, w.home, "both feet", "ground", ellipse_weight=3.0)
    inside = ik.build(problem, w.home)
    np.testing.assert_array_equal(inside.c, 0.0)
    lean = bent(w, 8)
    lean[3:7] = quat_from_matrix(matrix_from_rpy([0.0, 0.5, 0.0]))
    wide = stance(ik, lean, "both feet", "ground", ellipse_weight=3.0)
    qp = ik.build(wide, lean)
    data = mujoco.MjData(w.model)
    data.qpos[:] = lean
    mujoco.mj_forward(w.model, data)
    com = data.subtree_com[w.base][:2]
    points = np.concatenate([ik.kin.bearing_points(f, UP) for f in ("LFoot", "RFoot")])
    excess, gradient = support_ellipse(support_polygon(points[:, :2])).excess(com)
    assert excess > 0
    J = ik.kin.com_jacobian()[:2]
    np.testing.assert_allclose(qp.c, 9.0 * excess * gradient @ J, atol=1e-9)


def test_stability_is_weighted_so_that_its_cost_is_that_of_the_method(ik):
    """(4.25): w || X - S ||^2, X where the contact is, S under the shoulder."""
    w, weight = ik.world, 5.0
    q = bent(w, 6)
    goal = task_at(ik, q, "LHand", "ground", Sliding, stability=weight)
    data = mujoco.MjData(w.model)

    def cost(x: np.ndarray) -> float:
        data.qpos[:] = x
        mujoco.mj_kinematics(w.model, data)
        e = data.geom("LHand").xpos[:2] - data.body("LShr").xpos[:2]
        return weight * float(e @ e)

    qp = ik.build(problem_of(w, goal), q)
    np.testing.assert_allclose(qp.c, jacobian(ik, q, cost), atol=1e-7)


def test_joints_that_are_no_robots_have_no_preferred_posture(ik):
    w = ik.world
    problem = problem_of(w, posture_weight=0.5)
    q = w.home.copy()
    q[:3] += 0.3
    qp = ik.build(problem, q)
    np.testing.assert_array_equal(qp.c, 0.0)  # the base may be anywhere
    np.testing.assert_allclose(np.diag(qp.H)[:6], DAMPING)
    np.testing.assert_allclose(np.diag(qp.H)[6:], DAMPING + 0.25)


# Bounds, balance, distances.


@pytest.mark.parametrize("support", SUPPORTS)
@pytest.mark.parametrize("surface", ["LHand", "LKnee", "RFoot"])
def test_a_free_contact_stays_inside_its_support(ik, surface, support, rng):
    w = ik.world
    s = w.supports[support]
    q = bent(w, 7)
    if support != "ground":
        # Bring the surface near a corner of the top: two sides matter.
        ik.kin.update(q)
        corner = s.position + s.rotation[:, :2] @ (s.polygon[2] * 0.9)
        q[:3] += corner - ik.kin.contact_point(surface, s.normal)
    problem = problem_of(w, task_at(ik, q, surface, support, Sliding))
    nv = w.model.nv
    A, lo, hi = soft_limits(ik.build(problem, q), nv)
    if support == "ground":
        assert len(A) == 0  # its border is far away
        return
    assert len(A) >= 2
    assert np.all(lo < -1e29)
    numeric = jacobian(ik, q, lambda x: -soft_limits(ik.build(problem, x), nv)[2])
    np.testing.assert_allclose(A, numeric, atol=2e-7)
    ik.kin.update(q)
    points = ik.kin.bearing_points(surface, s.normal)
    rooms = (s.edges()[1] - EDGE_INSET - points @ s.edges()[0].T).ravel()
    np.testing.assert_allclose(np.sort(hi), np.sort(rooms[rooms < 0.15]), atol=1e-9)


def halfplane_rooms(points: np.ndarray, com: np.ndarray) -> np.ndarray:
    """Signed distances from `com` to the sides of the hull, by Qhull."""
    hull = ConvexHull(points)
    return -(hull.equations[:, :2] @ com + hull.equations[:, 2])


STANCES = {
    "both feet": {"LFoot": {}, "RFoot": {}},
    "feet and a rolling hand": {"LFoot": {}, "RFoot": {}, "LHand": {"link": True}},
    "feet and a hand": {"LFoot": {}, "RFoot": {}, "RHand": {}},
    "foot and elbows": {"LFoot": {}, "LElbow": {"link": True}, "RElbow": {}},
    "a free hand": {"LFoot": {}, "RFoot": {}, "LHand": {"kind": Sliding}},
    "a free foot": {"LFoot": {}, "RFoot": {"kind": Sliding}},
    "four balls": {n: {"link": True} for n in ("LKnee", "RKnee", "LElbow", "RElbow")},
    "an edge of a foot": {"LFoot": {"edge": 0}, "RKnee": {}, "RHand": {"link": True}},
}


def stance(ik: IK, q: np.ndarray, name: str, support: str, **changes) -> PostureProblem:
    tasks = [task_at(ik, q, s, support, **kind) for s, kind in STANCES[name].items()]
    return problem_of(ik.world, *tasks, balance=True, **changes)


@pytest.mark.parametrize("support", ["ground", "tilted"])
@pytest.mark.parametrize("name", STANCES)
def test_balance_rows_follow_the_centre_of_mass_and_the_polygon(ik, name, support, rng):
    """Along motions that keep the contacts, the distance to each side changes so."""
    w, nv = ik.world, ik.world.model.nv
    n = w.supports[support].normal
    q = bent(w, 8)
    ik.kin.update(q)  # the left foot lies flat, so that it can roll on an edge
    sole = ik.kin.rotation(w.surfaces["LFoot"].body) @ w.surfaces["LFoot"].rotation
    lay = frame_from_normal(n, sole[:, 0]) @ sole.T
    q[3:7] = quat_from_matrix(lay @ ik.kin.rotation(w.base))
    problem = stance(ik, q, name, support, balance_margin=0.03)

    def rooms(x: np.ndarray) -> np.ndarray:
        ik.kin.update(x)
        contacts = [x.contact for x in problem.tasks]
        points = [ik.kin.bearing_points(c.surface, n, c.edge)[:, :2] for c in contacts]
        return halfplane_rooms(np.concatenate(points), ik.kin.com[:2]) - 0.03

    def balance(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A, _, hi = soft_limits(ik.build(problem, x), nv)
        m = len(rooms(x))
        return A[-m:], hi[-m:]

    A, hi = balance(q)
    np.testing.assert_allclose(np.sort(hi), np.sort(rooms(q)), atol=1e-9)
    for _ in range(5):
        v = random_in_contact(ik, problem, q, rng)
        # The hull lies on a grid of a nanometre: steps must be long against that.
        numeric = slope(ik, q, v, lambda x: -balance(x)[1], step=1e-4)
        np.testing.assert_allclose(A @ v, numeric, atol=5e-5)


def test_the_centre_of_mass_is_drawn_to_the_middle_of_the_polygon(ik):
    """Per step the polygon is held still; its middle is the mean of the corners."""
    w = ik.world
    problem = stance(ik, w.home, "both feet", "ground", com_weight=0.6)
    qp = ik.build(problem, w.home)
    ik.kin.update(w.home)
    feet = np.concatenate([ik.kin.bearing_points(f, UP) for f in ("LFoot", "RFoot")])
    middle = feet[ConvexHull(feet[:, :2]).vertices, :2].mean(axis=0)
    e = ik.kin.com[:2] - middle
    J = ik.kin.com_jacobian()[:2]
    np.testing.assert_allclose(qp.c, 0.36 * J.T @ e, atol=1e-9)
    assert qp.merit == pytest.approx(0.18 * e @ e)


@pytest.mark.parametrize("seed", range(3))
def test_distance_rows_are_the_derivatives_of_distances(ik, seed, rng):
    w, nv = ik.world, ik.world.model.nv
    q = bent(w, 20 + seed)
    problem = problem_of(w, clearance=contact_clearance(w, 0.02, {}))
    A, lo, hi = soft_limits(ik.build(problem, q), nv)
    assert np.all(hi > 1e29)
    ik.kin.update(q)
    near = ik.kin.proximity(0.10)
    assert len(A) == len(near.pairs) > 10
    np.testing.assert_allclose(lo, 0.02 - near.distance, atol=1e-9)
    v, checked = rng.normal(size=nv), 0
    data, ends = mujoco.MjData(w.model), []
    for sign in (1, -1):
        data.qpos[:] = ik.kin.integrate(q, sign * 1e-5 * v)
        mujoco.mj_kinematics(w.model, data)
        ends.append(
            [
                mujoco.mj_geomDistance(w.model, data, *map(int, w.pairs[i]), 1.0, None)
                for i in near.pairs
            ]
        )
    for row, d, high, low in zip(A, near.distance, *ends, strict=True):
        rates = np.array([high - d, d - low]) / 1e-5
        if d > 1e-3 and abs(rates[0] - rates[1]) < 1e-2:  # no penetration, no kink
            assert row @ v == pytest.approx(rates.mean(), abs=2e-3)
            checked += 1
    assert checked > 8


def test_pairs_without_a_clearance_have_no_row(ik):
    w = ik.world
    clearance = contact_clearance(w, 0.02, {})
    q = bent(w, 20)
    every = len(ik.build(problem_of(w, clearance=clearance), q).A)
    ik.kin.update(q)
    near = ik.kin.proximity(0.10).pairs
    clearance[near[:4]] = -np.inf
    assert len(ik.build(problem_of(w, clearance=clearance), q).A) == every - 4


def test_a_surface_may_touch_the_support_it_stands_on_and_no_other(ik):
    w = ik.world
    allowed = contact_clearance(w, 0.01, {"LKnee": "yawed", "RFoot": "ground"})
    name = w.model.geom
    changed = {}
    for (a, b), c in zip(w.pairs, allowed, strict=True):
        if c != 0.01:
            changed[frozenset((name(int(a)).name, name(int(b)).name))] = c
    shin = changed.pop(frozenset(("LKnee_shin", "yawed")))
    assert 0.0 <= shin < 0.01  # comes closer than others, does not enter
    assert changed == {
        frozenset(("LKnee", "yawed")): -np.inf,  # left to the contact task
        frozenset(("RFoot", "ground")): -np.inf,
    }
    rolling = contact_clearance(w, 0.01, {"RFoot": "ground"}, rolling=("RFoot",))
    assert sorted(set(rolling.tolist())) == [0.0, 0.01]


# Roughness: a soft task of a distance that is wanted, not demanded.


@pytest.fixture(scope="module")
def rough(world) -> IK:
    """One of the boxes rough by 3 cm, the other smooth."""
    boxes = tuple(
        replace(b, roughness=0.03 if b.name == "yawed" else 0.0)
        for b in world.scene.boxes
    )
    return IK(build_world(world.robot, replace(world.scene, boxes=boxes)))


def hand_over(ik: IK, box: str, height: float) -> np.ndarray:
    """(nq,) the left hand so high over the middle of a box; all else is ignored."""
    q = bent(ik.world, 3)
    ik.kin.update(q)
    s = ik.world.supports[box]
    p = ik.kin.contact_point("LHand", s.normal)
    q[:3] += s.position + height * s.normal - p
    return q


def only(world: World, geom: str, clearance: float) -> np.ndarray:
    """(P,) a clearance for the pairs of one geom with the scene alone."""
    g, fixed = world.model.geom(geom).id, world.model.geom_bodyid == 0
    mine = (world.pairs == g).any(axis=1) & fixed[world.pairs].any(axis=1)
    return np.where(mine, clearance, -np.inf)


def gap(world: World, q: np.ndarray, geom: str, box: str) -> float:
    """Distance of two geoms by plain MuJoCo."""
    m, data = world.model, mujoco.MjData(world.model)
    data.qpos[:] = q
    mujoco.mj_kinematics(m, data)
    return mujoco.mj_geomDistance(m, data, m.geom(geom).id, m.geom(box).id, 1.0, None)


@pytest.mark.parametrize("height", [0.012, 0.02, 0.03])
def test_too_near_what_is_rough_costs_the_square_of_what_is_missing(rough, height):
    w = rough.world
    q = hand_over(rough, "yawed", height)
    problem = problem_of(w, clearance=only(w, "LHand", 0.01))
    short = 0.01 + 0.03 - gap(w, q, "LHand", "yawed")
    assert short == pytest.approx(0.04 - height, abs=1e-6)
    cost = 0.5 * (ROUGHNESS_WEIGHT * short) ** 2
    assert rough.build(problem, q).merit == pytest.approx(cost, rel=1e-9)


def test_the_roughness_row_is_the_gradient_and_curvature_of_that_cost(rough, rng):
    w, h = rough.world, 1e-4
    q = hand_over(rough, "yawed", 0.02)
    problem = problem_of(w, clearance=only(w, "LHand", 0.01))
    qp = rough.build(problem, q)
    numeric = jacobian(rough, q, lambda x: rough.build(problem, x).merit, 1e-5)
    np.testing.assert_allclose(qp.c, numeric, atol=2e-3 * np.abs(numeric).max())
    # Almost closed, what is left is Gauss-Newton's own curvature.
    q = hand_over(rough, "yawed", 0.04 - 1e-9)
    qp = rough.build(problem, q)
    for v in rng.normal(size=(4, w.model.nv)):
        low = [rough.build(problem, rough.kin.integrate(q, s * h * v)) for s in (1, -1)]
        one_sided = max(x.merit for x in low)  # nearer costs, farther does not
        expected = 0.5 * h**2 * v @ (qp.H - DAMPING * np.eye(w.model.nv)) @ v
        assert one_sided == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("box", "height"), [("yawed", 0.041), ("yawed", 0.3), ("tilted", 0.02)]
)
def test_far_enough_or_over_a_smooth_box_nothing_is_asked_for(rough, box, height):
    w = rough.world
    q = hand_over(rough, box, height)
    qp = rough.build(problem_of(w, clearance=only(w, "LHand", 0.01)), q)
    assert qp.merit == 0.0
    assert not qp.c.any()
    np.testing.assert_allclose(qp.H, DAMPING * np.eye(w.model.nv))


@pytest.mark.parametrize(("roughness", "asked"), [(0.03, True), (0.015, False)])
def test_a_hand_beside_its_elbow_keeps_apart_from_an_uneven_top(
    world, roughness, asked
):
    """It is on the elbow's link, and would touch a higher part of the top first."""
    boxes = tuple(replace(b, roughness=roughness) for b in world.scene.boxes)
    ik = IK(build_world(world.robot, replace(world.scene, boxes=boxes)))
    w = ik.world
    assert w.surfaces["LHand"].body == w.surfaces["LElbow"].body
    q = hand_over(ik, "yawed", 0.012)
    elbow, clearance = task_at(ik, q, "LElbow", "yawed"), only(w, "LHand", 0.01)
    alone = ik.build(problem_of(w, clearance=clearance), q).merit
    beside = ik.build(problem_of(w, elbow, clearance=clearance), q).merit
    assert alone > 0.0
    assert beside == pytest.approx(alone if asked else 0.0)
    # Never the geoms of the surface itself.
    own = only(w, "LElbow_forearm", 0.004)
    assert ik.build(problem_of(w, clearance=own), q).merit > 0.0
    assert ik.build(problem_of(w, elbow, clearance=own), q).merit == pytest.approx(0.0)


def test_a_pair_within_range_that_is_far_enough_has_no_part_in_it(rough):
    """The link's next geom, nearer than the hand should be, but not than it should."""
    w = rough.world
    q = hand_over(rough, "yawed", 0.02)
    body = w.surfaces["LHand"].body
    names = [w.model.geom(g).name for g in np.flatnonzero(w.model.geom_bodyid == body)]
    away = {n: gap(w, q, n, "yawed") for n in names if n != "LHand"}
    other = min(away, key=lambda n: away[n])
    assert away[other] < 0.04
    alone = only(w, "LHand", 0.01)
    both = np.maximum(alone, only(w, other, away[other] - 0.03 - 1e-3))
    one, two = (rough.build(problem_of(w, clearance=x), q) for x in (alone, both))
    assert two.merit == one.merit > 0.0
    # Rows of one product with more pairs in it may differ in their last bits.
    np.testing.assert_allclose(two.H, one.H, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(two.c, one.c, rtol=1e-12, atol=1e-13)


def test_pairs_that_do_not_count_do_not_count_as_rough_either(rough):
    w = rough.world
    q = hand_over(rough, "yawed", 0.02)
    assert rough.build(problem_of(w), q).merit == 0.0


def test_a_link_in_contact_with_what_is_rough_is_as_near_as_its_contact(rough):
    w = rough.world
    q = hand_over(rough, "yawed", 0.001)
    wanted = problem_of(w, clearance=only(w, "LHand", 0.0))
    held = task_at(rough, q, "LHand", "yawed")
    where = contact_clearance(w, 0.0, {"LHand": "yawed"})
    touching = np.minimum(wanted.clearance, where)
    free = rough.build(wanted, q).merit
    assert free == pytest.approx(0.5 * (ROUGHNESS_WEIGHT * 0.029) ** 2, rel=1e-3)
    for clear in (wanted.clearance, touching):
        problem = replace(wanted, tasks=(held,), clearance=clear)
        assert rough.build(problem, q).merit == pytest.approx(0.0, abs=1e-9)
    # In contact with another support, or only on its way, it keeps its distance.
    elsewhere = task_at(rough, q, "LHand", "ground")
    reaching = task_at(rough, q, "LHand", "yawed", Reaching, weight=0.0)
    for goal in (elsewhere, reaching):
        problem = replace(wanted, tasks=(goal,))
        assert rough.build(problem, q).merit == pytest.approx(free, rel=1e-6)
    other = task_at(rough, q, "RHand", "ground")
    problem = replace(wanted, tasks=(other,))
    assert rough.build(problem, q).merit == pytest.approx(free, rel=1e-6)


def test_a_part_that_is_known_to_have_touched_keeps_off_by_so_much_more(world):
    """Of a smooth box too, that pair alone, also where its link is in contact."""
    hand = world.model.geom("LHand").id
    ik = IK(world, {(hand, "yawed"): 0.05})
    q = hand_over(ik, "yawed", 0.02)
    wanted = problem_of(world, clearance=only(world, "LHand", 0.01))
    cost = 0.5 * (ROUGHNESS_WEIGHT * 0.04) ** 2
    assert ik.build(wanted, q).merit == pytest.approx(cost, rel=1e-6)
    held = replace(wanted, tasks=(task_at(ik, q, "LHand", "yawed"),))
    away = ik.build(replace(held, clearance=only(world, "RHand", 0.01)), q).merit
    assert ik.build(held, q).merit - away == pytest.approx(cost, rel=1e-6)
    for geom, box in (("RHand", "yawed"), ("LHand", "tilted")):
        other = IK(world, {(world.model.geom(geom).id, box): 0.05})
        assert other.build(wanted, q).merit == 0.0


def test_the_larger_of_roughness_and_of_what_is_known_counts(rough):
    hand = rough.world.model.geom("LHand").id
    q = hand_over(rough, "yawed", 0.02)
    problem = problem_of(rough.world, clearance=only(rough.world, "LHand", 0.01))
    for more, total in ((0.01, 0.03), (0.05, 0.05)):
        merit = IK(rough.world, {(hand, "yawed"): more}).build(problem, q).merit
        short = 0.01 + total - 0.02
        assert merit == pytest.approx(0.5 * (ROUGHNESS_WEIGHT * short) ** 2, rel=1e-6)


# Room to slip: a soft task of a free round contact.


def near_border(ik: IK, room: float) -> np.ndarray:
    """(nq,) the left hand on the yawed box, so far inside its first border."""
    A, b = ik.world.supports["yawed"].edges()
    q = hand_over(ik, "yawed", 0.0)
    ik.kin.update(q)
    p = ik.kin.contact_point("LHand", ik.world.supports["yawed"].normal)
    q[:3] += A[0] * (b[0] - A[0] @ p - room)
    return q


@pytest.mark.parametrize("room", [0.016, 0.03, 0.044])
def test_too_near_a_border_costs_the_square_of_what_is_missing(ik, room):
    q = near_border(ik, room)
    free = problem_of(ik.world, task_at(ik, q, "LHand", "yawed", Sliding))
    cost = 0.5 * (EDGE_WEIGHT * (EDGE_ROOM - room)) ** 2
    assert ik.build(free, q).merit == pytest.approx(cost, rel=1e-6)

    def alone(x: np.ndarray) -> float:
        ik.kin.update(x)
        s = ik.world.supports["yawed"]
        A, b = s.edges()
        short = EDGE_ROOM - (b - A @ ik.kin.contact_point("LHand", s.normal)).min()
        return 0.5 * (EDGE_WEIGHT * short) ** 2

    numeric = jacobian(ik, q, alone, 1e-5)
    np.testing.assert_allclose(ik.build(free, q).c, numeric, atol=1e-6)
    held = problem_of(ik.world, task_at(ik, q, "LHand", "yawed"))
    assert ik.build(held, q).merit == pytest.approx(0.0, abs=1e-9)


def test_farther_inside_no_border_counts(ik):
    q = near_border(ik, EDGE_ROOM + 1e-4)
    free = problem_of(ik.world, task_at(ik, q, "LHand", "yawed", Sliding))
    assert ik.build(free, q).merit == pytest.approx(0.0, abs=1e-9)
    assert not ik.build(free, q).c.any()


def test_over_what_is_rough_a_limb_keeps_farther_away_where_it_can(plain):
    """A hand on its way, close to the top: the rougher that is, the higher it goes."""
    heights = []
    for roughness in (0.0, 0.02, 0.05):
        scene = plain.world.scene
        boxes = tuple(replace(b, roughness=roughness) for b in scene.boxes)
        ik = IK(build_world(plain.world.robot, replace(scene, boxes=boxes)))
        problem = stance_problem(ik)
        *feet, hand = problem.tasks
        above = moved(hand, 0.015 * UP)
        way = Reaching(contact=above.contact, rotation=above.rotation, weight=5.0)
        where = {"LFoot": "ground", "RFoot": "ground"}
        clearance = contact_clearance(ik.world, 0.01, where)
        problem = replace(problem, tasks=(*feet, way), clearance=clearance)
        solution = ik.solve_hard(problem, ik.world.home)
        assert solution.status is Status.SOLVED
        heights.append(gap(ik.world, solution.q, "LHand", "box"))
    assert heights[0] == pytest.approx(0.015, abs=5e-3)
    assert heights[1] > heights[0] + 0.005
    assert heights[2] > heights[1] + 0.015
    assert heights[2] < 0.01 + 0.05 + 1e-3  # but no farther than is asked for


# Bounds on joints and steps, and the QP's solution.


def hand_on_box(x: float, y: float) -> Contact:
    return Contact(
        surface="LHand",
        support="box",
        position=np.array([x, y, 0.275]),
        quaternion=np.eye(4)[0],
    )


def stance_problem(plain: IK, **changes) -> PostureProblem:
    """Feet where they stand, the left hand on the box, everything else switched on."""
    w = plain.world
    feet = [task_at(plain, w.home, f, "ground") for f in ("LFoot", "RFoot")]
    hand = Sliding(
        contact=hand_on_box(0.38, 0.17),
        rotation=np.eye(3),
        stability=5.0,
        reference=1.5,
    )
    where = {"LFoot": "ground", "RFoot": "ground", "LHand": "box"}
    usual = {
        "tasks": (*feet, hand),
        "q_reference": w.home,
        "clearance": contact_clearance(w, 0.01, where),
        "directions": {"trunk": np.array([0.5, 0.0, np.sqrt(0.75)])},
        "direction_weight": 0.2,
    }
    return PostureProblem(**(usual | changes))


def beside(left: SurfaceTask, right: SurfaceTask, y: float) -> SurfaceTask:
    """The left foot so far to the left of the right one."""
    at = right.contact.position + np.array([0.0, y, 0.0])
    return replace(left, contact=replace(left.contact, position=at))


def test_bounds_are_the_room_left_to_the_limits(ik):
    w = ik.world
    q = bent(w, 9)
    qp = ik.build(problem_of(w), q)
    np.testing.assert_allclose(qp.lo[w.dadr], w.q_min[w.dadr] - q[w.qadr])
    np.testing.assert_allclose(qp.hi[w.dadr], w.q_max[w.dadr] - q[w.qadr])
    assert np.all(qp.lo[:6] < -1e29)
    assert np.all(qp.hi[:6] > 1e29)


@pytest.mark.parametrize("radius", [1.0, 0.1])
def test_a_step_stays_within_its_trust_region(plain, radius):
    problem = stance_problem(plain)
    dq = plain.step(problem, plain.world.home, radius)
    largest = np.r_[np.full(3, STEP_TRANSLATION), np.full(26, STEP_ROTATION)] * radius
    assert np.all(np.abs(dq) <= largest + 1e-9)
    assert np.any(np.abs(dq) > 0.99 * largest)  # and would go farther


def near_solution(plain: IK, problem: PostureProblem, rng) -> np.ndarray:
    """A posture from which one step can satisfy every constraint."""
    q = plain.solve(problem, plain.world.home).q
    return plain.kin.integrate(q, 0.01 * rng.normal(size=plain.world.model.nv))


def step_bounds(qp, nv: int) -> tuple[np.ndarray, np.ndarray]:
    """(nv,) least and largest step: joint limits and the trust region."""
    step = np.r_[np.full(3, STEP_TRANSLATION), np.full(nv - 3, STEP_ROTATION)]
    return np.maximum(qp.lo[:nv], -step), np.minimum(qp.hi[:nv], step)


def penalised(qp, nv: int, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Model of the merit that a step minimises, and its gradient (nv,)."""
    open_ = qp.C @ x - qp.e
    reached = qp.A @ x
    outside = reached - np.clip(reached, qp.lo[nv:], qp.hi[nv:])
    value = 0.5 * x @ qp.H @ x + qp.c @ x
    value += 0.5 * PENALTY * (open_ @ open_ + outside @ outside)
    slope = qp.H @ x + qp.c + PENALTY * (qp.C.T @ open_ + qp.A.T @ outside)
    return value, slope


def test_a_step_is_where_the_model_of_the_merit_is_least(plain, rng):
    """Its gradient vanishes but for joints at a bound, which it presses against."""
    nv = plain.world.model.nv
    problem = stance_problem(plain)
    q = near_solution(plain, problem, rng)
    qp, x = plain.build(problem, q), plain.step(problem, q)
    lb, ub = step_bounds(qp, nv)
    assert np.all(x >= lb - 1e-9)
    assert np.all(x <= ub + 1e-9)
    _, slope = penalised(qp, nv, x)
    low, high = x < lb + 1e-9, x > ub - 1e-9
    size = PENALTY * np.abs(qp.C.T @ qp.e).max()
    np.testing.assert_allclose(slope[~low & ~high], 0.0, atol=1e-6 * size)
    assert np.all(slope[low] >= -1e-6 * size)
    assert np.all(slope[high] <= 1e-6 * size)
    np.testing.assert_allclose(qp.C @ x, qp.e, atol=1e-4)  # contacts all but close


def test_the_model_of_the_merit_is_its_derivative(plain, rng):
    """What makes every short step lower the merit: also where constraints fight."""
    nv = plain.world.model.nv
    left, right, hand = stance_problem(plain).tasks
    near = beside(left, right, 0.06)
    problem = stance_problem(plain, tasks=(near, right, hand))
    q = plain.kin.integrate(plain.world.home, 0.02 * rng.normal(size=nv))
    qp = plain.build(problem, q)
    _, slope = penalised(qp, nv, np.zeros(nv))
    x = plain.step(problem, q, 0.02)
    assert slope @ x < 0
    step = 1e-5 * x / np.abs(x).max()
    merits = [
        plain.build(problem, plain.kin.integrate(q, s * step)).merit for s in (1, -1)
    ]
    assert (merits[0] - merits[1]) / 2 == pytest.approx(slope @ step, rel=0.02)
    assert plain.build(problem, plain.kin.integrate(q, x)).merit < qp.merit


def test_contacts_that_contradict_one_another_give_a_step_all_the_same(ik):
    w = ik.world
    q = w.home
    here = task_at(ik, q, "LFoot", "ground")
    there = moved(here, [0.04, 0.0, 0.0])
    problem = problem_of(w, here, there)
    dq = ik.step(problem, q)
    assert np.all(np.isfinite(dq))
    ik.kin.update(ik.kin.integrate(q, dq))
    p = ik.kin.contact_point("LFoot", UP)
    np.testing.assert_allclose(
        p, moved(here, [0.02, 0.0, 0.0]).contact.position, atol=2e-3
    )


def test_joint_limits_hold_at_every_iteration(plain):
    w = plain.world
    far = Closed(
        contact=hand_on_box(1.0, -0.6), rotation=np.eye(3)
    )  # asks for more than the joints can give
    problem = stance_problem(plain, tasks=(*stance_problem(plain).tasks[:2], far))
    q, at_limit = w.home, 0
    for _ in range(25):
        q = plain.kin.integrate(q, plain.step(problem, q))
        room = np.minimum(q[w.qadr] - w.q_min[w.dadr], w.q_max[w.dadr] - q[w.qadr])
        assert room.min() > -1e-9
        at_limit = max(at_limit, int(np.sum(room < 1e-6)))
    assert at_limit >= 3


# Whole solves.


def measured(world: World, problem: PostureProblem, q: np.ndarray) -> dict[str, float]:
    """What `Residuals` say, computed from plain MuJoCo and the geoms by name."""
    m, data = world.model, mujoco.MjData(world.model)
    data.qpos[:] = q
    mujoco.mj_forward(m, data)
    contact, points = 0.0, []
    for x in problem.tasks:
        g = x.contact
        support = world.supports[g.support]
        geom = data.geom(g.surface)
        R = geom.xmat.reshape(3, 3)
        size = m.geom(g.surface).size
        if g.surface.endswith("Foot"):
            p = geom.xpos - R[:, 2] * size[2]
            signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
            bearing = p + (signs * size[:2]) @ R[:, :2].T
            tilt = np.arccos(np.clip((np.trace(R @ x.rotation.T) - 1) / 2, -1, 1))
            contact = max(contact, float(tilt))
        else:
            p = geom.xpos - size[0] * support.normal
            bearing = p[None]
        points.append(bearing)
        gap = p - g.position
        contact = max(
            contact,
            abs(gap @ support.normal)
            if isinstance(x, Sliding)
            else float(np.linalg.norm(gap)),
        )
    hull = ConvexHull(np.concatenate(points)[:, :2])
    com = data.subtree_com[m.body("Waist").id]
    margin = -float((hull.equations @ np.r_[com[:2], 1.0]).max())
    short = max(
        c - mujoco.mj_geomDistance(m, data, int(a), int(b), 0.5, None)
        for (a, b), c in zip(world.pairs, problem.clearance, strict=True)
        if np.isfinite(c)
    )
    return {"contact": contact, "com_margin": margin, "distance": max(short, 0.0)}


def test_a_simple_stance_is_solved_and_plain_mujoco_agrees(plain):
    problem = stance_problem(plain)
    solution = plain.solve(problem, plain.world.home)
    assert solution.status is Status.SOLVED
    assert solution.iterations <= 30  # a step that fails is tried again shorter
    truth = measured(plain.world, problem, solution.q)
    r = solution.residuals
    assert truth["contact"] < 5e-4
    assert truth["distance"] < 2e-3
    assert truth["com_margin"] > 0.025 - 2e-3
    assert r.com_margin == pytest.approx(truth["com_margin"], abs=1e-9)
    assert r.contact == pytest.approx(truth["contact"], abs=1e-6)
    assert r.distance == pytest.approx(truth["distance"], abs=1e-9)
    assert r.limits == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_residuals_are_what_plain_mujoco_measures_anywhere(plain, seed):
    problem = stance_problem(plain)
    q = bent(plain.world, seed)
    r, truth = plain.residuals(problem, q), measured(plain.world, problem, q)
    for name, value in truth.items():
        assert getattr(r, name) == pytest.approx(value, abs=1e-7), name
    assert r.balance == pytest.approx(max(0.025 - truth["com_margin"], 0.0), abs=1e-9)
    assert r.worst >= max(r.contact, r.distance)
    if r.distance > 0:
        plain.kin.update(q)
        a, b = map(int, plain.world.pairs[r.worst_pair])
        d = mujoco.mj_geomDistance(
            plain.world.model, plain.kin.data, a, b, 0.5, np.zeros(6)
        )
        assert problem.clearance[r.worst_pair] - d == pytest.approx(r.distance)


def test_residuals_notice_any_clearance(plain):
    """Also one that is larger than what is usual: the feet are 45 mm apart."""
    w = plain.world
    feet = [w.model.geom(f).id for f in ("LFoot", "RFoot")]
    pair = np.isin(w.pairs, feet).all(axis=1)
    problem = stance_problem(plain, clearance=np.where(pair, 0.06, -np.inf))
    problem = replace(problem, tasks=problem.tasks[:2])
    r = plain.residuals(problem, w.home)
    assert r.distance == pytest.approx(0.06 - 0.0452, abs=1e-6)
    assert pair[r.worst_pair]
    assert r.status is Status.COLLIDING


def test_limits_that_are_exceeded_are_measured(plain):
    w = plain.world
    q = w.home.copy()
    q[w.qadr[0]] = w.q_max[w.dadr[0]] + 0.02
    r = plain.residuals(stance_problem(plain), q)
    assert r.limits == pytest.approx(0.02)
    assert r.status is Status.UNREACHABLE


@pytest.mark.parametrize("off", [0.002, 0.3])
def test_a_joint_beyond_its_limit_is_brought_back(plain, off):
    """Measured joints may be beyond it, where servos give way."""
    w = plain.world
    q = plain.solve(stance_problem(plain), w.home).q
    bent_back = q.copy()
    for j in (3, 9, 15, 20):
        bent_back[w.qadr[j]] = w.q_max[w.dadr[j]] + off
    problem = stance_problem(plain, q_reference=bent_back, posture_weight=1.0)
    solution = plain.solve(problem, bent_back)
    assert solution.residuals.limits == 0.0
    assert solution.status is Status.SOLVED


def test_a_contact_out_of_reach_is_unreachable(plain):
    far = Closed(contact=hand_on_box(1.2, 0.5), rotation=np.eye(3))
    problem = stance_problem(plain, tasks=(*stance_problem(plain).tasks[:2], far))
    solution = plain.solve(problem, plain.world.home)
    assert solution.status is Status.UNREACHABLE
    truth = measured(plain.world, problem, solution.q)
    assert solution.residuals.contact == pytest.approx(truth["contact"], abs=1e-6)
    assert truth["contact"] > 0.1


def test_a_margin_that_no_stance_has_is_unbalanced_feet_too_close_collide(plain):
    w = plain.world
    left, right, _ = stance_problem(plain).tasks
    clearance = contact_clearance(w, 0.01, {"LFoot": "ground", "RFoot": "ground"})
    wide = stance_problem(
        plain, tasks=(left, right), clearance=clearance, balance_margin=0.15
    )
    solution = plain.solve(wide, w.home)
    assert solution.status is Status.UNBALANCED
    # As near to it as the feet allow: their hull is 0.20 m long.
    assert solution.residuals.com_margin == pytest.approx(0.1, abs=0.005)
    near = beside(left, right, 0.08)
    tight = stance_problem(plain, tasks=(near, right), clearance=clearance)
    solution = plain.solve(tight, w.home)
    # Feet that overlap satisfy neither: whichever gives way, it is not called solved.
    assert solution.status in (Status.COLLIDING, Status.UNREACHABLE)
    a, b = (w.model.geom(int(g)).name for g in w.pairs[solution.residuals.worst_pair])
    assert {a, b} == {"LFoot", "RFoot"}


def test_where_nothing_satisfies_all_no_step_is_left_that_would_help(plain):
    left, right, hand = stance_problem(plain).tasks
    for shift in (0.03, 0.06, 0.09):
        near = beside(left, right, shift)
        problem = stance_problem(plain, tasks=(near, right, hand))
        solution = plain.solve(problem, plain.world.home)
        assert solution.status is not Status.SOLVED
        qp = plain.build(problem, solution.q)
        trial = plain.kin.integrate(solution.q, plain.step(problem, solution.q))
        assert plain.build(problem, trial).merit > 0.9 * qp.merit


def test_a_solve_is_its_steps_in_a_trust_region(plain):
    """What a step that was taken back looked at has no part in the next one."""
    hand = Closed(contact=hand_on_box(0.5, -0.05), rotation=np.eye(3))
    problem = stance_problem(plain, tasks=(*stance_problem(plain).tasks[:2], hand))
    x, radius, taken_back = plain.world.home, 1.0, 0
    for n in range(1, 16):
        dq = plain.step(problem, x, radius)
        trial = plain.kin.integrate(x, dq)
        merit, before = (plain.build(problem, y).merit for y in (trial, x))
        if n == 1 or merit <= before:
            x, radius = trial, min(2.0 * radius, 1.0)
        else:
            radius, taken_back = 0.25 * radius, taken_back + 1
    assert taken_back >= 2
    found = plain.solve(problem, plain.world.home, iterations=15, tolerance=0.0)
    np.testing.assert_allclose(found.q, x, atol=1e-5)


def test_the_same_question_has_the_same_answer_to_the_bit(plain):
    problem = stance_problem(plain)
    first = plain.solve(problem, plain.world.home)
    other = stance_problem(plain, direction_weight=0.0, balance_margin=0.05)
    plain.solve(other, first.q)  # whatever the workspace was used for in between
    again = plain.solve(problem, plain.world.home)
    fresh = IK(plain.world).solve(problem, plain.world.home)
    for s in (again, fresh):
        np.testing.assert_array_equal(s.q, first.q)
        assert s.iterations == first.iterations
        assert s.residuals.worst == first.residuals.worst


def test_asking_leaves_question_and_start_as_they_were(plain):
    w = plain.world
    problem = stance_problem(plain)
    home, clearance = w.home.copy(), problem.clearance.copy()
    positions = [x.contact.position.copy() for x in problem.tasks]
    plain.solve_hard(problem, w.home)
    np.testing.assert_array_equal(w.home, home)
    np.testing.assert_array_equal(problem.clearance, clearance)
    for x, p in zip(problem.tasks, positions, strict=True):
        np.testing.assert_array_equal(x.contact.position, p)


def test_a_solved_posture_stays_solved_wherever_the_world_is_turned(rng):
    """Turn scene, start and goals about the vertical: the joints are the same."""
    yaw, at = 0.8, np.array([0.7, -0.4])
    R = matrix_from_rpy([0.0, 0.0, yaw])
    here = IK(build_world(load_robot("coman"), Scene.from_height(0.275)))
    box = here.world.scene.boxes[0]
    turned = Box(
        name="box",
        size=box.size,
        centre=R @ box.centre + [*at, 0.0],
        rotation=R,
    )
    scene = Scene(boxes=(turned,), start=np.array([*at, yaw]))
    there = IK(build_world(load_robot("coman"), scene))
    problem = stance_problem(here)
    other = stance_problem(
        there,
        directions={n: R @ u for n, u in problem.directions.items()},
    )
    hand = problem.tasks[2]
    p = hand.contact.position
    hand = moved(hand, R @ p + [*at, 0.0] - p, R)
    other = replace(other, tasks=(*other.tasks[:2], hand))
    a = here.solve(problem, here.world.home)
    b = there.solve(other, there.world.home)
    assert a.status is b.status is Status.SOLVED
    np.testing.assert_allclose(a.q[7:], b.q[7:], atol=2e-3)
    assert a.residuals.com_margin == pytest.approx(b.residuals.com_margin, abs=1e-3)


def test_solve_hard_never_does_worse(plain):
    for x in (0.36, 0.5, 0.62):
        hand = Closed(contact=hand_on_box(x, -0.05), rotation=np.eye(3))
        problem = stance_problem(plain, tasks=(*stance_problem(plain).tasks[:2], hand))
        easy = plain.solve(problem, plain.world.home)
        hard = plain.solve_hard(problem, plain.world.home)
        assert hard.residuals.worst <= easy.residuals.worst
        assert hard.iterations >= easy.iterations


def test_a_hint_is_where_a_hard_solve_begins(plain):
    problem = stance_problem(plain)
    there = plain.solve(problem, plain.world.home).q
    hinted = plain.solve_hard(problem, bent(plain.world, 3), hint=there)
    assert hinted.iterations == plain.solve(problem, there).iterations
    wrong = plain.solve_hard(problem, plain.world.home, hint=bent(plain.world, 3))
    assert wrong.status is Status.SOLVED  # and where it misleads, it does no harm


def test_a_leap_that_does_not_pay_off_is_taken_back(plain):
    """From a posture that is good already, a solve never ends in a worse one."""
    left, right, hand = stance_problem(plain).tasks
    for shift in (0.03, 0.06, 0.09):
        near = beside(left, right, shift)
        problem = stance_problem(plain, tasks=(near, right, hand))
        q = plain.solve(problem, plain.world.home).q
        before = plain.build(problem, q).merit
        assert plain.build(problem, plain.solve(problem, q).q).merit <= before + 1e-9


def test_an_exact_log_is_used_for_large_turns(ik):
    """A pelvis turned by 2 rad is asked to come back by 2 rad, not by sin 2."""
    w = ik.world
    R = matrix_from_rpy([0.0, 0.0, 2.0])
    problem = problem_of(w, base_rotation=R, base_weight=1.0)
    qp = ik.build(problem, w.home)
    ik.kin.update(w.home)
    e = rotation_vector(R @ ik.kin.rotation(w.base).T)
    assert qp.merit == pytest.approx(0.5 * e @ e)
    assert np.linalg.norm(e) == pytest.approx(2.0, abs=0.2)


def test_round_contacts_are_the_same_whatever_problem_came_before(plain):
    """Tasks are kept while a problem is solved, and no longer."""
    w, q = plain.world, bent(plain.world, 4)
    names = ("LKnee", "RKnee", "LElbow", "RElbow")
    problems = []
    for held in (names[:2], names[1:], names):
        tasks = [
            moved(task_at(plain, q, name, "box", link=True), np.full(3, 0.01))
            for name in held
        ]
        problems.append(problem_of(w, *tasks, balance=True))
    later = plain.kin.integrate(q, np.full(w.model.nv, 0.05))
    for problem in (*problems, *problems[::-1]):
        for posture in (q, later, q):
            qp, fresh = plain.build(problem, posture), IK(w).build(problem, posture)
            for name in ("H", "c", "C", "e", "A", "lo", "hi"):
                np.testing.assert_array_equal(getattr(qp, name), getattr(fresh, name))
            assert qp.merit == fresh.merit
    # Each of them is open by what it was put aside, and stays on its support, or where
    # it is beside it.
    qp = plain.build(problems[-1], q)
    np.testing.assert_allclose(qp.e, 0.01, atol=1e-9)
    A, b = w.supports["box"].edges()
    for name in names:
        p = plain.kin.contact_point(name, w.supports["box"].normal)
        room = np.maximum(b - EDGE_INSET, A @ (p + 0.01)) - A @ p
        assert all(np.isclose(qp.hi, x).any() for x in room[room < 0.15])


# Arms keep farther from legs than their clearance: a soft task, too.


@pytest.mark.parametrize(
    ("first", "second", "asked"),
    [
        ("LHand", "LKnee", True),
        ("LElbow", "RFoot", True),
        ("LHand", "RHand", False),
        ("LFoot", "RFoot", False),
        ("LHand", "yawed", False),
    ],
)
def test_links_of_an_arm_and_a_leg_are_farther_apart_where_that_costs_nothing(
    ik, first, second, asked
):
    w = ik.world
    pair = {w.model.geom(first).id, w.model.geom(second).id}
    mine = np.array([set(map(int, p)) == pair for p in w.pairs])
    assert mine.sum() == 1
    apart = gap(w, w.home, first, second)
    # A clearance that is kept, but with less to spare than arms ask of legs.
    short = 0.4 * ARMS_FROM_LEGS
    clearance = np.where(mine, apart - (ARMS_FROM_LEGS - short), -np.inf)
    merit = ik.build(problem_of(w, clearance=clearance), w.home).merit
    cost = 0.5 * (ROUGHNESS_WEIGHT * short) ** 2
    assert merit == pytest.approx(cost if asked else 0.0, rel=1e-6, abs=1e-12)
