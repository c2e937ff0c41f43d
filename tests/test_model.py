"""The world against plain MuJoCo, finite differences and geometry by hand."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clamber.errors import InputError
from clamber.model.kinematics import Kinematics, limb_lengths
from clamber.model.robot import ROBOTS, load_robot
from clamber.model.scene import GROUND, Box, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy, quat_from_matrix
from clamber.model.world import World, _pairs, build_world, recompiled

UP = np.array([0.0, 0.0, 1.0])
SEEDS = range(5)


def scene_of(*rpys, start=(0.0, 0.0, 0.0), friction=0.8) -> Scene:
    """Boxes of 0.6 x 0.8 x 0.3 m, one per triple of angles, in a row."""
    boxes = tuple(
        Box(
            name=f"box{i}",
            size=np.array([0.6, 0.8, 0.3]),
            centre=np.array([0.6 - 1.0 * i, 0.1 * i, 0.15]),
            rotation=matrix_from_rpy(rpy),
            friction=friction,
        )
        for i, rpy in enumerate(rpys)
    )
    return Scene(boxes=boxes, start=np.array(start))


@pytest.fixture(scope="module")
def world() -> World:
    return build_world(load_robot("coman"), Scene.from_height(0.275))


@pytest.fixture(scope="module")
def tilted() -> World:
    """Two boxes, one yawed and one tilted, the robot close to the first."""
    scene = scene_of((0.0, 0.0, 0.5), (0.25, -0.2, 1.0), start=(0.0, 0.2, 0.4))
    return build_world(load_robot("coman"), scene)


@pytest.fixture
def kin(world) -> Kinematics:
    k = Kinematics(world)
    k.update(world.home)
    return k


def random_posture(world: World, seed: int, where: float = 0.25) -> np.ndarray:
    """(nq,) joints within their limits, any orientation, near the start."""
    rng = np.random.default_rng(seed)
    q = world.home.copy()
    q[:3] += rng.uniform(-where, where, 3)
    q[3:7] = Rotation.random(random_state=rng).as_quat(scalar_first=True)
    q[world.qadr] = rng.uniform(world.q_min[world.dadr], world.q_max[world.dadr])
    return q


def along_tangent(kin: Kinematics, f, q: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Central differences of `f(kin)` over the tangent space at `q`: (..., nv)."""
    columns = []
    for e in np.eye(kin.world.model.nv) * step:
        kin.update(kin.integrate(q, e))
        high = np.array(f(kin))
        kin.update(kin.integrate(q, -e))
        columns.append((high - np.array(f(kin))) / (2 * step))
    kin.update(q)
    return np.stack(columns, axis=-1)


def fresh(world: World, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(world.model)
    data.qpos[:] = q
    mujoco.mj_forward(world.model, data)
    return data


# Standing at the start.


@pytest.mark.parametrize(
    "start", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.9), (-1.0, 2.0, -2.5)]
)
def test_home_stands_at_the_start_with_its_soles_on_the_ground(start):
    w = build_world(load_robot("coman"), scene_of(start=start))
    data = fresh(w, w.home)
    ankles = [data.body(f"{s}Foot").xpos for s in "LR"]
    np.testing.assert_allclose(np.mean(ankles, axis=0)[:2], start[:2], atol=1e-9)
    for s in "LR":
        geom = data.geom(f"{s}Foot")
        sole = geom.xpos - geom.xmat.reshape(3, 3)[:, 2] * 0.02
        assert sole[2] == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(geom.xmat.reshape(3, 3)[:, 2], UP, atol=1e-6)
    # The left foot is to the left of the right one, seen along the yaw.
    left = np.array([-np.sin(start[2]), np.cos(start[2])])
    assert (ankles[0] - ankles[1])[:2] @ left == pytest.approx(0.1452, abs=1e-3)
    x = data.body("Waist").xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(
        x[:2] / np.linalg.norm(x[:2]), [np.cos(start[2]), np.sin(start[2])], atol=1e-6
    )


@pytest.mark.parametrize("ahead", [0.0, 0.08])
def test_knees_that_would_be_in_a_box_at_the_start_are_straighter(ahead):
    size, position = np.array([0.6, 0.8, 0.25]), np.array([0.53, 0.0, 0.125])
    box = Box(name="table", size=size, centre=position, rotation=np.eye(3))
    robot, start = load_robot("coman"), np.array([ahead, 0.0, 0.0])
    w = build_world(robot, Scene(boxes=(box,), start=start))
    knee = w.home[w.model.joint("LKneeSag").qposadr[0]]
    near = ahead > 0
    assert (knee < robot.home["LKneeSag"] - 0.1) == near
    data = fresh(w, w.home)
    fromto = np.zeros(6)
    table = w.model.geom("table").id
    gap = min(
        mujoco.mj_geomDistance(w.model, data, int(a), int(b), 1.0, fromto)
        for a, b in w.pairs
        if table in (a, b)
    )
    assert gap > 0
    kin = Kinematics(w)
    kin.update(w.home)
    for foot in ("LFoot", "RFoot"):
        assert kin.contact_point(foot, UP)[2] == pytest.approx(0.0, abs=1e-6)


