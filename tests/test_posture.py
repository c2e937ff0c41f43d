"""Postures with a new contact: their cost, three ways to lower it, what is measured."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_rpy, quat_from_matrix
from clamber.model.world import World, build_world
from clamber.step.ik import IK
from clamber.step.methods import METHODS, Alternation, direct
from clamber.step.posture import (
    Keyframe,
    KeyframeOptions,
    KeyframeTask,
    finish,
    keyframe_problem,
    new_positions,
    prescribed,
    stability_cost,
)
from clamber.step.stability import (
    contact_state,
    equilibrium_at,
    is_stable,
    statics_at,
)
from clamber.step.statics import GRAVITY
from clamber.step.tasks import EDGE_INSET, Closed, Sliding
from oracles import contact_drift

OUTER = {n: m for n, m in METHODS.items() if n != "direct"}
UP = np.array([0.0, 0.0, 1.0])
FLAT = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def ik() -> IK:
    return IK(build_world(load_robot("coman"), Scene.from_height(0.275)))


def feet(ik: IK) -> tuple[Contact, ...]:
    """Both feet where they stand at home."""
    w, kin = ik.world, ik.kin
    kin.update(w.home)
    R = matrix_from_rpy([0.0, 0.0, w.scene.start[2]])
    return tuple(
        Contact(
            surface=f,
            support="ground",
            position=kin.contact_point(f, UP) * [1.0, 1.0, 0.0],
            quaternion=quat_from_matrix(R),
        )
        for f in ("LFoot", "RFoot")
    )


def on_box(surface: str, x: float, y: float, z: float = 0.275) -> Contact:
    p = np.array([x, y, z])
    return Contact(surface=surface, support="box", position=p, quaternion=FLAT)


def task_of(ik: IK, *new: Contact, **changes) -> KeyframeTask:
    return KeyframeTask(held=feet(ik), new=new, q_reference=ik.world.home, **changes)


@pytest.fixture(scope="module")
def results(ik) -> dict[str, Keyframe]:
    """The left hand newly on the box, by each method."""
    task = task_of(ik, on_box("LHand", 0.43, 0.17))
    home, options = ik.world.home, KeyframeOptions()
    return {n: m(ik, task, home, options) for n, m in METHODS.items()}


def located(world: World, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(world.model)
    data.qpos[:] = q
    mujoco.mj_forward(world.model, data)
    return data


# The cost.


@pytest.mark.parametrize("weight", [1.0, 5.0])
def test_the_gradient_of_the_cost_is_its_derivative(ik, weight, rng, finite_difference):
    task = task_of(ik, on_box("LHand", 0.4, 0.2), on_box("RKnee", 0.3, -0.1))
    ik.kin.update(ik.world.home)
    x = rng.uniform(-0.5, 0.5, (2, 3))

    def cost(xy: np.ndarray) -> float:
        moved = np.c_[xy.reshape(2, 2), x[:, 2]]
        return stability_cost(ik.kin, task, moved, weight)[0]

    value, grad = stability_cost(ik.kin, task, x, weight)
    assert value == pytest.approx(cost(x[:, :2].ravel()))
    numeric = finite_difference(cost, x[:, :2].ravel()).reshape(2, 2)
    np.testing.assert_allclose(grad, numeric, atol=1e-8)


def test_the_cost_is_the_weighted_square_of_the_distance_to_the_mass(ik):
    """3 cm and 4 cm beside the shoulder: 5 times 0.05 squared."""
    ik.kin.update(ik.world.home)
    shoulder = located(ik.world, ik.world.home).body("LShr").xpos
    task = task_of(ik, on_box("LHand", 0.4, 0.2))
    x = shoulder + np.array([[0.03, -0.04, -0.3]])
    cost, grad = stability_cost(ik.kin, task, x, 5.0)
    assert cost == pytest.approx(5.0 * 0.05**2)
    np.testing.assert_allclose(grad, [[0.3, -0.4]], atol=1e-12)
    assert stability_cost(ik.kin, task, x + 0.7 * UP, 5.0)[0] == pytest.approx(cost)


def test_legs_carry_hips_and_arms_carry_shoulders(ik):
    data = located(ik.world, ik.world.home)
    ik.kin.update(ik.world.home)
    for surface, body in (
        ("LHand", "LShr"),
        ("RElbow", "RShr"),
        ("LKnee", "LThighUpLeg"),
        ("RFoot", "RThighUpLeg"),
    ):
        task = task_of(ik, on_box(surface, 0.4, 0.0))
        x = data.body(body).xpos[None] + np.array([0.0, 0.0, -0.2])
        assert stability_cost(ik.kin, task, x, 5.0)[0] == pytest.approx(0.0, abs=1e-15)


def test_no_new_contact_costs_nothing(ik):
    cost, grad = stability_cost(ik.kin, task_of(ik), np.zeros((0, 3)), 5.0)
    assert cost == 0.0
    assert grad.shape == (0, 2)


# Contact states.


@pytest.mark.parametrize("seed", range(5))
def test_distance_is_length_times_the_sine_of_the_angle(ik, seed):
    rng = np.random.default_rng(seed)
    q = ik.world.home.copy()
    q[ik.world.qadr] += rng.uniform(-0.3, 0.3, len(ik.world.qadr))
    ik.kin.update(q)
    c = on_box("RHand", *rng.uniform(-0.3, 0.3, 2), z=rng.uniform(0.0, 0.3))
    state = contact_state(ik.kin, c)
    line = located(ik.world, q).body("RShr").xpos - c.position
    length = np.linalg.norm(line)
    assert state.projected_distance == pytest.approx(np.hypot(*line[:2]))
    assert state.projected_distance == pytest.approx(
        length * math.sin(state.contact_angle)
    )
    assert math.cos(state.contact_angle) == pytest.approx(line[2] / length)


@pytest.mark.parametrize("friction", [0.8, 0.3])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_contact_supports_within_its_cone_of_at_most_25_degrees(friction, share):
    """Friction 0.8 would allow 39 degrees, 0.3 allows 16.7."""
    ik = IK(build_world(load_robot("coman"), Scene.from_height(0.275, friction)))
    ik.kin.update(ik.world.home)
    shoulder = located(ik.world, ik.world.home).body("LShr").xpos
    theta = share * min(math.atan(friction), math.radians(25.0))
    down = np.array([math.sin(theta), 0.0, -math.cos(theta)])
    p = shoulder + 0.3 * down
    c = on_box("LHand", *p)
    inside = share < 1
    assert contact_state(ik.kin, c).phase == ("supporting" if inside else "sliding")
    unloaded = contact_state(ik.kin, c, loaded=False).phase
    assert unloaded == ("reach-to-supportable" if inside else "sliding")


# The three methods.


@pytest.mark.parametrize("name", METHODS)
def test_each_method_solves_a_simple_stance_at_a_lower_cost(ik, results, name):
    k = results[name]
    assert k.status is Status.SOLVED
    assert k.method == name
    assert k.cost_after < 0.1 * k.cost_before
    assert k.iterations > 0
    assert equilibrium_at(ik.kin, k.q, k.stance).feasible
    assert k.com_margin > 0.02
    assert [c.contact.surface for c in k.contacts] == ["LFoot", "RFoot", "LHand"]


@pytest.mark.parametrize("name", METHODS)
def test_what_a_keyframe_says_is_so_in_plain_mujoco(ik, results, name):
    k, m = results[name], ik.world.model
    data = located(ik.world, k.q)
    hand = k.contacts[-1]
    np.testing.assert_allclose(
        hand.contact.position, data.geom("LHand").xpos - 0.02 * UP, atol=5e-4
    )
    assert hand.contact.position[2] == pytest.approx(0.275, abs=1e-12)
    assert hand.contact.link is not None
    R = Rotation.from_quat(hand.contact.link, scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, data.body("LElb").xmat.reshape(3, 3), atol=1e-9)
    np.testing.assert_allclose(k.com, data.subtree_com[ik.world.base], atol=1e-12)
    gap = (hand.contact.position - data.body("LShr").xpos)[:2]
    assert k.cost_after == pytest.approx(5.0 * gap @ gap, abs=1e-12)
    assert hand.projected_distance == pytest.approx(np.linalg.norm(gap), abs=1e-9)
    reference = np.array([0.43, 0.17])
    shoulder = located(ik.world, ik.world.home).body("LShr").xpos[:2]
    away = reference - shoulder
    assert k.cost_before == pytest.approx(5.0 * away @ away)
    for foot, held in zip(("LFoot", "RFoot"), feet(ik), strict=True):
        g = data.geom(foot)
        sole = g.xpos - g.xmat.reshape(3, 3)[:, 2] * 0.02
        np.testing.assert_allclose(sole, held.position, atol=5e-4)
    dof = ik.world.dadr
    assert np.all(k.q[ik.world.qadr] >= ik.world.q_min[dof] - 1e-6)
    assert np.all(k.q[ik.world.qadr] <= ik.world.q_max[dof] + 1e-6)
    # Nothing penetrates: contacts of MuJoCo are those of the stance, and shallow.
    for c in data.contact:
        names = {m.geom(g).name for g in c.geom}
        assert names & {"LFoot", "RFoot", "LHand"}
        assert c.dist > -2e-3


@pytest.mark.parametrize("name", METHODS)
def test_the_forces_that_hold_it_up_add_up_to_its_weight(ik, results, name):
    k = results[name]
    total = equilibrium_at(ik.kin, k.q, k.stance).forces.sum(axis=0)
    np.testing.assert_allclose(total, [0, 0, ik.world.mass * GRAVITY], atol=1e-3)


def test_both_outer_methods_find_about_the_same_cost(results):
    """Along a valley of it: the hand may be anywhere that the shoulder can be."""
    a, b = (results[n].cost_after for n in OUTER)
    assert a == pytest.approx(b, abs=2e-3 * results["lbfgs"].cost_before)
    assert results["lbfgs"].iterations < results["gradient"].iterations


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("surface", "x", "y"),
    [("LHand", 0.15, 0.17), ("RHand", 0.2, -0.75)],  # before the edge, beside the box
)
def test_new_contacts_stay_inside_their_support(ik, name, surface, x, y):
    task = task_of(ik, on_box(surface, x, y))
    k = METHODS[name](ik, task, ik.world.home, KeyframeOptions())
    p = k.contacts[-1].contact.position
    assert 0.23 + EDGE_INSET - 1e-4 < p[0] < 1.23
    assert abs(p[1]) < 0.6 - EDGE_INSET + 1e-4
    assert p[2] == pytest.approx(0.275, abs=5e-4)


@pytest.fixture(scope="module")
def askew() -> tuple[IK, KeyframeTask]:
    """The left hand on a box that is yawed and slightly tilted."""
    box = Box(
        name="box",
        size=np.array([1.0, 1.2, 0.25]),
        centre=np.array([0.85, 0.0, 0.14]),
        rotation=matrix_from_rpy([0.06, -0.05, 0.5]),
    )
    ik = IK(build_world(load_robot("coman"), Scene(boxes=(box,), start=np.zeros(3))))
    top = ik.world.supports["box"]
    p = np.array([0.42, 0.15, 0.0])
    p[2] = (top.normal @ top.position - top.normal[:2] @ p[:2]) / top.normal[2]
    return ik, task_of(ik, on_box("LHand", *p))


@pytest.mark.parametrize("name", METHODS)
def test_a_yawed_and_tilted_box_is_climbed_alike(askew, name):
    ik, task = askew
    top = ik.world.supports["box"]
    k = METHODS[name](ik, task, ik.world.home, KeyframeOptions())
    assert k.status is Status.SOLVED
    assert k.cost_after < 0.2 * k.cost_before
    found = k.contacts[-1].contact.position
    assert top.height(found) == pytest.approx(0.0, abs=5e-4)
    assert top.inside(found, EDGE_INSET - 1e-4)


def test_outer_methods_see_the_gradient_in_the_supports_own_plane(
    askew, finite_difference
):
    ik, task = askew
    top = ik.world.supports["box"]
    outer = Alternation(ik, task, ik.world.home, KeyframeOptions())
    x = outer.start()
    np.testing.assert_allclose(outer.positions(x)[0], task.new[0].position, atol=1e-9)
    _, grad = outer.evaluate(x)
    q = ik.kin.q
    mass = located(ik.world, q).body("LShr").xpos
    reached = top.rotation.T @ (new_positions(ik.kin, task)[0] - top.position)

    def cost(local: np.ndarray) -> float:
        e = (top.position + top.rotation[:, :2] @ local - mass)[:2]
        return 5.0 * float(e @ e)

    numeric = finite_difference(cost, reached[:2])
    np.testing.assert_allclose(grad.ravel(), numeric, atol=1e-4)


def test_more_weight_on_stability_brings_the_contact_closer_to_its_mass(ik):
    """Far from where the arm can be upright, stability competes with the reference."""
    task = task_of(ik, on_box("LHand", 0.6, 0.3))
    distances = []
    for weight in (0.05, 1.0, 20.0):
        options = KeyframeOptions(stability_weight=weight)
        k = direct(ik, task, ik.world.home, options)
        assert k.status is Status.SOLVED
        distances.append(k.contacts[-1].projected_distance)
    assert distances[0] > distances[1] > distances[2]


def test_more_weight_on_the_reference_keeps_the_contact_there(ik):
    wanted = np.array([0.6, 0.3])
    gaps = []
    for weight in (0.1, 1.5, 20.0):
        options = KeyframeOptions(reference_weight=weight)
        task = task_of(ik, on_box("LHand", *wanted))
        k = direct(ik, task, ik.world.home, options)
        gaps.append(np.linalg.norm(k.contacts[-1].contact.position[:2] - wanted))
    assert gaps[0] > gaps[1] > gaps[2]


def test_a_demonstrated_direction_is_followed(ik):
    task = task_of(ik, on_box("LHand", 0.43, 0.17))
    lean = np.array([math.sin(0.7), 0.0, math.cos(0.7)])
    angles = []
    for directions in ({}, {"trunk": lean}):
        k = direct(
            ik,
            replace(task, directions=directions),
            ik.world.home,
            KeyframeOptions(direction_weight=1.0),
        )
        assert k.status is Status.SOLVED
        data = located(ik.world, k.q)
        low, high = (
            (data.body(f"L{n}").xpos + data.body(f"R{n}").xpos) / 2
            for n in ("ThighUpLeg", "Shr")
        )
        trunk = (high - low) / np.linalg.norm(high - low)
        angles.append(math.acos(trunk @ lean))
    assert angles[1] < 0.5 * angles[0]


# Stopping.


@pytest.mark.parametrize("name", OUTER)
@pytest.mark.parametrize(
    ("options", "most"),
    [
        ({"delta_stop": 1e3}, 1),  # the cost never changes by as much
        ({"gradient_stop": 1e3}, 0),  # flat enough from the start
        ({"max_iterations": 2}, 2),
    ],
    ids=["delta", "gradient", "cap"],
)
def test_each_rule_stops_by_itself(ik, results, name, options, most):
    task = task_of(ik, on_box("LHand", 0.43, 0.17))
    k = OUTER[name](ik, task, ik.world.home, KeyframeOptions(**options))
    assert k.iterations <= most < results[name].iterations
    assert k.status is Status.SOLVED  # stopped early, still closed and balanced
    assert k.cost_after < k.cost_before


@pytest.mark.parametrize("name", METHODS)
def test_nothing_new_to_optimise_is_no_mistake(ik, name):
    k = METHODS[name](ik, task_of(ik), ik.world.home, KeyframeOptions())
    assert k.status is Status.SOLVED
    assert k.cost_before == k.cost_after == 0.0
    assert len(k.contacts) == 2


@pytest.mark.parametrize("name", METHODS)
def test_the_same_task_has_the_same_keyframe_to_the_bit(ik, results, name):
    task = task_of(ik, on_box("LHand", 0.43, 0.17))
    fresh = IK(ik.world)
    again = METHODS[name](fresh, task, ik.world.home, KeyframeOptions())
    np.testing.assert_array_equal(again.q, results[name].q)
    assert again.cost_after == results[name].cost_after


# Failures are named.


def test_a_box_that_is_too_far_is_unreachable():
    box = Box(
        name="box",
        size=np.array([1.0, 1.2, 0.275]),
        centre=np.array([2.0, 0.0, 0.1375]),
        rotation=np.eye(3),
    )
    far = IK(build_world(load_robot("coman"), Scene(boxes=(box,), start=np.zeros(3))))
    task = task_of(far, on_box("LHand", 1.6, 0.1))
    k = direct(far, task, far.world.home, KeyframeOptions())
    assert k.status is Status.UNREACHABLE


def test_a_fixed_contact_stays_where_it_is_said_to_be(ik):
    wanted = on_box("LHand", 0.40, 0.2)
    task = task_of(ik, wanted, fixed=True)
    k = direct(ik, task, ik.world.home, KeyframeOptions())
    assert k.status is Status.SOLVED
    found = k.contacts[-1].contact.position
    np.testing.assert_allclose(found, wanted.position, atol=5e-4)


# The problem that all share.


def test_a_keyframes_problem_holds_what_it_held_and_closes_what_is_new(ik):
    hand = on_box("LHand", 0.43, 0.17)
    task = task_of(ik, hand)
    tasks = prescribed(ik.world, task, np.array([[0.4, 0.1, 0.275]]))
    problem = keyframe_problem(ik.world, task, KeyframeOptions(), tasks)
    left, right, new = problem.tasks
    for foot, c in zip((left, right), task.held, strict=True):
        assert isinstance(foot, Closed)
        assert foot.contact is c
    assert isinstance(new, Sliding)
    np.testing.assert_array_equal(new.contact.position, [0.4, 0.1, 0.275])
    name = ik.world.model.geom
    may_touch = {
        frozenset(name(int(g)).name for g in pair)
        for pair, c in zip(ik.world.pairs, problem.clearance, strict=True)
        if np.isinf(c)
    }
    assert may_touch == {
        frozenset(("LFoot", "ground")),
        frozenset(("RFoot", "ground")),
        frozenset(("LHand", "box")),
    }


def test_new_positions_are_where_the_surfaces_touch(ik):
    ik.kin.update(ik.world.home)
    data = located(ik.world, ik.world.home)
    task = task_of(ik, on_box("LHand", 0.4, 0.2), on_box("RKnee", 0.3, -0.1))
    expected = [
        data.geom("LHand").xpos - 0.02 * UP,
        data.geom("RKnee").xpos - 0.06 * UP,
    ]
    np.testing.assert_allclose(new_positions(ik.kin, task), expected, atol=1e-9)
    assert new_positions(ik.kin, task_of(ik)).shape == (0, 3)


def test_the_drift_of_a_contact_is_zero_where_it_was_made(ik, results):
    k = results["direct"]
    ik.kin.update(k.q)
    hand = k.contacts[-1].contact
    assert contact_drift(ik.kin, hand) == pytest.approx(0.0, abs=1e-5)
    q = k.q.copy()
    q[:3] += [0.003, 0.0, 0.004]
    ik.kin.update(q)
    assert contact_drift(ik.kin, hand) == pytest.approx(0.005, abs=1e-5)


def test_a_contact_that_does_not_reach_its_support_is_open(ik):
    """The home posture, said to have a hand on the box that it does not touch."""
    task = task_of(ik, on_box("LHand", 0.43, 0.17))
    home = ik.world.home
    k = finish(
        ik,
        task,
        KeyframeOptions(),
        home,
        method="none",
        iterations=0,
        cost_before=0.0,
    )
    assert k.status is Status.UNREACHABLE
    gap = located(ik.world, home).geom("LHand").xpos[2] - 0.02 - 0.275
    assert gap > 0.1
    assert k.residuals.contact == pytest.approx(gap, abs=1e-9)
    assert k.contacts[-1].contact.position[2] == pytest.approx(0.275, abs=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.3, 0.05, 0.01])
def test_what_holds_is_what_the_margin_says(ik, results, share):
    """Weaker and weaker joints: both checks turn at the same place."""
    k = results["direct"]
    weak = replace(ik.world, tau_max=share * ik.world.tau_max)
    kin = Kinematics(weak)
    assert is_stable(kin, k.q, k.stance) == (share >= 0.3)
    assert equilibrium_at(kin, k.q, k.stance).feasible == (share >= 0.3)


def test_holding_leaves_weak_joints_what_a_misplaced_contact_costs():
    """A quarter of the weight 16 mm off: little to a knee, much to a wrist."""
    world = build_world(load_robot("coman29"), Scene.from_height(0.275))
    kin = Kinematics(world)
    hand = Contact(
        surface="LHand", support="ground", position=np.zeros(3), quaternion=np.eye(4)[0]
    )
    bears = statics_at(kin, world.home, (hand,))[2]
    cost = 0.25 * 0.016 * world.mass * 9.81
    arm = [
        n.startswith(("L", "Waist")) and not any(x in n for x in ("Hip", "Kn", "Ank"))
        for n in world.joints
    ]
    for name, limit, effort, loaded in zip(
        world.joints, bears.limits, world.tau_max, arm, strict=True
    ):
        assert limit == pytest.approx(0.9 * effort - cost * loaded), name
    assert bears.limits.min() < 0.7 * 5.0
    weak = replace(world, tau_max=0.01 * world.tau_max)
    least = statics_at(Kinematics(weak), world.home, (hand,))[2].limits[arm]
    assert np.all(least == 0.25 * weak.tau_max[arm])
