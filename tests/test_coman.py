"""COMAN with 23 and 29 joints against published figures, and on its feet."""

from __future__ import annotations

import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import clamber
from clamber.model.robot import ROBOTS, load_robot
from clamber.model.scene import Scene
from clamber.model.tree import geom_volume
from clamber.model.world import build_world

FIGURES = yaml.safe_load((Path(__file__).parent / "data" / "coman.yaml").read_text())
NAMES = tuple(FIGURES)
SURFACES = ("LHand", "RHand", "LElbow", "RElbow", "LKnee", "RKnee", "LFoot", "RFoot")
WRISTS = tuple(n for n in FIGURES["coman29"]["joints"] if "Wrj" in n or "Forearm" in n)
BALL_BELOW_WRIST = 0.03  # [m]
HAND_BELOW_WRIST = 0.07  # [m] of the soft hand, in whose place the ball is
FLIP = np.array([1.0, -1.0, 1.0])


def both_sides(left: dict[str, float]) -> dict[str, float]:
    """Joint angles of the left side and their mirror image on the right."""
    flips = ("Lat", "Yaw")
    right = {"R" + n[1:]: -a if n.endswith(flips) else a for n, a in left.items()}
    return left | right


HOMING = both_sides(
    {"LShSag": 0.5, "LShLat": 0.5, "LShYaw": -0.3, "LElbj": -1.57}
    | {"LHipSag": -0.45, "LKneeSag": 0.90, "LAnkSag": -0.45}
)
ALONE = {n: mujoco.MjModel.from_xml_path(str(load_robot(n).path)) for n in NAMES}


@pytest.fixture(params=NAMES)
def name(request) -> str:
    """Of a robot."""
    return request.param


@pytest.fixture
def model(name) -> mujoco.MjModel:
    """The robot alone."""
    return ALONE[name]


@pytest.fixture
def figures(name) -> dict:
    """What is published of it."""
    return FIGURES[name]


@pytest.fixture
def home(name) -> dict[str, float]:
    """The posture that it starts from."""
    return dict(load_robot(name).home)


def pose(model: mujoco.MjModel, angles: dict[str, float]) -> mujoco.MjData:
    """Kinematics with those joint angles, the pelvis upright at its zero height."""
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    return data


def solid(model: mujoco.MjModel) -> list[int]:
    """Ids of the geoms that collide."""
    return [g for g in range(model.ngeom) if model.geom_contype[g]]


def box_of(model: mujoco.MjModel, data: mujoco.MjData, g: int) -> np.ndarray:
    """(2, 3) axis-aligned bounds of a geom in the world [m]."""
    kind, size = model.geom_type[g], model.geom_size[g]
    R = np.abs(data.geom_xmat[g].reshape(3, 3))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        half = R @ size
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        half = R[:, 2] * size[1] + size[0]
    else:
        half = np.full(3, size[0])
    return np.stack([data.geom_xpos[g] - half, data.geom_xpos[g] + half])


def reach(model: mujoco.MjModel, data: mujoco.MjData, g: int, n: np.ndarray) -> float:
    """Support function of a geom: how far it goes along the direction n (3,) [m]."""
    kind, size = model.geom_type[g], model.geom_size[g]
    R = data.geom_xmat[g].reshape(3, 3)
    centre = float(data.geom_xpos[g] @ n)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return centre + float(np.abs(n @ R) @ size)
    axis = size[1] * abs(float(n @ R[:, 2]))
    return centre + size[0] + (axis if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0)


def joints_between(model: mujoco.MjModel, a: int, b: int) -> int:
    """Number of joints on the way from one body to another."""

    def chain(x: int) -> list[int]:
        out = [x]
        while out[-1]:
            out.append(int(model.body_parentid[out[-1]]))
        return out

    up, other = chain(a), chain(b)
    shared = next(x for x in up if x in other)
    return up.index(shared) + other.index(shared)


