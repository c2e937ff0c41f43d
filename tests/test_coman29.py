"""COMAN with 29 joints: forearms and wrists against figures, the rest against 23."""

from __future__ import annotations

import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import clamber
from test_coman import (
    HOMING,
    JOINTS,
    MASSES,
    POSITIONS,
    SIDES,
    SURFACES,
    X,
    Y,
    Z,
    box_of,
    closest,
    far_pairs,
    joints_between,
    mirrored,
    pose,
    reach,
    solid,
    volume,
)

ROBOTS = Path(clamber.__file__).parent / "model" / "robots"
FOLDER = ROBOTS / "coman29"

# joint: axis, lower, upper [rad].
NEW_JOINTS = {
    "RForearmPlate": (Z, -1.5708, 1.5708),
    "RWrj1": (Y, -0.524, 0.524),
    "RWrj2": (X, -1.395, 0.785375),
    "LForearmPlate": (Z, -1.5708, 1.5708),
    "LWrj1": (Y, -0.524, 0.524),
    "LWrj2": (X, -0.785375, 1.395),
}

# left body: x, y, z at zero configuration, soles at z = 0 [m].
NEW_POSITIONS = {
    "LForearm": (0.0053, 0.1558, 0.5533),
    "LWrMot2": (0.0053, 0.1558, 0.4664),
    "LWrMot3": (0.0053, 0.1558, 0.4664),
}

# left body: kilograms; the ball has those of the soft hand, 0.30.
NEW_MASSES = {
    "LElb": 0.63307,
    "LForearm": 0.93352,
    "LWrMot2": 0.26071,
    "LWrMot3": 0.05401 + 0.30,
}

# left body: lower and upper corner of the published shell in its frame [m].
NEW_EXTENTS = {
    "LElb": ((-0.051, -0.036, -0.047), (0.0364, 0.036, 0.0365)),
    "LForearm": ((-0.0641, -0.0541, -0.0712), (0.0501, 0.0542, 0.0718)),
    "LWrMot2": ((-0.0334, -0.0205, -0.019), (0.0452, 0.0273, 0.0184)),
}

ARM = ("Elb", "Forearm", "WrMot2", "WrMot3")
BALL_BELOW_WRIST = 0.03  # [m]
HAND_BELOW_WRIST = 0.07  # [m] of the soft hand, in whose place the ball is


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The robot alone."""
    return mujoco.MjModel.from_xml_path(str(FOLDER / "coman29.xml"))


@pytest.fixture(scope="module")
def smaller() -> mujoco.MjModel:
    """The robot with 23 joints."""
    return mujoco.MjModel.from_xml_path(str(ROBOTS / "coman" / "coman.xml"))


@pytest.fixture(scope="module")
def robot() -> dict:
    """`robot.yaml` as a mapping."""
    return yaml.safe_load((FOLDER / "robot.yaml").read_text())


def order_of_joints() -> list[str]:
    """As published: each arm's new joints follow its elbow."""
    out = []
    for name in JOINTS:
        out.append(name)
        if name.endswith("Elbj"):
            out += [n for n in NEW_JOINTS if n[0] == name[0]]
    return out


# Figures.


def test_links_stand_where_the_published_table_has_them(model):
    data = pose(model, {})
    for name, p in (POSITIONS | NEW_POSITIONS).items():
        np.testing.assert_allclose(data.body(name).xpos, p, atol=1e-4, err_msg=name)
        q = np.array(p) * (1, -1 if name.startswith("L") else 1, 1)
        np.testing.assert_allclose(data.body(mirrored(name)).xpos, q, atol=1e-4)
    np.testing.assert_allclose(data.xmat, np.tile(np.eye(3).ravel(), (model.nbody, 1)))


def test_the_wrist_is_0_1947_m_from_the_elbow_axis_and_the_ball_0_03_below(model):
    data = pose(model, {})
    for side, _ in SIDES:
        elbow, wrist = (data.body(side + n).xpos for n in ("Elb", "WrMot3"))
        assert elbow[2] - wrist[2] == pytest.approx(0.1947, abs=1e-4)
        np.testing.assert_allclose(
            data.geom(side + "Hand").xpos - wrist, (0, 0, -BALL_BELOW_WRIST), atol=1e-9
        )
        assert model.geom(side + "Hand").size[0] == 0.02