def test_home_is_the_same_posture_wherever_it_starts(world):
    other = build_world(load_robot("coman"), scene_of(start=(0.5, 0.5, 1.2)))
    np.testing.assert_array_equal(other.home[7:], world.home[7:])
    for name, angle in world.robot.home.items():
        assert world.home[world.model.joint(name).qposadr[0]] == angle


# Jacobians.


@pytest.mark.parametrize("seed", SEEDS)
def test_the_jacobian_of_the_centre_of_mass_is_its_derivative(world, seed):
    kin, q = Kinematics(world), random_posture(world, seed)
    numeric = along_tangent(kin, lambda k: k.com, q)
    np.testing.assert_allclose(kin.com_jacobian(), numeric, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_centre_of_mass_is_the_mean_of_the_robots_masses(world, seed):
    kin, q = Kinematics(world), random_posture(world, seed)
    kin.update(q)
    data, mass = fresh(world, q), world.model.body_mass
    np.testing.assert_allclose(kin.com, mass @ data.xipos / mass.sum(), atol=1e-12)
    assert world.mass == pytest.approx(mass.sum())


@pytest.mark.parametrize("seed", SEEDS)
def test_jacobians_of_a_body_are_the_derivatives_of_its_motion(world, seed):
    kin, q = Kinematics(world), random_posture(world, seed)
    rng = np.random.default_rng(seed)
    body = int(rng.integers(1, world.model.nbody))
    p_B = rng.uniform(-0.2, 0.2, 3)
    kin.update(q)
    jacp, jacr = (J.copy() for J in kin.jacobians(body, kin.point(body, p_B)))
    at_point = kin.point_jacobian(body, kin.point(body, p_B)).copy()
    R = kin.rotation(body).copy()
    numeric = along_tangent(kin, lambda k: k.point(body, p_B), q)
    np.testing.assert_allclose(jacp, numeric, atol=1e-8)
    np.testing.assert_array_equal(jacp, at_point)
    out = np.full_like(jacp, np.nan)  # written where it is wanted
    assert kin.point_jacobian(body, kin.point(body, p_B), out) is out
    np.testing.assert_array_equal(out, jacp)

    def turned(k: Kinematics) -> np.ndarray:
        return Rotation.from_matrix(k.rotation(body) @ R.T).as_rotvec()

    np.testing.assert_allclose(jacr, along_tangent(kin, turned, q), atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_integrate_and_difference_are_inverse(world, seed):
    kin, q = Kinematics(world), random_posture(world, seed)
    v = np.random.default_rng(seed).normal(scale=0.4, size=world.model.nv)
    np.testing.assert_allclose(kin.difference(q, kin.integrate(q, v)), v, atol=1e-9)
    # MuJoCo 3 rounds: a quaternion times its inverse is one but for the last bit.
    np.testing.assert_allclose(kin.difference(q, q), 0.0, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_gravity_is_the_derivative_of_the_potential_energy(world, seed):
    kin, q = Kinematics(world), random_posture(world, seed)

    def energy(k: Kinematics) -> float:
        return 9.81 * world.model.body_mass @ k.data.xipos[:, 2]

    numeric = along_tangent(kin, energy, q, step=1e-5)
    kin.data.qvel[:] = 3.0  # what was there before is no matter
    np.testing.assert_allclose(kin.gravity(), numeric, atol=1e-5)
    whole = fresh(world, q).qfrc_bias  # of the whole dynamics, at rest
    np.testing.assert_allclose(kin.gravity(), whole, atol=1e-10)


# Distances.


def brute_force(world: World, q: np.ndarray, reach: float) -> dict[int, float]:
    """Distance of every pair that is nearer than `reach`, one by one."""
    data, fromto = fresh(world, q), np.zeros(6)
    out = {}
    for i, (a, b) in enumerate(world.pairs):
        d = mujoco.mj_geomDistance(world.model, data, int(a), int(b), reach, fromto)
        if d < reach:
            out[i] = d
    return out


@pytest.mark.parametrize("which", ["world", "tilted"])
@pytest.mark.parametrize("reach", [0.02, 0.1, 0.3])
def test_the_broad_phase_misses_no_pair(which, reach, request):
    w = request.getfixturevalue(which)
    kin, boxes = Kinematics(w), set()
    for seed in range(12):
        q = random_posture(w, seed, where=0.5)
        kin.update(q)
        near = kin.proximity(reach)
        truth = brute_force(w, q, reach)
        assert near.pairs.tolist() == list(truth)
        # Where a capsule's axis crosses a box, MuJoCo's depth is too small.
        ours, theirs = np.maximum([near.distance, list(truth.values())], -0.02)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
        boxes |= {int(g) for i in truth for g in w.pairs[i]} & set(
            w.support_geom.values()
        )
    assert boxes == set(w.support_geom.values())  # every support was near something


def test_proximity_heeds_which_pairs_count(kin):
    world = kin.world
    active = np.zeros(len(world.pairs), dtype=bool)
    everything = kin.proximity(0.3)
    active[everything.pairs[::2]] = True
    some = kin.proximity(0.3, active)
    np.testing.assert_array_equal(some.pairs, everything.pairs[::2])
    np.testing.assert_array_equal(some.normal, everything.normal[::2])
    none = kin.proximity(0.3, np.zeros(len(world.pairs), dtype=bool))
    assert none.pairs.shape == (0,)
    assert none.normal.shape == none.first.shape == none.second.shape == (0, 3)


@pytest.mark.parametrize("seed", range(4))
def test_nearest_points_lie_a_distance_apart_along_the_normal(tilted, seed):
    kin = Kinematics(tilted)
    kin.update(random_posture(tilted, seed))
    near = kin.proximity(0.2)
    assert len(near.pairs) > 5
    np.testing.assert_allclose(np.linalg.norm(near.normal, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        near.second - near.first, near.distance[:, None] * near.normal, atol=1e-8
    )


@pytest.mark.parametrize("which", ["world", "tilted"])
@pytest.mark.whole
def test_normals_are_the_gradients_of_distances(which, request):
    """d' = n' (J_2 - J_1): along a motion, the distance changes by what n predicts."""
    w = request.getfixturevalue(which)
    kin, fromto, step = Kinematics(w), np.zeros(6), 1e-5
    rng = np.random.default_rng(3)
    checked = 0
    for seed in range(8):
        q = random_posture(w, seed)
        kin.update(q)
        near = kin.proximity(0.15)
        v = rng.normal(size=w.model.nv)
        for i, s, n, p1, p2 in zip(
            near.pairs, near.distance, near.normal, near.first, near.second, strict=True
        ):
            if s < 1e-3:
                continue  # penetration depth has kinks
            a, b = (int(w.model.geom_bodyid[g]) for g in w.pairs[i])
            J = kin.point_jacobian(b, p2).copy() - kin.point_jacobian(a, p1)
            ends = []
            for sign in (1, -1):
                data = fresh(w, kin.integrate(q, sign * step * v))
                g1, g2 = map(int, w.pairs[i])
                ends.append(mujoco.mj_geomDistance(w.model, data, g1, g2, 1.0, fromto))
            rate, other = (ends[0] - s) / step, (s - ends[1]) / step
            if abs(rate - other) > 1e-2:
                continue  # nearest points jump from one edge to another here
            assert n @ J @ v == pytest.approx((rate + other) / 2, abs=2e-3)
            checked += 1
    assert checked > 40


def test_the_normal_of_touching_geoms_still_separates_them(world):
    kin = Kinematics(world)
    kin.update(world.home)  # soles on the ground: distance zero, or rounding
    near = kin.proximity(0.01)
    feet = [
        (n, d)
        for i, n, d in zip(near.pairs, near.normal, near.distance, strict=True)
        if world.support_geom[GROUND] in world.pairs[i]
    ]
    assert len(feet) == 2
    for n, d in feet:
        assert abs(d) < 1e-6
        np.testing.assert_allclose(n, UP, atol=1e-6)  # the ground is the first geom


def test_pairs_are_those_that_mujoco_would_let_collide(world):
    m = world.model
    assert len({tuple(sorted(p)) for p in world.pairs.tolist()}) == len(world.pairs)
    masses = m.body_subtreemass[world.base]
    for a, b in world.pairs:
        assert m.geom_bodyid[a] != m.geom_bodyid[b]
        assert m.geom_contype[a] & m.geom_conaffinity[b]
        assert m.body_subtreemass[m.geom_bodyid[[a, b]]].max() <= masses
    # Neighbours on a joint may overlap, as MuJoCo lets them.
    for a, b in m.geom_bodyid[world.pairs]:
        up = m.body_weldid[m.body_parentid[m.body_weldid[[a, b]]]]
        if m.body_weldid[a] and m.body_weldid[b]:
            assert up[0] != m.body_weldid[b]
            assert up[1] != m.body_weldid[a]
    # Whatever touches in some random posture is a pair, or touched at home already.
    known = {tuple(sorted(p)) for p in world.pairs.tolist()}
    found = set()
    for seed in range(25):
        data = fresh(world, random_posture(world, seed, where=0.4))
        found |= {tuple(sorted(c.geom.tolist())) for c in data.contact}
    assert len(found) > 20
    assert found <= known


# The compiled model.


def test_supports_decide_how_slippery_a_contact_is():
    scene = scene_of((0.0, 0.0, 0.0), friction=0.3)
    w = build_world(load_robot("coman"), scene)
    robot = w.model.geom_priority[[g for s in w.surfaces.values() for g in s.geoms]]
    for name, support in w.supports.items():
        g = w.support_geom[name]
        assert w.model.geom(g).name == name
        assert w.model.geom_priority[g] > robot.max()
        assert w.model.geom_friction[g, 0] == support.friction
    # MuJoCo agrees: between a knee and the slippery box acts the box's friction.
    q = w.home.copy()
    kin = Kinematics(w)
    kin.update(q)
    q[:3] += (
        w.supports["box0"].position - kin.contact_point("LKnee", UP) - [0, 0, 0.002]
    )
    data = fresh(w, q)
    mine = [
        c.friction[0]
        for c in data.contact
        if set(c.geom.tolist()) == {w.support_geom["box0"], w.model.geom("LKnee").id}
    ]
    assert mine
    np.testing.assert_array_equal(mine, 0.3)


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.2, -0.3, 1.0)])
def test_a_support_is_the_top_of_its_geom(rpy):
    w = build_world(load_robot("coman"), scene_of(rpy))
    data, support, g = fresh(w, w.home), w.supports["box0"], w.support_geom["box0"]
    R = data.geom_xmat[g].reshape(3, 3)
    np.testing.assert_allclose(support.normal, R[:, 2], atol=1e-6)
    top = data.geom_xpos[g] + R[:, 2] * w.model.geom_size[g, 2]
    np.testing.assert_allclose(support.position, top, atol=1e-6)


def test_saved_xml_recompiles_to_the_very_same_model(tilted):
    m = tilted.model
    again = mujoco.MjModel.from_xml_string(tilted.xml)
    fields = """body_mass body_inertia body_ipos body_iquat body_pos body_quat geom_pos
        geom_quat geom_size geom_friction geom_priority geom_solref jnt_range
        jnt_actfrcrange dof_armature dof_damping actuator_gainprm actuator_biasprm
        actuator_forcerange"""
    for name in fields.split():
        np.testing.assert_array_equal(getattr(again, name), getattr(m, name), name)
    assert again.opt.timestep == m.opt.timestep
    names = [m.geom(i).name for i in range(m.ngeom)]
    assert names == [again.geom(i).name for i in range(again.ngeom)]


def test_an_edited_world_is_another_one_and_what_its_file_says(world):
    def slippery(spec: mujoco.MjSpec) -> None:
        spec.geom(GROUND).friction = [0.123456789, 0.02, 0.001]

    edited = recompiled(world, slippery)
    ground = world.support_geom[GROUND]
    assert world.model.geom_friction[ground, 0] == 0.8
    assert edited.model.geom_friction[ground, 0] == 0.123457  # as it is written
    np.testing.assert_array_equal(edited.home, world.home)
    again = mujoco.MjModel.from_xml_string(edited.xml)
    np.testing.assert_array_equal(again.geom_friction, edited.model.geom_friction)


def test_every_hinge_has_a_servo_with_its_gains_and_limit(world):
    m = world.model
    assert m.nu == len(world.joints) == m.njnt - 1
    for i, name in enumerate(world.joints):
        joint, servo = m.joint(name), m.actuator(name)
        assert world.qadr[i] == joint.qposadr[0]
        assert world.dadr[i] == joint.dofadr[0]
        assert servo.trnid[0] == joint.id
        kp, kd, _ = world.robot.gains["default"]
        assert (world.kp[i], world.kd[i]) == (kp, kd) == (600.0, 20.0)
        np.testing.assert_array_equal(servo.gainprm[:1], [kp])
        np.testing.assert_array_equal(servo.biasprm[:3], [0.0, -kp, -kd])
        np.testing.assert_array_equal(servo.forcerange, [-50.0, 50.0])
        assert world.tau_max[i] == 50.0
        np.testing.assert_array_equal(
            joint.range, [world.q_min[world.dadr[i]], world.q_max[world.dadr[i]]]
        )
    assert np.all(np.isinf(world.q_min[:6]))
    assert np.all(np.isinf(world.q_max[:6]))


# Surfaces.


def test_hands_elbows_and_knees_are_balls_and_soles_are_flat(world):
    radius = {"Hand": 0.02, "Elbow": 0.043, "Knee": 0.06, "Foot": 0.0}
    for side in "LR":
        for part, r in radius.items():
            s = world.surfaces[side + part]
            assert s.radius == pytest.approx(r)
            assert s.is_flat == (part == "Foot")
            assert len(s.corners) == (4 if s.is_flat else 1)
            names = {world.model.geom(g).name for g in s.geoms}
            assert side + part in names
            assert all(n == s.name or n.startswith(s.name + "_") for n in names)


def test_the_sole_looks_down_and_its_x_is_where_the_toes_are(kin):
    for side in "LR":
        s = kin.world.surfaces[f"{side}Foot"]
        R_WC = kin.rotation(s.body) @ s.rotation
        np.testing.assert_allclose(R_WC, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(kin.point(s.body, s.corners)[:, 2], 0.0, atol=1e-9)
        np.testing.assert_allclose(s.corners.mean(axis=0), s.centre, atol=1e-12)
        # 0.20 x 0.10 m, toes 0.13 m before the ankle.
        spread = np.ptp(s.corners @ s.rotation, axis=0)
        np.testing.assert_allclose(spread, [0.2, 0.1, 0.0], atol=1e-9)
        np.testing.assert_allclose(s.corners[:, 0].max(), 0.13, atol=1e-9)


def test_edges_of_a_sole_are_its_four_sides(kin):
    s, edges = kin.world.surfaces["LFoot"], kin.world.edges["LFoot"]
    assert len(edges) == 4
    assert kin.world.edges["LHand"] == ()
    lengths = [np.linalg.norm(e.corners[1] - e.corners[0]) for e in edges]
    np.testing.assert_allclose(sorted(lengths), [0.1, 0.1, 0.2, 0.2])
    for i, e in enumerate(edges):
        np.testing.assert_array_equal(e.corners[0], s.corners[i])
        np.testing.assert_array_equal(e.corners[1], s.corners[(i + 1) % 4])
        np.testing.assert_allclose(e.centre, e.corners.mean(axis=0), atol=1e-15)
        assert kin.world.surface("LFoot", i) is e
        # Its touching point is in the middle of the side, and two points bear load.
        p = kin.contact_point("LFoot", UP, i)
        np.testing.assert_allclose(p, kin.bearing_points("LFoot", UP, i).mean(axis=0))
        assert p[2] == pytest.approx(0.0, abs=1e-9)
    corners = np.concatenate([e.corners for e in edges])
    assert len(np.unique(corners.round(9), axis=0)) == 4
    # Counter-clockwise seen from above, or from below: the outline crosses nowhere.
    x, y = (s.corners @ s.rotation)[:, :2].T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert abs(area) == pytest.approx(0.02)


def test_a_ball_touches_a_tilted_support_at_its_lowest_point(tilted):
    kin = Kinematics(tilted)
    kin.update(random_posture(tilted, 1))
    support = tilted.supports["box1"]
    for name in ("LHand", "RElbow", "LKnee"):
        s = tilted.surfaces[name]
        centre = kin.data.geom(name).xpos
        p = kin.contact_point(name, support.normal)
        assert support.height(p) == pytest.approx(support.height(centre) - s.radius)
        np.testing.assert_allclose(np.linalg.norm(p - centre), s.radius)
        np.testing.assert_array_equal(kin.bearing_points(name, support.normal), [p])


SHAPES = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="pelvis" pos="0 0 1"><freejoint/>
      <geom name="pelvis" type="sphere" size="0.1"/>
      {legs}
      {arms}
    </body>
  </worldbody>
</mujoco>
"""
LEG = """
      <body name="{s}hip" pos="0 {y} 0"><joint name="{s}hip" axis="0 1 0" {limits}/>
        <geom name="{s}thigh" type="capsule" size="0.04" fromto="0 0 0 0 0 -0.4"/>
        <geom name="{s}knee" type="{kneetype}" {knee}/>
        <body name="{s}shin" pos="0 0 -0.4"><joint name="{s}kn" axis="0 1 0" {limits}/>
          <geom name="{s}shank" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/>
          <geom name="{s}sole" type="box" {sole}/>
        </body>
      </body>
"""
ARM = """
      <body name="{s}arm" pos="0 {y} 0.4"><joint name="{s}sh" axis="0 1 0" {limits}/>
        <geom name="{s}upper" type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3"/>
        <body name="{s}fore" pos="0 0 -0.3"><joint name="{s}el" axis="0 1 0" {limits}/>
          <geom name="{s}palm" type="{handtype}" {hand}/>
        </body>
      </body>
"""
ROBOT_YAML = """
name: shapes
model: shapes.xml
base: pelvis
surfaces: {LFoot: lsole, RFoot: rsole, LHand: lpalm, RHand: rpalm}
limbs:
  left_arm: {root: larm, middle: lfore, end: LHand, surfaces: [LHand]}
  right_arm: {root: rarm, middle: rfore, end: RHand, surfaces: [RHand]}
  left_leg: {root: lhip, middle: lshin, end: LFoot, surfaces: [LFoot, lknee]}
  right_leg: {root: rhip, middle: rshin, end: RFoot, surfaces: [RFoot, rknee]}
"""


@pytest.fixture
def write_robot(tmp_path):
    """Write a plain robot made of primitives; returns the path of its yaml."""

    def write(text: str = ROBOT_YAML, xml: str | None = None, **changes: str) -> Path:
        fill = {
            "limits": 'range="-2 2" limited="true" actuatorfrcrange="-40 40"'
            ' actuatorfrclimited="true"',
            "sole": 'size="0.1 0.05 0.02" pos="0.03 0 -0.32"',
            "kneetype": "sphere",
            "knee": 'size="0.05" pos="0.01 0 -0.4"',
            "handtype": "sphere",
            "hand": 'size="0.04" pos="0 0 -0.25"',
        } | changes
        parts = {
            part: "".join(
                template.format(s=s, y=y, **fill) for s, y in (("l", 0.1), ("r", -0.1))
            )
            for part, template in (("legs", LEG), ("arms", ARM))
        }
        (tmp_path / "shapes.xml").write_text(xml or SHAPES.format(**parts))
        (tmp_path / "robot.yaml").write_text(text)
        return tmp_path / "robot.yaml"

    return write


def build(path: Path) -> World:
    return build_world(load_robot(path), Scene.from_height(0.3))


def test_a_robot_of_ones_own_stands_and_its_geoms_bear_the_surfaces_names(write_robot):
    w = build(write_robot())
    assert w.robot.surfaces == ("LHand", "RHand", "LFoot", "lknee", "RFoot", "rknee")
    names = [w.model.geom(g).name for g in range(w.model.ngeom)]
    assert "LFoot" in names
    assert "lsole" not in names
    sole = fresh(w, w.home).geom("LFoot").xpos[2] - 0.02
    assert sole == pytest.approx(0.0, abs=1e-9)
    assert w.tau_max.tolist() == [40.0] * 8


def test_neighbours_on_a_joint_are_no_pair_however_far_apart(write_robot):
    w = build(write_robot())
    name = w.model.geom
    pairs = {frozenset(name(int(g)).name for g in p) for p in w.pairs}
    assert frozenset(("lupper", "LHand")) not in pairs  # upper arm and forearm
    assert frozenset(("lthigh", "LFoot")) not in pairs
    assert frozenset(("pelvis", "LFoot")) in pairs
    assert frozenset(("LFoot", "RFoot")) in pairs
    assert frozenset(("LHand", "box")) in pairs


@pytest.mark.parametrize("end", ["LFoot", "lsole"])
def test_a_landmark_may_be_a_surface_or_a_geom_by_its_own_name(write_robot, end):
    w = build(write_robot(ROBOT_YAML.replace("end: LFoot", f"end: {end}")))
    body, p = w.landmark(end)
    assert w.model.body(body).name == "lshin"
    # The middle of the face that touches, or of the geom itself.
    depth = -0.34 if end == "LFoot" else -0.32
    np.testing.assert_allclose(p, [0.03, 0.0, depth], atol=1e-9)
    soles = [fresh(w, w.home).geom(f"{s}Foot").xpos for s in "LR"]
    np.testing.assert_allclose(np.mean(soles, axis=0)[:2], 0.0, atol=1e-9)


def test_a_capsule_touches_with_the_end_that_is_lower_at_home(write_robot):
    file = write_robot(
        handtype="capsule", hand='size="0.03" fromto="0 0 -0.05 0.1 0 -0.2"'
    )
    s = build(file).surfaces["LHand"]
    np.testing.assert_allclose(s.centre, [0.1, 0.0, -0.2], atol=1e-6)
    assert s.radius == pytest.approx(0.03)
    assert not s.is_flat


@pytest.mark.parametrize(
    ("size", "rpy", "down", "length"),
    [
        ((0.1, 0.05, 0.02), (0.0, 0.0, 0.0), 2, 0),
        ((0.02, 0.05, 0.1), (0.0, np.pi / 2, 0.0), 0, 2),  # thin side down
        ((0.05, 0.02, 0.1), (np.pi / 2, 0.0, 0.0), 1, 2),
        ((0.1, 0.05, 0.02), (np.pi, 0.0, 0.0), 2, 0),  # upside down
        ((0.1, 0.05, 0.02), (0.0, 0.0, 2.8), 2, 0),
    ],
)
def test_the_face_of_a_box_that_looks_down_is_the_flat_surface(
    write_robot, size, rpy, down, length
):
    R = matrix_from_rpy(rpy)
    quat = " ".join(map(str, quat_from_matrix(R)))
    text = " ".join(map(str, size))
    w = build(write_robot(sole=f'size="{text}" pos="0.03 0 -0.32" quat="{quat}"'))
    kin, s = Kinematics(w), w.surfaces["LFoot"]
    kin.update(w.home)
    R_WC = kin.rotation(s.body) @ s.rotation
    np.testing.assert_allclose(R_WC @ R_WC.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R_WC) == pytest.approx(1.0)
    np.testing.assert_allclose(R_WC[:, 2], UP, atol=1e-6)  # into the link
    axis = R[:, length]
    np.testing.assert_allclose(np.abs(R_WC[:, 0] @ axis), 1.0, atol=1e-6)
    assert R_WC[0, 0] > 0 or abs(R_WC[0, 0]) < 1e-6  # x forwards
    corners = kin.point(s.body, s.corners)
    centre = kin.data.geom("LFoot").xpos
    np.testing.assert_allclose(corners[:, 2], centre[2] - size[down], atol=1e-6)
    np.testing.assert_allclose(kin.point(s.body, s.centre)[:2], centre[:2], atol=1e-6)
    area = 4 * np.prod(size) / size[down]
    sides = np.diff(corners[[0, 1, 2]], axis=0)
    assert np.linalg.norm(np.cross(*sides)) == pytest.approx(area)


def test_a_cylinder_is_flat_by_its_bounding_box(write_robot):
    s = build(write_robot(kneetype="cylinder", knee='size="0.05 0.03"')).surfaces[
        "lknee"
    ]
    assert s.is_flat
    assert s.centre[2] == pytest.approx(-0.03)
    np.testing.assert_allclose(np.ptp(s.corners, axis=0)[:2], 0.1)


# Mistakes.


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("base: pelvis", "base: hips", "base"),
        ("root: larm", "root: lshoulder", "limbs.left_arm.root"),
        ("middle: rshin", "middle: rcalf", "limbs.right_leg.middle"),
        ("[LFoot, lknee]", "[LFoot, lheel]", "limbs.left_leg.surfaces"),
        ("LFoot: lsole", "LFoot: lshoe", "limbs.left_leg.surfaces"),
        ("model: shapes.xml", "model: none.xml", "model"),
        ("base: pelvis", "base: pelvis\nhome: {lelbow: 1.0}", "home"),
        ("base: pelvis", "base: pelvis\nhome: {lel: bent}", "home.lel"),
        ("base: pelvis", "base: pelvis\ncolour: red", "colour"),
        ("base: pelvis", "base: pelvis\ngains: {lel: {kp: -3}}", "gains.lel.kp"),
        ("  left_arm:", "  tail:", "limbs.tail.[key]"),
        ("name: shapes\n", "", "name"),
        ("right_arm: ", "left_arm: ", "limbs"),  # three limbs
    ],
)
def test_a_mistake_in_a_robots_file_is_named(write_robot, old, new, field):
    assert old in ROBOT_YAML
    file = write_robot(ROBOT_YAML.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_robot(file)
    assert (caught.value.source, caught.value.field) == (file, field)
    assert "\n" not in str(caught.value)


def test_a_model_or_robot_that_is_none_is_named(write_robot):
    file = write_robot(xml="<mujoco><worldbody><geom/></worldbody></mujoco>")
    with pytest.raises(InputError) as caught:
        load_robot(file)
    assert caught.value.source == file.parent / "shapes.xml"
    for name in ("atlas", ROBOTS / "coman" / "coman.xml"):
        with pytest.raises(InputError) as caught:
            load_robot(name)
        assert (caught.value.source, caught.value.value) == ("--robot", str(name))
    with pytest.raises(InputError) as caught:
        load_robot("nowhere/robot.yaml")
    assert caught.value.source == Path("nowhere/robot.yaml")


def test_a_surface_on_two_bodies_is_refused(write_robot):
    text = ROBOT_YAML.replace("LHand: lpalm", "LHand: l")
    file = write_robot(text)
    xml = (file.parent / "shapes.xml").read_text()
    xml = xml.replace('name="lpalm"', 'name="l_palm"').replace("lupper", "l_upper")
    (file.parent / "shapes.xml").write_text(xml)
    robot = load_robot(file)
    with pytest.raises(InputError, match=r"LHand.*larm.*lfore.*one body"):
        build_world(robot, Scene.from_height(0.3))


# Rolling.


@pytest.mark.parametrize(("name", "radius"), [("LKnee", 0.06), ("RHand", 0.02)])
@pytest.mark.parametrize("theta", [-1.2, 0.1, 0.8, 2.5])
def test_a_ball_rolls_by_radius_times_angle_and_the_way_it_turns(
    world, name, radius, theta
):
    """A wheel on the ground that turns about +y rolls towards +x."""
    kin = Kinematics(world)
    kin.update(world.home)
    body = world.surfaces[name].body
    link = quat_from_matrix(kin.rotation(body))
    q = world.home.copy()
    turn = np.array([np.cos(theta / 2), 0.0, np.sin(theta / 2), 0.0])
    mujoco.mju_mulQuat(q[3:7], turn, world.home[3:7])
    kin.update(q)
    np.testing.assert_allclose(
        kin.roll(name, UP, link), [radius * theta, 0.0, 0.0], atol=1e-9
    )


@pytest.mark.parametrize("spin", [0.0, 0.7, -2.0])
def test_rolling_is_what_a_ball_does_without_slipping(world, spin):
    """Integrated from velocities: the material point at the contact is at rest.

    Args:
        world: Of the ball.
        spin: Turn about the normal, of that which rolls.
    """
    kin = Kinematics(world)
    kin.update(world.home)
    s = world.surfaces["LKnee"]
    link = kin.rotation(s.body).copy()
    normal = matrix_from_rpy([0.2, -0.3, 0.0])[:, 2]
    axis = np.array([0.3, 0.8, 0.1])
    axis -= normal * (axis @ normal)
    axis = axis / np.linalg.norm(axis) + spin * normal
    theta, n = 0.9, 2000
    centre, R = np.zeros(3), np.eye(3)
    for _ in range(n):
        omega = axis * theta / n
        centre += np.cross(
            omega, s.radius * normal
        )  # v = omega x r, r from the contact
        R = Rotation.from_rotvec(omega).as_matrix() @ R
    q = world.home.copy()
    q[3:7] = quat_from_matrix(R @ matrix_from_quat(world.home[3:7]))
    kin.update(q)
    moved = kin.roll("LKnee", normal, quat_from_matrix(link))
    np.testing.assert_allclose(moved, centre, atol=1e-9)
    assert moved @ normal == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("spin_first", [False, True])
def test_of_turns_one_after_another_a_roll_is_off_by_half_their_product(
    world, spin_first
):
    """The true way is radius times roll, towards where the axis was: [limitations]."""
    kin = Kinematics(world)
    s, roll, spin = world.surfaces["LKnee"], 0.5, 0.3
    turns = Rotation.from_rotvec([0, roll, 0]), Rotation.from_rotvec([0, 0, spin])
    R = turns[0] * turns[1] if spin_first else turns[1] * turns[0]
    kin.update(world.home)
    link = quat_from_matrix(kin.rotation(s.body))
    q = world.home.copy()
    q[3:7] = quat_from_matrix(R.as_matrix() @ matrix_from_quat(world.home[3:7]))
    kin.update(q)
    true = s.radius * np.array([roll, 0.0, 0.0])  # the axis of the roll is y, also last
    off = np.linalg.norm(kin.roll("LKnee", UP, link) - true)
    assert off == pytest.approx(s.radius * roll * spin / 2, rel=0.02)


def test_turning_on_the_spot_rolls_nowhere_and_flat_surfaces_never_roll(kin):
    world = kin.world
    q = world.home.copy()
    turn = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    links = {
        n: quat_from_matrix(kin.rotation(s.body)) for n, s in world.surfaces.items()
    }
    mujoco.mju_mulQuat(q[3:7], turn, world.home[3:7])
    kin.update(q)
    for name, link in links.items():
        np.testing.assert_allclose(kin.roll(name, UP, link), 0.0, atol=1e-12)
        np.testing.assert_array_equal(kin.roll(name, UP, None), 0.0)
    kin.update(random_posture(world, 0))
    np.testing.assert_array_equal(kin.roll("LFoot", UP, links["LFoot"]), 0.0)


@pytest.mark.parametrize("hinges", [2, 3])
def test_neighbours_on_three_hinges_in_one_place_can_meet_and_others_cannot(hinges):
    axes = ("1 0 0", "0 1 0", "0 0 1")[:hinges]
    joints = "".join(f'<joint axis="{a}"/>' for a in axes)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody><body name="base">
      <freejoint/><geom size=".1"/><body pos="0 0 .25">{joints}<geom size=".1"/>
      <body pos="0 0 .25"><joint/><geom size=".1"/></body></body></body>
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pairs = _pairs(model, data, model.body("base").id).tolist()
    assert pairs == [[0, 1], [0, 2]][3 - hinges :]


# Landmarks.


def test_limb_lengths_are_distances_between_joints(kin):
    lengths = limb_lengths(kin)
    assert set(lengths) == {"upper_arm", "forearm", "thigh", "shank"}
    # Joint to joint along the links of the description [m].
    assert lengths["upper_arm"] == pytest.approx(np.hypot(0.18, 0.015), abs=1e-6)
    assert lengths["thigh"] == pytest.approx(0.1024 + 0.1234, abs=1e-6)
    assert lengths["shank"] == pytest.approx(0.201, abs=1e-6)
    assert lengths["forearm"] == pytest.approx(np.hypot(0.205, 0.015), abs=1e-6)
    before = kin.data.qpos.copy()
    kin.update(random_posture(kin.world, 5))
    again = limb_lengths(kin)
    kin.update(before)
    assert again == pytest.approx(lengths)


# Distances that are not looked at.


@pytest.mark.parametrize("size", [1e-3, 0.02, 0.5])
def test_what_was_seen_before_does_not_change_what_is_near(tilted, size):
    """Steps of any size: the same pairs as a workspace that has seen nothing."""
    rng = np.random.default_rng(5)
    used, q = Kinematics(tilted), random_posture(tilted, 1)
    for k in range(40):
        q = used.integrate(q, size * rng.normal(size=tilted.model.nv))
        used.update(q)
        fresh = Kinematics(tilted)
        fresh.update(q)
        active = rng.random(len(tilted.pairs)) < 0.8 if k % 3 else None
        reach = float(rng.choice([0.02, 0.05, 0.1, 0.25]))
        a, b = used.proximity(reach, active), fresh.proximity(reach, active)
        np.testing.assert_array_equal(a.pairs, b.pairs)
        np.testing.assert_array_equal(a.distance, b.distance)
        np.testing.assert_array_equal(a.first, b.first)