def far_pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of colliding geoms with more than two joints between them."""
    body = model.geom_bodyid
    return [
        (a, b)
        for a, b in itertools.combinations(solid(model), 2)
        if joints_between(model, body[a], body[b]) > 2
    ]


def closest(
    model: mujoco.MjModel, data: mujoco.MjData, pairs: list[tuple[int, int]]
) -> tuple[float, str, str]:
    """Smallest distance [m] of the pairs and whose it is."""
    return min(
        (
            mujoco.mj_geomDistance(model, data, a, b, 0.5, None),
            model.geom(a).name,
            model.geom(b).name,
        )
        for a, b in pairs
    )


def mirrored(name: str) -> str:
    """The same part of the right side."""
    return "R" + name[1:] if name.startswith("L") else name


# Figures.


def test_links_are_where_the_published_table_has_them_and_as_heavy(model, figures):
    data = pose(model, {})
    for name, p in figures["positions"].items():
        np.testing.assert_allclose(data.body(name).xpos, p, atol=1e-4, err_msg=name)
        q = p * FLIP if name.startswith("L") else p
        np.testing.assert_allclose(data.body(mirrored(name)).xpos, q, atol=1e-4)
    for name, mass in figures["masses"].items():
        assert model.body(name).mass[0] == pytest.approx(mass, abs=2e-5), name
        assert model.body(mirrored(name)).mass[0] == pytest.approx(mass, abs=2e-5)
    # At zero, all frames are parallel.
    np.testing.assert_allclose(data.xmat, np.tile(np.eye(3).ravel(), (model.nbody, 1)))


def test_mass_and_centre_of_mass_are_the_published_ones():
    model = ALONE["coman"]
    com = pose(model, {}).subtree_com[model.body("Waist").id]
    assert model.body_mass.sum() == pytest.approx(28.8934, abs=1e-3)
    np.testing.assert_allclose(com, (-0.0011, -0.0001, 0.5423), atol=5e-4)
    # Two hands of 0.30 kg are 0.04 m higher than the soft hands.
    model = ALONE["coman29"]
    com, mass = pose(model, {}).subtree_com[model.body("Waist").id], 31.4639
    assert model.body_mass.sum() == pytest.approx(mass, abs=1e-3)
    raised = 2 * 0.30 * (HAND_BELOW_WRIST - BALL_BELOW_WRIST) / mass
    np.testing.assert_allclose(com, (-0.0006, -0.0001, 0.5372 + raised), atol=1e-4)


def test_a_forearm_and_its_elbow_are_one_body_by_the_parallel_axis_theorem():
    model = ALONE["coman"]
    parts = (
        (0.63307, (-0.00066, 0.00093, -0.00093), (2.260e-4, 2.778e-4, 2.188e-4)),
        (0.26300, (-0.015, 0.0, -0.05 - 0.085), (6.913e-4, 6.913e-4, 4.043e-5)),
    )
    mass = sum(m for m, _, _ in parts)
    com = sum(m * np.array(c) for m, c, _ in parts) / mass
    inertia = np.zeros((3, 3))
    for m, c, diagonal in parts:
        d = np.array(c) - com
        inertia += np.diag(diagonal) + m * (d @ d * np.eye(3) - np.outer(d, d))
    inertia[0, 2] -= 9.801e-6  # the elbow's own; its other products are below 3e-6
    inertia[2, 0] -= 9.801e-6
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body("LElb").iquat)
    R = R.reshape(3, 3)
    ours = R @ np.diag(model.body("LElb").inertia) @ R.T
    np.testing.assert_allclose(model.body("LElb").ipos, com, atol=2e-5)
    np.testing.assert_allclose(ours, inertia, atol=5e-6)


def test_wrist_and_ball_are_one_body_by_the_parallel_axis_theorem():
    m1, m2, r = 0.05401, 0.30, 0.02
    com = -m2 * BALL_BELOW_WRIST / (m1 + m2)
    own = 2.16e-5 + 0.4 * m2 * r**2  # a sphere's
    across = own + m1 * com**2 + m2 * (BALL_BELOW_WRIST + com) ** 2
    for side in "LR":
        b = ALONE["coman29"].body(side + "WrMot3")
        np.testing.assert_allclose(b.ipos, (0, 0, com), atol=1e-5)
        np.testing.assert_allclose(b.inertia, (across, across, own), rtol=1e-3)
        assert b.iquat == pytest.approx((1, 0, 0, 0))


def test_joints_have_their_order_axes_ranges_and_efforts(model, figures):
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names == ["root", *figures["joints"]]
    for name, expected in figures["joints"].items():
        j, dof = model.joint(name), model.joint(name).dofadr[0]
        np.testing.assert_allclose(j.axis, expected["axis"], atol=1e-5, err_msg=name)
        np.testing.assert_allclose(j.range, expected["range"], atol=1e-9, err_msg=name)
        assert model.jnt_limited[j.id]
        effort, damping = (5.0, 0.03) if name in WRISTS else (50.0, 3.0)
        assert tuple(model.jnt_actfrcrange[j.id]) == (-effort, effort)
        assert model.dof_damping[dof] == damping
        assert 0 < model.dof_armature[dof] <= 0.001 * effort
    assert not model.dof_damping[:6].any()
    assert not model.dof_armature[:6].any()
    assert not model.dof_frictionloss.any()


@pytest.mark.parametrize(
    ("joint", "angle", "geom", "axis", "sign"),
    [
        ("LHipSag", -0.5, "LKnee", 0, 1),  # thigh forward
        ("LHipSag", -0.5, "LKnee", 2, 1),  # and up
        ("LKneeSag", 0.5, "LFoot", 0, -1),  # heel back
        ("LAnkSag", -0.5, "LFoot", 2, 1),  # toes up
        ("LShSag", -0.5, "LHand", 0, 1),  # arm forward
        ("LShSag", -0.5, "LHand", 2, 1),
        ("LElbj", -0.5, "LHand", 0, 1),  # forearm forward
        ("LShLat", 0.5, "LHand", 1, 1),  # arm out
        ("RShLat", -0.5, "RHand", 1, -1),
        ("LHipLat", 0.5, "LFoot", 1, 1),  # leg out
        ("RHipLat", -0.5, "RFoot", 1, -1),
        ("WaistSag", 0.5, "Torso_chest", 0, 1),  # leans forward
        ("LWrj1", -0.5, "LHand", 0, 1),  # hand forward
        ("RWrj1", -0.5, "RHand", 0, 1),
        ("LWrj2", 0.5, "LHand", 1, 1),  # hand out
        ("RWrj2", -0.5, "RHand", 1, -1),
    ],
)
def test_joints_turn_the_way_their_names_promise(joint, angle, geom, axis, sign):
    model = ALONE["coman29"]
    before = pose(model, {}).geom(geom).xpos
    after = pose(model, {joint: angle}).geom(geom).xpos
    assert sign * (after[axis] - before[axis]) > 0.005


def test_a_turning_forearm_turns_the_wrist_and_not_the_ball():
    model = ALONE["coman29"]
    straight, turned = pose(model, {}), pose(model, {"LForearmPlate": 1.0})
    ball, wrist = (model.geom(n).id for n in ("LHand", "LWrist"))
    np.testing.assert_allclose(turned.geom_xpos[ball], straight.geom_xpos[ball])
    assert np.linalg.norm(turned.geom_xpos[wrist] - straight.geom_xpos[wrist]) > 0.004


def test_all_but_the_arms_beyond_the_elbow_is_the_robot_with_23_joints():
    smaller, model = (ALONE[n] for n in NAMES)
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


def test_the_shape_is_made_of_named_primitives_of_hard_rubber(model):
    kinds = mujoco.mjtGeom
    primitives = {kinds.mjGEOM_BOX, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_SPHERE}
    assert {kinds(t) for t in model.geom_type} <= primitives
    names = [model.geom(g).name for g in range(model.ngeom)]
    assert all(names)
    assert len(set(names)) == len(names)
    for g in solid(model):
        assert np.all(model.geom_friction[g] <= (1.0, 0.05, 0.005))
        assert model.geom_condim[g] in (3, 4)
        assert model.geom_solref[g] == pytest.approx((0.005, 1.0))
        assert model.geom_margin[g] == 0
        assert (model.geom_contype[g], model.geom_conaffinity[g]) == (1, 1)
    looks = [g for g in range(model.ngeom) if not model.geom_contype[g]]
    assert not model.geom_conaffinity[looks].any()


def test_each_surface_is_one_part_of_one_body(name, model):
    bodies = {"Hand": "Elb", "Elbow": "Elb", "Knee": "LowLeg", "Foot": "Foot"}
    if name == "coman29":
        bodies["Hand"] = "WrMot3"
    for surface in SURFACES:
        geoms = [
            g
            for g in solid(model)
            if model.geom(g).name == surface
            or model.geom(g).name.startswith(surface + "_")
        ]
        found = {model.body(model.geom_bodyid[g]).name for g in geoms}
        assert found == {surface[0] + bodies[surface[1:]]}


def test_hands_and_feet_have_their_published_shape():
    for side in "LR":
        hand, foot = (ALONE["coman"].geom(side + n) for n in ("Hand", "Foot"))
        np.testing.assert_allclose(hand.pos, (-0.015, 0, -0.205))
        assert hand.size[0] == ALONE["coman29"].geom(side + "Hand").size[0] == 0.020
        np.testing.assert_allclose(foot.pos, (0.03, 0, -0.07))
        np.testing.assert_allclose(foot.size, (0.10, 0.05, 0.02))
        data = pose(ALONE["coman29"], {})
        wrist = data.body(side + "WrMot3").xpos
        elbow = data.body(side + "Elb").xpos
        assert elbow[2] - wrist[2] == pytest.approx(0.1947, abs=1e-4)
        below = wrist - data.geom(side + "Hand").xpos
        np.testing.assert_allclose(below, (0, 0, BALL_BELOW_WRIST), atol=1e-9)


def test_links_fill_their_published_extents_and_the_whole_its_height(model, figures):
    data, bounds = pose(model, {}), {}
    for g in solid(model):
        body = model.body(model.geom_bodyid[g]).name
        bounds.setdefault(body, []).append(box_of(model, data, g))
    for body, expected in figures["extents"].items():
        mine = np.array(bounds[body])
        ours = np.stack([mine[:, 0].min(0), mine[:, 1].max(0)]) - data.body(body).xpos
        new = body in ("LForearm", "LWrMot2")
        np.testing.assert_allclose(ours, expected, atol=0.01 if new else 0.02)
    everything = np.concatenate(list(bounds.values()))
    assert everything[:, 0, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert everything[:, 1, 2].max() == pytest.approx(0.924, abs=0.005)


def test_no_heavy_link_is_a_ghost(model):
    bodies = {int(model.geom_bodyid[g]) for g in solid(model)}
    assert {b for b in range(1, model.nbody) if model.body_mass[b] > 1.2} <= bodies
    bulk = sum(geom_volume(model, g) for g in solid(model))
    assert 3000.0 * bulk >= model.body_mass.sum()


def test_the_right_side_is_the_left_in_a_mirror():
    model = ALONE["coman"]  # the wrists of the other are published as they are
    data = pose(model, HOMING)
    for g in range(model.ngeom):
        name = model.geom(g).name
        if name.startswith("L"):
            other = model.geom("R" + name[1:])
            p = data.geom_xpos[g] * FLIP
            np.testing.assert_allclose(data.geom(other.id).xpos, p, atol=1e-5)
            np.testing.assert_allclose(other.size, model.geom_size[g])


# Surfaces touch first.


@pytest.mark.parametrize("roll", [-0.8, -0.4, 0.0, 0.4, 0.8])
def test_a_flat_forearm_rests_on_elbow_and_ball(roll):
    """The plane that both balls touch, rolled about the forearm, clears the rod."""
    model = ALONE["coman"]
    data = pose(model, {})
    elbow, ball = model.geom("LElbow"), model.geom("LHand")
    rod = model.geom("LElbow_forearm").id
    along = data.geom(ball.id).xpos - data.geom(elbow.id).xpos
    length = np.linalg.norm(along)
    along = along / length
    back = np.array([-np.cos(roll), np.sin(roll), 0.0])
    back -= along * (along @ back)
    back /= np.linalg.norm(back)
    s = (elbow.size[0] - ball.size[0]) / length
    n = s * along + np.sqrt(1 - s**2) * back
    depth = reach(model, data, elbow.id, n)
    assert reach(model, data, ball.id, n) == pytest.approx(depth, abs=1e-9)
    assert reach(model, data, rod, n) < depth - 0.005
    if roll == 0.0:
        flange = np.add(data.body("LElb").xpos, (-0.0488, 0, -0.0532))  # a disc
        assert flange @ n < depth


@pytest.mark.parametrize("bend", [-1.0, -1.57, -2.2])
def test_the_elbow_reaches_below_the_upper_arm(model, bend):
    data = pose(model, {"LElbj": bend})
    R = data.body("LElb").xmat.reshape(3, 3)
    n = -R[:, 0]  # the forearm's back side
    elbow = reach(model, data, model.geom("LElbow").id, n)
    assert elbow > reach(model, data, model.geom("LUpperArm").id, n) + 0.002


def test_a_kneeling_leg_touches_with_its_knee_first(model):
    """Thigh upright, shank level: the knee is lowest, then the shin, then the rest."""
    data = pose(model, {"LKneeSag": np.pi / 2, "LAnkSag": 1.2})
    down = np.array([0.0, 0.0, -1.0])
    depth = {
        n: reach(model, data, model.geom(n).id, down)
        for n in ("LKnee", "LKnee_shin", "LThigh", "LAnkle", "LFoot")
    }
    assert sorted(depth, key=lambda n: -depth[n])[:2] == ["LKnee", "LKnee_shin"]
    assert 0.004 < depth["LKnee"] - depth["LKnee_shin"] < 0.015
    assert 0.05 < depth["LKnee"] - (-data.body("LLowLeg").xpos[2]) < 0.065


def test_a_shank_can_lie_on_knee_and_shin(model):
    data = pose(model, {"LAnkSag": 1.2})
    knee, shin = model.geom("LKnee").id, model.geom("LKnee_shin").id
    angles = np.linspace(0, 0.2, 2001)
    normals = np.stack([np.cos(angles), 0 * angles, -np.sin(angles)], axis=1)
    gap = [reach(model, data, knee, n) - reach(model, data, shin, n) for n in normals]
    n = normals[int(np.argmin(np.abs(gap)))]
    depth = reach(model, data, knee, n)
    assert abs(min(gap, key=abs)) < 1e-4
    for other in ("LThigh", "LAnkle", "LFoot"):
        assert reach(model, data, model.geom(other).id, n) < depth


@pytest.mark.parametrize("tilt", np.radians([0.0, 20.0, 40.0, 50.0]))
def test_the_ball_touches_before_wrist_and_housing(tilt):
    """Of a forearm that leans forward, back or sideways by up to 50 degrees."""
    model = ALONE["coman29"]
    data = pose(model, {})
    for heading in np.radians(np.arange(0, 360, 45)):
        n = np.array([0.0, 0.0, -np.cos(tilt)])
        n[:2] = np.sin(tilt) * np.array([np.cos(heading), np.sin(heading)])
        ball = reach(model, data, model.geom("LHand").id, n)
        for other in ("LWrist", "LForearm"):
            assert reach(model, data, model.geom(other).id, n) < ball


def test_an_elbow_can_bear_with_the_forearm_raised_by_20_degrees():
    """Its housing is thicker than the elbow: a level forearm would rest on that."""
    model = ALONE["coman29"]
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


@pytest.mark.parametrize(
    ("a", "b", "angles"),
    [
        ("LThigh", "RThigh", {"LHipLat": -0.4363, "RHipLat": 0.4363}),
        ("LUpperArm", "Torso_front", {"LShLat": -0.31415}),
        ("LHand", "LHip", {"LShLat": -0.2}),
        ("LFoot", "RFoot", {"LHipLat": -0.4363}),
        ("LKnee", "RThigh", {"LHipLat": -0.4363, "LHipSag": -0.4}),
        ("LHand", "LThigh", {"LShSag": -0.6, "LShLat": -0.2, "LHipSag": -1.3}),
    ],
)
def test_parts_that_can_meet_do_collide(a, b, angles):
    model = ALONE["coman"]
    data = pose(model, angles)
    met = {
        frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name))
        for c in data.contact[: data.ncon]
    }
    assert frozenset((a, b)) in met


@pytest.mark.parametrize("posture", ["arms out", "homing", "home"])
def test_no_part_is_near_another_in_ordinary_postures(model, home, posture):
    arms_out = {"LShLat": 0.2, "RShLat": -0.2}
    angles = {"arms out": arms_out, "homing": HOMING, "home": home}[posture]
    data = pose(model, angles)
    gap, a, b = closest(model, data, far_pairs(model))
    assert gap > 0.005, (a, b)
    assert data.ncon == 0


def test_at_zero_only_forearms_and_thighs_overlap_and_so_do_the_shells():
    model = ALONE["coman29"]
    data = pose(model, {})
    met = {
        frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name))
        for c in data.contact[: data.ncon]
    }
    assert met == {frozenset((s + "Forearm", s + "Hip")) for s in "LR"}
    thigh = 0.0726 + 0.0649  # the published shells reach as far, to the side
    forearm = 0.1558 - 0.0541
    assert forearm < thigh


@pytest.mark.parametrize("plate", [-1.5708, 0.0, 1.5708])
@pytest.mark.parametrize("bend", [0.0, -1.2, -2.3562])
def test_a_folded_arm_overlaps_itself_by_no_more_than_its_shells(bend, plate):
    """Forearm and upper arm are two joints apart: up to 13 mm at the fold's limit."""
    model = ALONE["coman29"]
    wrists = itertools.product((-0.524, 0.524), (-0.785375, 1.395))
    arm = [g for g in solid(model) if model.geom(g).name.startswith("L")]
    upper = model.geom("LUpperArm").id
    for j1, j2 in wrists:
        arm_at = {"LShLat": 0.6, "LElbj": bend, "LForearmPlate": plate}
        data = pose(model, arm_at | {"LWrj1": j1, "LWrj2": j2})
        for g in arm:
            body = model.body(model.geom_bodyid[g]).name
            if body[1:] in ("Forearm", "WrMot2", "WrMot3"):
                gap = mujoco.mj_geomDistance(model, data, g, upper, 0.5, None)
                assert gap > (-0.013 if bend < -2.0 else 0.0), (body, gap)