def test_mass_is_31_46_and_the_com_published_but_for_the_higher_hands(model):
    """Two hands of 0.30 kg are 0.04 m higher: the CoM rises by 0.76 mm."""
    data = pose(model, {})
    mass = model.body_mass.sum()
    assert mass == pytest.approx(31.4639, abs=1e-3)
    raised = 2 * 0.30 * (HAND_BELOW_WRIST - BALL_BELOW_WRIST) / mass
    com = data.subtree_com[model.body("Waist").id]
    published = np.array([-0.0006, -0.0001, 0.5372])
    np.testing.assert_allclose(com, published, atol=1e-3)
    np.testing.assert_allclose(com - (0, 0, raised), published, atol=1e-4)


def test_every_body_has_the_mass_of_its_links(model):
    for name, mass in (MASSES | NEW_MASSES).items():
        assert model.body(name).mass[0] == pytest.approx(mass, abs=2e-5), name
        assert model.body(mirrored(name)).mass[0] == pytest.approx(mass, abs=2e-5)


def test_wrist_and_ball_are_one_body_by_the_parallel_axis_theorem(model):
    m1, m2, r = 0.05401, 0.30, 0.02
    com = -m2 * BALL_BELOW_WRIST / (m1 + m2)
    own = 2.16e-5 + 0.4 * m2 * r**2  # a sphere's
    across = own + m1 * com**2 + m2 * (BALL_BELOW_WRIST + com) ** 2
    for side, _ in SIDES:
        b = model.body(side + "WrMot3")
        np.testing.assert_allclose(b.ipos, (0, 0, com), atol=1e-5)
        np.testing.assert_allclose(b.inertia, (across, across, own), rtol=1e-3)
        assert b.iquat == pytest.approx((1, 0, 0, 0))


def test_joints_have_their_order_axes_and_ranges(model):
    assert [model.joint(j).name for j in range(model.njnt)] == [
        "root",
        *order_of_joints(),
    ]
    assert (model.nq, model.nv, model.nu) == (36, 35, 0)
    for name, (axis, lower, upper) in (JOINTS | NEW_JOINTS).items():
        j = model.joint(name)
        np.testing.assert_allclose(j.axis, axis, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(j.range, (lower, upper), atol=1e-9, err_msg=name)
        assert model.jnt_limited[j.id]


def test_forearm_and_wrist_have_a_tenth_of_the_effort(model):
    for name in order_of_joints():
        j, dof = model.joint(name), model.joint(name).dofadr[0]
        effort, damping = (5.0, 0.03) if name in NEW_JOINTS else (50.0, 3.0)
        assert tuple(model.jnt_actfrcrange[j.id]) == (-effort, effort)
        assert model.dof_damping[dof] == damping
        assert 0 < model.dof_armature[dof] <= 0.001 * effort
    assert not model.dof_damping[:6].any()
    assert not model.dof_frictionloss.any()


@pytest.mark.parametrize(
    ("joint", "angle", "axis", "sign"),
    [
        ("LWrj1", -0.5, 0, 1),  # hand forward
        ("RWrj1", -0.5, 0, 1),
        ("LWrj2", 0.5, 1, 1),  # hand out
        ("RWrj2", -0.5, 1, -1),
    ],
)
def test_wrists_turn_as_elbows_and_shoulders_do(model, joint, angle, axis, sign):
    hand = joint[0] + "Hand"
    before = pose(model, {}).geom(hand).xpos
    moved = pose(model, {joint: angle}).geom(hand).xpos - before
    assert sign * moved[axis] == pytest.approx(BALL_BELOW_WRIST * np.sin(0.5))


def test_a_turning_forearm_turns_the_wrist_and_not_the_ball(model):
    straight, turned = pose(model, {}), pose(model, {"LForearmPlate": 1.0})
    ball, wrist = (model.geom(n).id for n in ("LHand", "LWrist"))
    np.testing.assert_allclose(turned.geom_xpos[ball], straight.geom_xpos[ball])
    assert np.linalg.norm(turned.geom_xpos[wrist] - straight.geom_xpos[wrist]) > 0.004


def test_all_but_the_arms_beyond_the_elbow_is_the_robot_with_23_joints(model, smaller):
    for i in range(1, smaller.nbody):
        theirs = smaller.body(i)
        ours = model.body(theirs.name)
        assert model.body(ours.parentid[0]).name == (
            smaller.body(theirs.parentid[0]).name
        )
        np.testing.assert_array_equal(ours.pos, theirs.pos)
        if not theirs.name.endswith("Elb"):
            np.testing.assert_array_equal(ours.inertia, theirs.inertia)
            np.testing.assert_array_equal(ours.ipos, theirs.ipos)
    for g in range(smaller.ngeom):
        name = smaller.geom(g).name
        if name.endswith(("Hand", "_forearm")):
            continue
        np.testing.assert_array_equal(model.geom(name).size, smaller.geom(g).size)
        np.testing.assert_array_equal(model.geom(name).pos, smaller.geom(g).pos)


# Shape.


def test_hand_and_elbow_are_surfaces_of_different_links(model):
    bodies = {"Hand": "WrMot3", "Elbow": "Elb", "Knee": "LowLeg", "Foot": "Foot"}
    for surface in SURFACES:
        geoms = [
            model.geom(g)
            for g in range(model.ngeom)
            if model.geom(g).name == surface
            or model.geom(g).name.startswith(surface + "_")
        ]
        assert {model.body(g.bodyid[0]).name for g in geoms} == {
            surface[0] + bodies[surface[1:]]
        }
        assert all(g.contype[0] and g.conaffinity[0] for g in geoms)


@pytest.mark.parametrize("body", NEW_EXTENTS)
def test_links_fill_their_published_extents(model, body):
    data = pose(model, {})
    mine = [g for g in solid(model) if model.body(model.geom_bodyid[g]).name == body]
    bounds = np.array([box_of(model, data, g) for g in mine])
    ours = np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)]) - data.body(body).xpos
    np.testing.assert_allclose(ours, NEW_EXTENTS[body], atol=0.010)


