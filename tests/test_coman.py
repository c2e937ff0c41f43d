"""COMAN against its published figures, which are restated here, and on its feet."""

from __future__ import annotations

import itertools
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import clamber

FOLDER = Path(clamber.__file__).parent / "model" / "robots" / "coman"
SURFACES = ("LHand", "RHand", "LElbow", "RElbow", "LKnee", "RKnee", "LFoot", "RFoot")
SIDES = (("L", 1.0), ("R", -1.0))

# joint: axis, lower, upper [rad]; in tree order, right before left as published.
TILTED = (0.93969, 0.0, 0.34202)  # 20 degrees in the xz-plane
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
JOINTS = {
    "WaistLat": (TILTED, -0.5236, 0.5235),
    "WaistSag": (Y, -0.3491, 0.8727),
    "WaistYaw": (Z, -1.3963, 1.3962),
    "RShSag": (Y, -3.4034, 1.6581),
    "RShLat": (X, -2.094, 0.31415),
    "RShYaw": (Z, -1.5708, 1.5708),
    "RElbj": (Y, -2.3562, 0.0),
    "LShSag": (Y, -3.4034, 1.6581),
    "LShLat": (X, -0.31415, 2.094),
    "LShYaw": (Z, -1.5708, 1.5708),
    "LElbj": (Y, -2.3562, 0.0),
    "RHipSag": (Y, -1.9199, 0.7854),
    "RHipLat": (X, -1.0472, 0.4363),
    "RHipYaw": (Z, -0.8727, 0.8727),
    "RKneeSag": (Y, -0.1745, 1.9199),
    "RAnkLat": (X, -0.6109, 0.6109),
    "RAnkSag": (Y, -1.2217, 1.2217),
    "LHipSag": (Y, -1.9199, 0.7854),
    "LHipLat": (X, -0.4363, 1.0472),
    "LHipYaw": (Z, -0.8727, 0.8727),
    "LKneeSag": (Y, -0.1745, 1.9199),
    "LAnkLat": (X, -0.6109, 0.6109),
    "LAnkSag": (Y, -1.2217, 1.2217),
}

# body: x, y, z at zero configuration, soles at z = 0 [m]; the left of each pair.
POSITIONS = {
    "Waist": (0.0, 0.0, 0.5168),
    "DWL": (0.0203, 0.0, 0.6359),
    "DWYTorso": (0.0203, 0.0, 0.6834),
    "LShp": (0.0053, 0.0825, 0.8411),
    "LShr": (0.0053, 0.1558, 0.8411),
    "LShy": (0.0053, 0.1558, 0.7963),
    "LElb": (0.0203, 0.1558, 0.6611),
    "LHipMot": (0.0, 0.0230, 0.5168),
    "LThighUpLeg": (0.0, 0.0726, 0.5168),
    "LThighLowLeg": (0.0, 0.0726, 0.4144),
    "LLowLeg": (0.0, 0.0726, 0.2910),
    "LFootmot": (0.0, 0.0726, 0.0900),
    "LFoot": (0.0, 0.0726, 0.0900),
}

# body: kilograms of the links that it is made of.
MASSES = {
    "Waist": 1.80087 + 0.01,
    "DWL": 0.54589,
    "DWS": 0.75398,
    "DWYTorso": 6.36172,
    "LShp": 0.56782,
    "LShr": 0.77684,
    "LShy": 1.04623,
    "LElb": 0.63307 + 0.263,
    "LHipMot": 0.89258,
    "LThighUpLeg": 1.02461,
    "LThighLowLeg": 1.70011,
    "LLowLeg": 1.40982,
    "LFootmot": 0.72992,
    "LFoot": 0.66647,
}

# bodies: lower and upper corner of the published shells in the first one's frame [m].
EXTENTS = {
    ("Waist",): ((-0.1039, -0.063, -0.0516), (0.053, 0.063, 0.1507)),
    ("DWS",): ((-0.044, -0.0581, -0.0422), (0.0441, 0.0581, 0.0449)),
    ("DWYTorso",): ((-0.1387, -0.1108, -0.0138), (0.0712, 0.1108, 0.2401)),
    ("LThighUpLeg",): ((-0.0749, -0.0541, -0.0996), (0.055, 0.0649, 0.0617)),
    ("LLowLeg",): ((-0.0587, -0.0538, -0.2212), (0.0554, 0.0601, 0.0418)),
    ("LFoot",): ((-0.07, -0.05, -0.09), (0.13, 0.05, -0.05)),
    ("LShy",): ((-0.057, -0.0445, -0.1718), (0.0477, 0.059, -0.0013)),
    ("LElb",): ((-0.051, -0.036, -0.2252), (0.0364, 0.036, 0.0365)),
}