@pytest.mark.parametrize("ankle", [-1.2217, 0.0, 1.2217])
@pytest.mark.parametrize("hip", [-1.9199, 0.0, 0.7854])
def test_a_folded_leg_does_not_run_into_itself(hip, ankle):
    model = ALONE["coman"]
    leg = both_sides({"LHipSag": hip, "LKneeSag": 1.9199, "LAnkSag": ankle})
    data = pose(model, leg | {"LShLat": 0.6, "RShLat": -0.6})
    gap, a, b = closest(model, data, far_pairs(model))
    assert gap > 0.005, (a, b)


def test_the_waist_turns_without_the_chest_meeting_the_pelvis():
    model, joints = ALONE["coman"], FIGURES["coman"]["joints"]
    waist = model.geom("Waist").id
    chest = [g for g in solid(model) if model.geom(g).name.startswith("Torso_")]
    ranges = [np.linspace(*joints[n]["range"], 5) for n in list(joints)[:3]]
    for angles in itertools.product(*ranges):
        data = pose(model, dict(zip(joints, angles, strict=False)))
        gap, _, b = closest(model, data, [(waist, g) for g in chest])
        assert gap > 0.005, (b, angles)


# Robot.yaml.


def test_landmarks_give_the_published_limb_lengths():
    robot, model = load_robot("coman"), ALONE["coman"]
    data = pose(model, {})

    def place(name: str) -> np.ndarray:
        is_body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) >= 0
        return data.body(name).xpos if is_body else data.geom(name).xpos

    lengths = {"arm": (np.hypot(0.18, 0.015), np.hypot(0.205, 0.015))}
    lengths["leg"] = (0.2258, 0.201)
    for name, limb in robot.limbs.items():
        root, middle, end = (place(n) for n in (limb.root, limb.middle, limb.end))
        side = 1 if name.startswith("left") else -1
        assert side * root[1] > 0
        expected = lengths[name.split("_")[1]]
        assert np.linalg.norm(root - middle) == pytest.approx(expected[0], abs=2e-4)
        assert np.linalg.norm(middle - end) == pytest.approx(expected[1], abs=2e-4)