def test_no_heavy_link_is_a_ghost(model):
    bodies = {int(model.geom_bodyid[g]) for g in solid(model)}
    assert {b for b in range(1, model.nbody) if model.body_mass[b] > 0.8} <= bodies | {
        model.body(s + n).id for s, _ in SIDES for n in ("HipMot",)
    }
    assert 3000.0 * sum(volume(model, g) for g in solid(model)) >= 31.5


@pytest.mark.parametrize("tilt", np.radians([0.0, 20.0, 40.0, 50.0]))
def test_the_ball_touches_before_wrist_and_housing(model, tilt):
    """Of a forearm that leans forward, back or sideways by up to 50 degrees."""
    data = pose(model, {})
    for heading in np.radians(np.arange(0, 360, 45)):
        n = np.array([0.0, 0.0, -np.cos(tilt)])
        n[:2] = np.sin(tilt) * np.array([np.cos(heading), np.sin(heading)])
        ball = reach(model, data, model.geom("LHand").id, n)
        for other in ("LWrist", "LForearm"):
            assert reach(model, data, model.geom(other).id, n) < ball


def test_an_elbow_can_bear_with_the_forearm_raised_by_20_degrees(model):
    """Its housing is thicker than the elbow: a level forearm would rest on that."""
    data = pose(model, {})
    gaps = []
    for raised in np.radians([0.0, 20.0]):
        n = np.array([-np.cos(raised), 0.0, np.sin(raised)])
        elbow, housing = (
            reach(model, data, model.geom(name).id, n)
            for name in ("LElbow", "LForearm")
        )
        gaps.append(elbow - housing)
    assert gaps[0] < 0 < gaps[1]


# The robot and itself.


def test_only_neighbours_are_excused_from_touching(model):
    for signature in model.exclude_signature:
        a, b = int(signature) >> 16, int(signature) & 0xFFFF
        assert joints_between(model, a, b) <= 2


@pytest.mark.parametrize("posture", ["arms out", "homing", "home"])
def test_no_part_is_near_another_in_ordinary_postures(model, robot, posture):
    """At zero the forearms meet the thighs, as their published shells do."""
    arms_out = {"LShLat": 0.2, "RShLat": -0.2}
    angles = {"arms out": arms_out, "homing": HOMING, "home": robot["home"]}[posture]
    data = pose(model, angles)
    gap, a, b = closest(model, data, far_pairs(model))
    assert gap > 0.005, (a, b)
    assert data.ncon == 0


def test_at_zero_only_forearms_and_thighs_overlap_and_so_do_the_shells(model):
    data = pose(model, {})
    met = {
        frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name))
        for c in data.contact[: data.ncon]
    }
    assert met == {frozenset((s + "Forearm", s + "Hip")) for s, _ in SIDES}
    thigh = 0.0726 + 0.0649  # the published shells reach as far, to the side
    forearm = 0.1558 - 0.0541
    assert forearm < thigh


@pytest.mark.parametrize("plate", [-1.5708, 0.0, 1.5708])
@pytest.mark.parametrize("bend", [0.0, -1.2, -2.3562])
def test_a_folded_arm_overlaps_itself_by_no_more_than_its_shells(model, bend, plate):
    """Forearm and upper arm are two joints apart: up to 13 mm at the fold's limit."""
    wrists = itertools.product((-0.524, 0.524), (-0.785375, 1.395))
    arm = [g for g in solid(model) if model.geom(g).name.startswith("L")]
    upper = model.geom("LUpperArm").id
    for j1, j2 in wrists:
        data = pose(
            model,
            {
                "LShLat": 0.6,
                "LElbj": bend,
                "LForearmPlate": plate,
                "LWrj1": j1,
                "LWrj2": j2,
            },
        )
        for g in arm:
            body = model.body(model.geom_bodyid[g]).name
            if body[1:] in ARM[1:]:
                gap = mujoco.mj_geomDistance(model, data, g, upper, 0.5, None)
                assert gap > (-0.013 if bend < -2.0 else 0.0), (body, gap)