def both_sides(left: dict[str, float]) -> dict[str, float]:
    """Joint angles of the left side and their mirror image on the right."""
    flips = ("Lat", "Yaw")
    right = {"R" + n[1:]: -a if n.endswith(flips) else a for n, a in left.items()}
    return left | right


HOMING = both_sides(
    {
        "LShSag": 0.5,
        "LShLat": 0.5,
        "LShYaw": -0.3,
        "LElbj": -1.57,
        "LHipSag": -0.45,
        "LKneeSag": 0.90,
        "LAnkSag": -0.45,
    }
)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The robot alone."""
    return mujoco.MjModel.from_xml_path(str(FOLDER / "coman.xml"))


@pytest.fixture(scope="module")
def robot() -> dict:
    """`robot.yaml` as a mapping."""
    return yaml.safe_load((FOLDER / "robot.yaml").read_text())


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


def volume(model: mujoco.MjModel, g: int) -> float:
    """Of a primitive [m^3]."""
    r, h = model.geom_size[g][:2]
    if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
        return float(8 * np.prod(model.geom_size[g]))
    ball = 4 / 3 * np.pi * r**3
    capsule = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
    return float(ball + (2 * np.pi * r**2 * h if capsule else 0.0))


def mirrored(name: str) -> str:
    """The same part of the right side."""
    return "R" + name[1:] if name.startswith("L") else name


# Figures.


def test_links_stand_where_the_published_table_has_them(model):
    data = pose(model, {})
    for name, p in POSITIONS.items():
        np.testing.assert_allclose(data.body(name).xpos, p, atol=1e-4, err_msg=name)
        q = np.array(p) * (1, -1 if name.startswith("L") else 1, 1)
        np.testing.assert_allclose(data.body(mirrored(name)).xpos, q, atol=1e-4)
    assert data.body("DWS").xpos == pytest.approx(data.body("DWL").xpos)


def test_all_link_frames_are_parallel_at_zero(model):
    data = pose(model, {})
    np.testing.assert_allclose(data.xmat, np.tile(np.eye(3).ravel(), (model.nbody, 1)))


def test_knee_shoulder_and_top_have_their_heights(model):
    data = pose(model, {})
    assert data.body("LLowLeg").xpos[2] == pytest.approx(0.291, abs=1e-4)
    assert data.body("LShr").xpos[2] == pytest.approx(0.841, abs=2e-4)
    bounds = np.array([box_of(model, data, g) for g in solid(model)])
    assert bounds[:, 0, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert bounds[:, 1, 2].max() == pytest.approx(0.924, abs=0.005)
    assert bounds[:, 0].min(0) == pytest.approx([-0.118, -0.215, 0.0], abs=0.01)
    assert bounds[:, 1].max(0) == pytest.approx([0.130, 0.215, 0.924], abs=0.01)


def test_mass_and_centre_of_mass_are_the_published_ones(model):
    data = pose(model, {})
    assert model.body_mass.sum() == pytest.approx(28.8934, abs=1e-3)
    com = data.subtree_com[model.body("Waist").id]
    np.testing.assert_allclose(com, (-0.0011, -0.0001, 0.5423), atol=5e-4)


def test_every_body_has_the_mass_of_its_links(model):
    for name, mass in MASSES.items():
        assert model.body(name).mass[0] == pytest.approx(mass, abs=2e-5), name
        assert model.body(mirrored(name)).mass[0] == pytest.approx(mass, abs=2e-5)


def test_a_forearm_and_its_elbow_are_one_body_by_the_parallel_axis_theorem(model):
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


def test_joints_have_their_order_axes_and_ranges(model):
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names == ["root", *JOINTS]
    assert (model.nq, model.nv, model.nu) == (30, 29, 0)
    for name, (axis, lower, upper) in JOINTS.items():
        j = model.joint(name)
        np.testing.assert_allclose(j.axis, axis, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(j.range, (lower, upper), atol=1e-9, err_msg=name)
        assert model.jnt_limited[j.id]


def test_efforts_are_limited_and_joints_are_no_brakes(model):
    for name in JOINTS:
        j, dof = model.joint(name), model.joint(name).dofadr[0]
        assert tuple(model.jnt_actfrcrange[j.id]) == (-50.0, 50.0)
        assert 0 < model.dof_damping[dof] <= 5.0
        assert 0 < model.dof_armature[dof] <= 0.05
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
    ],
)
def test_joints_turn_the_way_their_names_promise(model, joint, angle, geom, axis, sign):
    before = pose(model, {}).geom(geom).xpos
    after = pose(model, {joint: angle}).geom(geom).xpos
    assert sign * (after[axis] - before[axis]) > 0.005


# Shape.


def test_the_shape_is_made_of_named_primitives(model):
    kinds = {
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
    }
    assert {mujoco.mjtGeom(t) for t in model.geom_type} <= kinds
    assert model.nmesh == 0
    names = [model.geom(g).name for g in range(model.ngeom)]
    assert all(names)
    assert len(set(names)) == len(names)


def test_each_surface_is_one_part_of_one_body(model):
    bodies = {"Hand": "Elb", "Elbow": "Elb", "Knee": "LowLeg", "Foot": "Foot"}
    for surface in SURFACES:
        geoms = [
            model.geom(g)
            for g in range(model.ngeom)
            if model.geom(g).name == surface
            or model.geom(g).name.startswith(surface + "_")
        ]
        assert geoms, surface
        assert {model.body(g.bodyid[0]).name for g in geoms} == {
            surface[0] + bodies[surface[1:]]
        }
        assert all(g.contype[0] and g.conaffinity[0] for g in geoms)


def test_contact_parameters_are_those_of_hard_rubber(model):
    for g in solid(model):
        assert np.all(model.geom_friction[g] <= (1.0, 0.05, 0.005))
        assert model.geom_condim[g] in (3, 4)
        assert model.geom_solref[g] == pytest.approx((0.005, 1.0))
        assert model.geom_margin[g] == 0
        assert (model.geom_contype[g], model.geom_conaffinity[g]) == (1, 1)


def test_looks_carry_nothing(model):
    looks = [g for g in range(model.ngeom) if not model.geom_contype[g]]
    assert not model.geom_conaffinity[looks].any()
    assert len(looks) <= 2


def test_hand_and_foot_have_their_published_shape(model):
    for side, _ in SIDES:
        hand, foot = model.geom(side + "Hand"), model.geom(side + "Foot")
        np.testing.assert_allclose(hand.pos, (-0.015, 0, -0.205))
        assert hand.size[0] == 0.020
        np.testing.assert_allclose(foot.pos, (0.03, 0, -0.07))
        np.testing.assert_allclose(foot.size, (0.10, 0.05, 0.02))


@pytest.mark.parametrize("bodies", EXTENTS, ids=lambda b: b[0])
def test_links_fill_their_published_extents(model, bodies):
    data = pose(model, {})
    geoms = [g for g in solid(model) if model.body(model.geom_bodyid[g]).name in bodies]
    bounds = np.array([box_of(model, data, g) for g in geoms])
    ours = np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)])
    ours -= data.body(bodies[0]).xpos
    np.testing.assert_allclose(ours, EXTENTS[bodies], atol=0.02)


def test_no_heavy_link_is_a_ghost(model):
    bodies = {int(model.geom_bodyid[g]) for g in solid(model)}
    heavy = {b for b in range(1, model.nbody) if model.body_mass[b] > 1.2}
    assert heavy <= bodies
    assert 3000.0 * sum(volume(model, g) for g in solid(model)) >= 28.9


def test_the_right_side_is_the_left_in_a_mirror(model):
    flip = np.array([1.0, -1.0, 1.0])
    data = pose(model, HOMING)
    for g in range(model.ngeom):
        name = model.geom(g).name
        if not name.startswith("L"):
            continue
        other = model.geom("R" + name[1:])
        p = data.geom_xpos[g] * flip
        np.testing.assert_allclose(data.geom(other.id).xpos, p, atol=1e-5)
        np.testing.assert_allclose(other.size, model.geom_size[g])


# Surfaces touch first.


@pytest.mark.parametrize("roll", [-0.8, -0.4, 0.0, 0.4, 0.8])
def test_a_flat_forearm_rests_on_elbow_and_ball(model, roll):
    """The plane that both balls touch, rolled about the forearm, clears the rod."""
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


# The robot and itself.


def test_only_neighbours_are_excused_from_touching(model):
    for signature in model.exclude_signature:
        a, b = int(signature) >> 16, int(signature) & 0xFFFF
        assert joints_between(model, a, b) <= 2
    excused = {
        frozenset((int(s) >> 16, int(s) & 0xFFFF)) for s in model.exclude_signature
    }
    body = model.geom_bodyid
    for a, b in far_pairs(model):
        assert frozenset((int(body[a]), int(body[b]))) not in excused


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
def test_parts_that_can_meet_do_collide(model, a, b, angles):
    data = pose(model, angles)
    met = {
        frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name))
        for c in data.contact[: data.ncon]
    }
    assert frozenset((a, b)) in met


@pytest.mark.parametrize("posture", ["zero", "homing", "home"])
def test_no_part_is_near_another_in_ordinary_postures(model, robot, posture):
    angles = {"zero": {}, "homing": HOMING, "home": robot["home"]}[posture]
    data = pose(model, angles)
    gap, a, b = closest(model, data, far_pairs(model))
    assert gap > 0.005, (a, b)
    assert data.ncon == 0


@pytest.mark.parametrize("ankle", [-1.2217, 0.0, 1.2217])
@pytest.mark.parametrize("hip", [-1.9199, 0.0, 0.7854])
def test_a_folded_leg_does_not_run_into_itself(model, hip, ankle):
    leg = both_sides({"LHipSag": hip, "LKneeSag": 1.9199, "LAnkSag": ankle})
    data = pose(model, leg | {"LShLat": 0.6, "RShLat": -0.6})
    gap, a, b = closest(model, data, far_pairs(model))
    assert gap > 0.005, (a, b)


def test_the_waist_turns_without_the_chest_meeting_the_pelvis(model):
    waist = model.geom("Waist").id
    chest = [g for g in solid(model) if model.geom(g).name.startswith("Torso_")]
    ranges = [np.linspace(*JOINTS[n][1:], 5) for n in list(JOINTS)[:3]]
    for angles in itertools.product(*ranges):
        data = pose(model, dict(zip(JOINTS, angles, strict=False)))
        gap, _, b = closest(model, data, [(waist, g) for g in chest])
        assert gap > 0.005, (b, angles)


# Robot.yaml.


def test_the_description_names_what_exists(model, robot):
    bodies = {model.body(b).name for b in range(model.nbody)}
    geoms = {model.geom(g).name for g in range(model.ngeom)}
    assert robot["version"] == 1
    assert (FOLDER / robot["model"]).is_file()
    assert robot["base"] == "Waist"
    assert robot["surfaces"] == {}
    named = [s for limb in robot["limbs"].values() for s in limb["surfaces"]]
    assert sorted(named) == sorted(SURFACES)
    for limb in robot["limbs"].values():
        assert {limb["root"], limb["middle"], limb["end"]} <= bodies | geoms
    assert set(robot["gains"]) <= {"default", *JOINTS}


def test_landmarks_give_the_published_limb_lengths(model, robot):
    data = pose(model, {})

    def place(name: str) -> np.ndarray:
        is_body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) >= 0
        return data.body(name).xpos if is_body else data.geom(name).xpos

    lengths = {"arm": (np.hypot(0.18, 0.015), np.hypot(0.205, 0.015))}
    lengths["leg"] = (0.2258, 0.201)
    for name, limb in robot["limbs"].items():
        root, middle, end = (place(limb[k]) for k in ("root", "middle", "end"))
        side = 1 if name.startswith("left") else -1
        assert side * root[1] > 0
        expected = lengths[name.split("_")[1]]
        assert np.linalg.norm(root - middle) == pytest.approx(expected[0], abs=2e-4)
        assert np.linalg.norm(middle - end) == pytest.approx(expected[1], abs=2e-4)


def test_home_is_a_symmetric_crouch_within_the_limits(model, robot):
    home = robot["home"]
    left = {n: a for n, a in home.items() if n.startswith("L")}
    assert both_sides(left) == pytest.approx(home)
    for name, angle in home.items():
        lower, upper = JOINTS[name][1:]
        assert lower + 0.1 < angle < upper - 0.1
    assert home["LKneeSag"] > 0.3


def test_home_has_level_soles_and_the_weight_over_them(model, robot):
    data = pose(model, robot["home"])
    R = data.body("LFoot").xmat.reshape(3, 3)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-9)
    ankle = data.body("LFoot").xpos
    com = data.subtree_com[model.body("Waist").id] - ankle
    assert 0.02 <= com[0] <= 0.04  # soles from -0.07 to 0.13
    # Clear of a box 0.42 m high that begins 0.23 m before the ankles.
    floor = ankle[2] - 0.09
    for g in solid(model):
        bounds = box_of(model, data, g)
        low, front = bounds[0, 2] - floor, bounds[1, 0] - ankle[0]
        assert low > 0.42 or front < 0.23 - 0.05, model.geom(g).name


def test_home_stands_by_itself_after_a_small_drop(robot):
    spec = mujoco.MjSpec.from_file(str(FOLDER / "coman.xml"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    gains = robot["gains"]["default"]
    for name in JOINTS:
        act = spec.add_actuator(name=name, target=name)
        act.trntype = mujoco.mjtTrn.mjTRN_JOINT
        act.set_to_position(kp=gains["kp"], kv=gains["kd"])
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    model = spec.compile()
    data = pose(model, robot["home"])
    data.qpos[2] += 0.01 - (data.body("LFoot").xpos[2] - 0.09)
    start = data.qpos.copy()
    data.ctrl[:] = start[7:]
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
        if g and c.efc_address >= 0
    }
    assert touching - {""} == {"LFoot", "RFoot"}
    assert np.abs(data.actuator_force).max() < 25.0