def test_the_larger_robots_file_is_the_smaller_ones_with_gains_for_the_wrists():
    smaller, larger = (
        yaml.safe_load((ROBOTS / n / "robot.yaml").read_text()) for n in NAMES
    )
    for field in ("base", "home", "limbs", "surfaces"):
        assert larger[field] == smaller[field]
    assert larger["gains"]["default"] == smaller["gains"]["default"]
    assert set(larger["gains"]) == {"default", *WRISTS}
    assert load_robot("coman29").gains["LWrj1"] == (200.0, 2.0, 1.0)


def test_wrist_gains_are_near_critical_damping_and_slow_for_the_physics():
    model, robot = ALONE["coman29"], load_robot("coman29")
    data = pose(model, {})
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    for name in ("LWrj1", "LWrj2", "RWrj1", "RWrj2"):
        dof = model.joint(name).dofadr[0]
        (kp, kd, _), inertia = robot.gains[name], M[dof, dof]
        omega = np.sqrt(kp / inertia)
        damping = kd + model.dof_damping[dof]
        assert 0.8 < damping / (2 * omega * inertia) < 1.3
        assert omega * 0.001 < 0.3  # [rad] of the oscillation in one step
        # Half the weight on the ball does not tip it over the wrist.
        assert kp > 5 * 0.5 * 31.5 * 9.81 * (BALL_BELOW_WRIST + 0.02)