# Robot.yaml.


def test_the_description_is_the_smaller_robots_with_gains_for_the_wrists(robot):
    smaller = yaml.safe_load((ROBOTS / "coman" / "robot.yaml").read_text())
    assert robot["name"] == "coman29"
    for field in ("base", "home", "limbs", "surfaces"):
        assert robot[field] == smaller[field]
    assert robot["gains"]["default"] == smaller["gains"]["default"]
    assert set(robot["gains"]) == {"default", *NEW_JOINTS}
    loaded = clamber.load_robot("coman29")
    assert loaded.gains["LWrj1"] == (200.0, 2.0, 1.0)
    assert set(loaded.surfaces) == set(SURFACES)


def test_wrist_gains_are_near_critical_damping_and_slow_for_the_physics(model, robot):
    data = pose(model, {})
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    for name in ("LWrj1", "LWrj2", "RWrj1", "RWrj2"):
        dof = model.joint(name).dofadr[0]
        gains, inertia = robot["gains"][name], M[dof, dof]
        omega = np.sqrt(gains["kp"] / inertia)
        damping = gains["kd"] + model.dof_damping[dof]
        assert 0.8 < damping / (2 * omega * inertia) < 1.3
        assert omega * 0.001 < 0.3  # [rad] of the oscillation in one step
        # Half the weight on the ball does not tip it over the wrist.
        assert gains["kp"] > 5 * 0.5 * 31.5 * 9.81 * (BALL_BELOW_WRIST + 0.02)


def test_home_has_level_soles_and_the_weight_over_them(model, robot):
    data = pose(model, robot["home"])
    np.testing.assert_allclose(data.body("LFoot").xmat, np.eye(3).ravel(), atol=1e-9)
    ankle = data.body("LFoot").xpos
    com = data.subtree_com[model.body("Waist").id] - ankle
    assert 0.02 <= com[0] <= 0.04  # soles from -0.07 to 0.13
    # Clear of a box 0.40 m high that begins 0.23 m before the ankles.
    for g in solid(model):
        bounds = box_of(model, data, g)
        low, front = bounds[0, 2] - ankle[2] + 0.09, bounds[1, 0] - ankle[0]
        assert low > 0.40 or front < 0.23 - 0.05, model.geom(g).name


def test_home_stands_by_itself_after_a_small_drop(robot):
    world = clamber.build_world(
        clamber.load_robot("coman29"), clamber.Scene(boxes=(), start=(0.0, 0.0, 0.0))
    )
    model = world.model
    data = mujoco.MjData(model)
    data.qpos[:] = world.home
    data.qpos[2] += 0.01
    start = data.qpos.copy()
    data.ctrl[[model.actuator(n).id for n in world.joints]] = start[world.qadr]
    for _ in range(1500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[7:] - start[7:]).max() < 0.05
    assert data.qpos[:3] == pytest.approx(start[:3], abs=0.02)
    assert data.body("Waist").xmat[8] > np.cos(np.radians(3))
    assert np.abs(data.qvel).max() < 0.02
    touching = {
        model.geom(g).name
        for c in data.contact
        for g in c.geom
        if c.efc_address >= 0 and model.geom_bodyid[g]
    }
    assert touching == {"LFoot", "RFoot"}
    for name in NEW_JOINTS:
        assert abs(data.actuator(name).force[0]) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.25, 0.31])
def test_it_climbs_on_elbows_and_knees_within_its_wrists_effort(height):
    scene = clamber.Scene.from_height(height)
    sequence = clamber.detect_contacts(clamber.load_demo("climb"))
    plan = clamber.plan(sequence, clamber.load_robot("coman29"), scene)
    assert plan.complete
    last = {c.surface for c in plan.keyframes[-1].stance}
    assert last == {"LElbow", "RElbow", "LKnee", "RKnee"}
    rollout = clamber.simulate(plan)
    assert clamber.judge(plan, rollout).reached
    wrists = [plan.world.model.actuator(n).id for n in NEW_JOINTS]
    assert np.abs(rollout.actuator_force[:, wrists]).max() < 4.0  # of 5 N m