def test_home_is_a_symmetric_crouch_with_level_soles_under_the_weight(
    model, figures, home
):
    left = {n: a for n, a in home.items() if n.startswith("L")}
    assert both_sides(left) == pytest.approx(home)
    for name, angle in home.items():
        lower, upper = figures["joints"][name]["range"]
        assert lower + 0.1 < angle < upper - 0.1
    assert home["LKneeSag"] > 0.3
    data = pose(model, home)
    np.testing.assert_allclose(data.body("LFoot").xmat, np.eye(3).ravel(), atol=1e-9)
    ankle = data.body("LFoot").xpos
    com = data.subtree_com[model.body("Waist").id] - ankle
    assert 0.02 <= com[0] <= 0.04  # soles from -0.07 to 0.13
    # Clear of a box 0.40 m high that begins 0.23 m before the ankles.
    for g in solid(model):
        bounds = box_of(model, data, g)
        low, front = bounds[0, 2] - ankle[2] + 0.09, bounds[1, 0] - ankle[0]
        assert low > 0.40 or front < 0.23 - 0.05, model.geom(g).name


def test_home_stands_by_itself_after_a_small_drop(name):
    world = build_world(load_robot(name), Scene(start=np.zeros(3)))
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
    for joint in world.joints:
        limit = 1.0 if joint in WRISTS else 25.0
        assert abs(data.actuator(joint).force[0]) < limit


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
    wrists = [plan.world.model.actuator(n).id for n in WRISTS]
    assert np.abs(rollout.actuator_force[:, wrists]).max() < 4.0  # of 5 N m
