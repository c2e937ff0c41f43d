"""Distances of shapes and which pairs are near, against MuJoCo, search and bounds.

A shape's support function says how far it reaches along a direction; the signed
distance of two is the most, over directions, that is between their supports.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clamber import _core
from clamber.model.core import SHAPES, near_pairs
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world
from humanoids import mjcf, urdf

MUJOCO = int(mujoco.__version__.split(".")[0])
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = range(7)
NAMES = [k.name.removeprefix("mjGEOM_").lower() for k in SHAPES]
ANY_TWO = [
    pytest.param(a, b, id=f"{NAMES[a]}-{NAMES[b]}")
    for a, b in itertools.combinations_with_replacement(range(7), 2)
    if b != PLANE
]
SOLID_TWO = [p for p in ANY_TWO if PLANE not in p.values]
CORNERS = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Placed:
    """A shape somewhere; `vertices` (k, 3) of a mesh."""

    kind: int
    size: np.ndarray
    p: np.ndarray
    R: np.ndarray
    vertices: np.ndarray

    def reach(self, n: np.ndarray) -> np.ndarray:
        """(m,) how far it reaches from the origin along unit vectors n (m, 3)."""
        d, s = n @ self.R, self.size
        along = np.abs(d) * s
        if self.kind == PLANE:
            h = np.where(d[:, 2] > 1.0 - 1e-12, 0.0, np.inf)
        elif self.kind == SPHERE:
            h = np.full(len(d), s[0])
        elif self.kind == CAPSULE:
            h = s[0] + s[1] * np.abs(d[:, 2])
        elif self.kind == ELLIPSOID:
            h = np.linalg.norm(along, axis=1)
        elif self.kind == CYLINDER:
            h = s[0] * np.hypot(d[:, 0], d[:, 1]) + s[1] * np.abs(d[:, 2])
        elif self.kind == BOX:
            h = along.sum(axis=1)
        else:
            h = (d @ self.vertices.T).max(axis=1)
        return h + n @ self.p


def placed(
    kind: int,
    size: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0),
    at: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0),
    turn: tuple[float, ...] | np.ndarray = (0.0, 0.0, 0.0),
    vertices: np.ndarray | None = None,
) -> Placed:
    return Placed(
        kind=kind,
        size=np.array(size, dtype=float),
        p=np.array(at, dtype=float),
        R=Rotation.from_rotvec(turn).as_matrix(),
        vertices=np.zeros((0, 3)) if vertices is None else vertices,
    )


def drawn(kind: int, rng: np.random.Generator, spread: float = 0.25) -> Placed:
    corners = rng.normal(0.0, 0.1, (20, 3)) if kind == MESH else None
    turn = Rotation.random(random_state=rng).as_rotvec()
    return placed(
        kind, rng.uniform(0.03, 0.3, 3), rng.normal(0.0, spread, 3), turn, corners
    )


@dataclass(frozen=True, slots=True)
class Answer:
    distance: float
    normal: np.ndarray
    first: np.ndarray
    second: np.ndarray


def workspace(a: Placed, b: Placed):
    """`question(reach, a)` answers about the pair, `a` having moved."""
    near = _core.Proximity(
        np.array([a.kind, b.kind], dtype=np.int32),
        np.array([a.size, b.size]),
        [a.vertices, b.vertices],
        np.array([[0, 1]], dtype=np.int32),
    )

    def question(reach: float, a: Placed = a):
        xmat = np.array([a.R.ravel(), b.R.ravel()])
        return near.query(np.array([a.p, b.p]), xmat, reach)

    return question


def asked(a: Placed, b: Placed) -> Answer:
    pairs, distance, *rest = workspace(a, b)(np.inf)
    assert len(pairs) == 1
    return Answer(float(distance[0]), *(x[0] for x in rest))


def between(a: Placed, b: Placed, n: np.ndarray) -> np.ndarray:
    """(m,) what is between the shapes along unit vectors (m, 3) from a to b."""
    return -a.reach(n) - b.reach(-n)


def searched(a: Placed, b: Placed, rng: np.random.Generator) -> float:
    """The signed distance, by sampling directions more and more closely."""
    n = rng.normal(size=(4000, 3))
    for width in 0.05 * 0.7 ** np.arange(50):
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        d = between(a, b, n)
        best = n[np.argsort(-d)[:8]]
        wide = best[:, None] + width * rng.normal(size=(8, 40, 3))
        n = np.concatenate([best, wide.reshape(-1, 3)])
    return float(d.max())


def in_mujoco(a: Placed, b: Placed) -> float:
    spec = mujoco.MjSpec()
    spec.option.ccd_tolerance, spec.option.ccd_iterations = 1e-10, 200
    for i, s in enumerate((a, b)):
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, s.R.ravel())
        g = spec.worldbody.add_geom(
            type=SHAPES[s.kind], size=s.size, pos=s.p, quat=quat
        )
        if s.kind == MESH:
            spec.add_mesh(name=f"mesh{i}", uservert=s.vertices.ravel())
            g.meshname = f"mesh{i}"
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None)


def assert_sound(a: Placed, b: Placed, tolerance: float = 1e-6) -> Answer:
    """The points lie a distance apart along a unit normal, with the shapes behind them.

    Rounding leaves the normals of curved shapes that almost touch this good.
    """
    x = asked(a, b)
    assert np.linalg.norm(x.normal) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(x.second - x.first, x.distance * x.normal, atol=1e-12)
    assert between(a, b, x.normal[None])[0] == pytest.approx(x.distance, abs=tolerance)
    return x


def shifted(a: Placed, b: Placed, gap: float) -> Placed:
    """b, moved along the normal so that it would be a gap away, were it apart."""
    x = asked(a, b)
    return replace(b, p=b.p - (x.distance - gap) * x.normal)


# Distances.


@pytest.mark.parametrize(("a", "b"), ANY_TWO)
def test_distances_are_those_of_mujoco(a, b, rng):
    """Where shapes are apart or overlap by little; deeper, MuJoCo is inexact."""
    for _ in range(20):
        one, other = drawn(a, rng), drawn(b, rng)
        if asked(one, other).distance < 0.0:
            continue
        for gap in (0.4, 0.01, 1e-4, -0.01):
            near = shifted(one, other, gap)
            ours, theirs = asked(one, near).distance, in_mujoco(one, near)
            # Before 4, MuJoCo's own were off by up to 0.1 mm beside ellipsoids.
            off = 1e-4 if ELLIPSOID in (a, b) and MUJOCO < 4 else 1e-6
            assert ours == pytest.approx(theirs, abs=off)
            assert ours * gap > 0.0


@pytest.mark.parametrize(("a", "b"), SOLID_TWO)
def test_distances_are_the_most_that_is_between_supports(a, b, rng):
    """An independent search; it may fall short, never exceed."""
    overlapping = 0
    for _ in range(12):
        one, other = drawn(a, rng, spread=0.1), drawn(b, rng, spread=0.1)
        x = assert_sound(one, other)
        found = searched(one, other, rng)
        assert found - 1e-9 < x.distance
        assert x.distance == pytest.approx(found, abs=1e-5)
        overlapping += x.distance < 0.0
    assert overlapping > 5


@pytest.mark.parametrize(("a", "b"), ANY_TWO)
def test_a_shape_that_moves_along_the_normal_goes_away_by_as_much(a, b, rng):
    """d distance / d translation = normal, and none of the other way round."""
    step = 1e-5
    for _ in range(20):
        one, other = drawn(a, rng), drawn(b, rng)
        x = asked(one, other)
        slope, kink = np.zeros(3), 0.0
        for i, e in enumerate(np.eye(3) * step):
            ahead = asked(one, replace(other, p=other.p + e)).distance - x.distance
            behind = x.distance - asked(one, replace(other, p=other.p - e)).distance
            slope[i] = (ahead + behind) / (2 * step)
            kink = max(kink, abs(ahead - behind) / step)
        if kink < 1e-2:  # in overlap, another way out becomes the shorter
            np.testing.assert_allclose(slope, x.normal, atol=2e-3)
        back = asked(other, one)
        assert back.distance == pytest.approx(x.distance, abs=1e-9)


@pytest.mark.parametrize(("a", "b"), ANY_TWO)
def test_distances_go_through_zero_without_a_step(a, b, rng):
    """Moved along the normal to touch, and a hair to both sides of it.

    Corners that overlap have shorter ways out than back along their normal.
    """
    for _ in range(8):
        one, other = drawn(a, rng, spread=0.5), drawn(b, rng, spread=0.5)
        x = asked(one, other)
        if x.distance < 0.0:
            continue
        for gap in (1e-3, 1e-6, 1e-9, 1e-11, 1e-13, 0.0, -1e-12, -1e-10, -1e-8, -1e-5):
            y = assert_sound(one, shifted(one, other, gap))
            assert gap - 1e-9 < y.distance < max(gap, 0.0) + 1e-9
            if gap >= 1e-6:
                np.testing.assert_allclose(y.normal, x.normal, atol=1e-4)


@pytest.mark.parametrize("deep", [False, True])
def test_nearest_points_belong_to_both_boxes(deep, rng):
    """Where faces are parallel too: second - first = distance * normal holds there."""
    for k in range(100):
        turn = Rotation.random(random_state=rng).as_rotvec()
        one = placed(BOX, rng.uniform(0.05, 0.2, 3), (0.3, 0.2, 0.1), turn)
        yaw = Rotation.from_rotvec([0.0, 0.0, 0.1 if k % 2 else 0.0])
        other = placed(BOX, rng.uniform(0.05, 0.2, 3))
        high = one.size[2] + other.size[2] + (-0.01 if deep else 0.01)
        beside = 0.9 * rng.uniform(-1.0, 1.0, 2) * (one.size + other.size)[:2]
        local = np.append(beside, high)
        other = replace(other, p=one.p + one.R @ local, R=one.R @ yaw.as_matrix())
        x = assert_sound(one, other)
        for s, point in ((one, x.first), (other, x.second)):
            assert np.all(np.abs(s.R.T @ (point - s.p)) < s.size + 1e-9)


# Degenerate questions.

DEGENERATE = {
    "points in one place": (placed(SPHERE), placed(SPHERE)),
    "spheres in one place": (placed(SPHERE, (0.1, 0, 0)), placed(SPHERE, (0.2, 0, 0))),
    "crossing capsules": (
        placed(CAPSULE, (0.1, 0.2, 0)),
        placed(CAPSULE, (0.1, 0.3, 0), turn=(1.5, 0, 0)),
    ),
    "capsules along each other": (
        placed(CAPSULE, (0.1, 0.2, 0)),
        placed(CAPSULE, (0.1, 0.3, 0)),
    ),
    "capsules almost parallel": (
        placed(CAPSULE, (0.1, 0.2, 0)),
        placed(CAPSULE, (0.1, 0.3, 0), (0.3, 0, 0), (1e-9, 0, 0)),
    ),
    "a sphere in the middle of a box": (
        placed(SPHERE, (0.1, 0, 0)),
        placed(BOX, (0.3, 0.2, 0.1)),
    ),
    "a capsule along a box": (
        placed(CAPSULE, (0.05, 0.3, 0), (0.0, 0.0, 0.15), (0, np.pi / 2, 0)),
        placed(BOX, (0.2, 0.2, 0.1)),
    ),
    "a capsule through a box": (
        placed(CAPSULE, (0.05, 0.5, 0)),
        placed(BOX, (0.2, 0.3, 0.1)),
    ),
    "the same box twice": (
        placed(BOX, (0.3, 0.2, 0.1)),
        placed(BOX, (0.3, 0.2, 0.1)),
    ),
    "boxes that share an edge": (
        placed(BOX, (0.1, 0.1, 0.1)),
        placed(BOX, (0.1, 0.1, 0.1), (0.2, 0.2, 0)),
    ),
    "boxes that share a corner": (
        placed(BOX, (0.1, 0.1, 0.1)),
        placed(BOX, (0.1, 0.1, 0.1), (0.2, 0.2, 0.2)),
    ),
    "boxes on each other": (
        placed(BOX, (0.1, 0.1, 0.1)),
        placed(BOX, (0.3, 0.2, 0.1), (0.05, 0.02, 0.2)),
    ),
    "flat boxes in one plane": (placed(BOX, (0.1, 0.1, 0)), placed(BOX, (0.2, 0.3, 0))),
    "a flat box in a box": (placed(BOX, (0.1, 0.1, 0)), placed(BOX, (0.2, 0.3, 0.1))),
    "boxes that are points": (placed(BOX), placed(BOX)),
    "boxes that are lines": (placed(BOX, (0.1, 0, 0)), placed(BOX, (0, 0.1, 0))),
    "discs in one place": (
        placed(CYLINDER, (0.1, 0, 0)),
        placed(CYLINDER, (0.2, 0, 0)),
    ),
    "cylinders on each other": (
        placed(CYLINDER, (0.1, 0.1, 0)),
        placed(CYLINDER, (0.2, 0.1, 0), (0.1, 0, 0.2)),
    ),
    "round ellipsoids in one place": (
        placed(ELLIPSOID, (0.1, 0.1, 0.1)),
        placed(ELLIPSOID, (0.2, 0.2, 0.2)),
    ),
    "ellipsoids that are points": (placed(ELLIPSOID), placed(ELLIPSOID)),
    "an ellipsoid in a box": (
        placed(ELLIPSOID, (0.1, 0.2, 0.05)),
        placed(BOX, (0.3, 0.2, 0.1)),
    ),
    "a mesh of one point": (
        placed(MESH, vertices=np.zeros((1, 3))),
        placed(BOX, (0.3, 0.2, 0.1)),
    ),
    "a cube of twice the corners": (
        placed(MESH, vertices=0.1 * np.repeat(CORNERS, 2, axis=0)),
        placed(MESH, at=(0.1, 0.1, 0.1), vertices=0.1 * CORNERS),
    ),
    "a plane through a box": (placed(PLANE), placed(BOX, (0.3, 0.2, 0.1))),
    "a needle and a wall": (
        placed(CAPSULE, (0.0, 0.3, 0)),
        placed(BOX, (1e-9, 5.0, 5.0), (1e-10, 0.0, 0.0)),
    ),
    "far away": (
        placed(BOX, (0.1, 0.1, 0.1), (1e6, 0, 0)),
        placed(CYLINDER, (0.1, 0.1, 0.1), (0, 1e6, 0)),
    ),
}


@pytest.mark.parametrize("which", DEGENERATE)
def test_degenerate_shapes_have_a_distance_and_a_normal(which, rng):
    a, b = DEGENERATE[which]
    for one, other in ((a, b), (b, a)):
        x = asked(one, other)
        assert np.linalg.norm(x.normal) == pytest.approx(1.0, abs=1e-12)
        scale = 1.0 + np.abs(one.p - other.p).max()
        np.testing.assert_allclose(
            x.second - x.first, x.distance * x.normal, atol=1e-12 * scale
        )
        if PLANE in (one.kind, other.kind):
            assert x.distance == pytest.approx(-0.1, abs=1e-12)
            continue
        found = searched(one, other, rng)
        assert x.distance == pytest.approx(found, abs=1e-5 * scale)
        assert between(one, other, x.normal[None])[0] == pytest.approx(
            x.distance, abs=1e-9 * scale
        )


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("a", "b"), ANY_TWO)
def test_a_pose_that_is_no_number_has_no_distance(a, b, value, rng):
    one, other = drawn(a, rng), drawn(b, rng)
    for field in ("p", "R"):
        broken = getattr(other, field).copy()
        broken.flat[1] = value
        assert np.isnan(asked(one, replace(other, **{field: broken})).distance)
        assert np.isnan(asked(replace(one, **{field: broken}), other).distance)


def test_planes_never_meet():
    assert len(workspace(placed(PLANE), placed(PLANE))(np.inf)[0]) == 0


# Which pairs are near.


@pytest.fixture(scope="module", params=["coman", "coman29"])
def robot_world(request):
    return build_world(load_robot(request.param), Scene.from_height(0.3))


def random_postures(world, rng, n: int):
    """Joints within their limits, the base about the box."""
    m = world.model
    for _ in range(n):
        q = world.home.copy()
        low, high = world.q_min[world.dadr], world.q_max[world.dadr]
        q[world.qadr] = rng.uniform(np.maximum(low, -3.0), np.minimum(high, 3.0))
        q[:3] += rng.normal(0.0, 0.2, 3)
        turned = q.copy()
        mujoco.mj_integratePos(
            m,
            turned,
            np.r_[np.zeros(3), rng.normal(0, 0.5, 3), np.zeros(m.nv - 6)],
            1.0,
        )
        yield turned


def test_all_distances_of_a_robot_are_those_of_mujoco(robot_world, rng):
    kin, m = Kinematics(robot_world), robot_world.model
    for q in random_postures(robot_world, rng, 8):
        kin.update(q)
        near = kin.proximity(np.inf)
        assert near.pairs.tolist() == list(range(len(robot_world.pairs)))
        for d, (a, b) in zip(near.distance, robot_world.pairs.tolist(), strict=True):
            if d > -0.02:
                theirs = mujoco.mj_geomDistance(m, kin.data, a, b, 10.0, None)
                assert d == pytest.approx(theirs, abs=1e-6)


@pytest.mark.parametrize(
    "text", [mjcf(), mjcf(0.4), urdf()], ids=["small", "tiny", "urdf"]
)
def test_all_distances_of_a_description_are_those_of_mujoco(text, rng):
    """Any two geoms, neighbours too, which overlap at their joints."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    pairs = np.array(list(itertools.combinations(range(model.ngeom), 2)))
    near, compared = near_pairs(model, pairs), 0
    for _ in range(8):
        data.qpos[:] = rng.uniform(-1.5, 1.5, model.nq)
        mujoco.mj_kinematics(model, data)
        distance = near.query(data.geom_xpos, data.geom_xmat, np.inf)[1]
        for d, (a, b) in zip(distance, pairs.tolist(), strict=True):
            if d > -0.01:
                theirs = mujoco.mj_geomDistance(model, data, a, b, 10.0, None)
                assert d == pytest.approx(theirs, abs=1e-6)
                compared += 1
    assert compared > 200


def some_shapes(rng: np.random.Generator) -> mujoco.MjModel:
    """Two of each kind, one of which stands still; every pair counts."""
    spec = mujoco.MjSpec()
    for kind in range(7):
        for free in (False, True):
            if kind == PLANE and free:
                continue
            s = drawn(kind, rng, spread=0.6)
            body = spec.worldbody.add_body(pos=s.p)
            if free:
                body.add_freejoint()
            g = body.add_geom(type=SHAPES[kind], size=s.size / 2, mass=1.0)
            if kind == MESH:
                spec.add_mesh(name=f"m{free}", uservert=s.vertices.ravel())
                g.meshname = f"m{free}"
    return spec.compile()


@pytest.mark.parametrize("size", [1e-12, 1e-4, 0.01, 0.3])
def test_what_was_asked_before_changes_no_answer(size, rng):
    """Steps of any size, bit for bit the answers of a workspace that is new."""
    model = some_shapes(rng)
    data = mujoco.MjData(model)
    pairs = np.array(list(itertools.combinations(range(model.ngeom), 2)))
    used, found = near_pairs(model, pairs), 0
    everything = np.ones(len(pairs), dtype=bool)
    for k in range(150):
        moves = rng.random(model.nv // 6) < 0.6
        v = size * rng.normal(size=model.nv) * np.repeat(moves, 6)
        mujoco.mj_integratePos(model, data.qpos, v, 1.0)
        if k % 40 == 39:
            data.qpos[:3] = np.nan if k % 80 == 39 else 0.0
        mujoco.mj_kinematics(model, data)
        reach = float(rng.choice([0.0, 0.02, 0.1, 0.3]))
        active = rng.random(len(pairs)) < 0.8 if k % 3 else None
        all_of_it = near_pairs(model, pairs).query(
            data.geom_xpos, data.geom_xmat, np.inf, everything
        )
        counts = everything if active is None else active
        keep = ~(all_of_it[1] >= reach) & counts[all_of_it[0]]
        answer = used.query(data.geom_xpos, data.geom_xmat, reach, active)
        for x, y in zip(answer, all_of_it, strict=True):
            np.testing.assert_array_equal(x, y[keep])
        found += keep.sum()
    assert found > 300


@pytest.mark.parametrize(("a", "b"), ANY_TWO)
def test_pairs_are_near_to_the_last_hundredth_of_a_millimetre(a, b, rng):
    """No bound is farther than the distance."""
    for _ in range(20):
        one, other = drawn(a, rng), drawn(b, rng)
        if asked(one, other).distance < 0.0:
            continue
        for gap, met in ((0.05 - 1e-5, 1), (0.05 + 1e-5, 0)):
            near = shifted(one, other, gap)
            for first, second in ((one, near), (near, one)):
                question = workspace(first, second)
                assert len(question(0.05)[0]) == met


def test_what_a_turn_alone_brings_near_is_found(rng):
    """The tip of a long capsule strikes a ball: no bound of the move is shorter."""
    rod, angles = placed(CAPSULE, (1e-4, 1.0, 0.0)), rng.uniform(1e-3, 3.0, 30)
    for angle in angles:
        turned = replace(rod, R=Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix())
        way = turned.R[:, 2] - rod.R[:, 2]
        ball = turned.R[:, 2] + way / np.linalg.norm(way) * 0.002
        near = workspace(rod, placed(SPHERE, (1e-3, 0, 0), ball))
        assert len(near(1e-3)[0]) == 0
        assert len(near(1e-3, turned)[0]) == 1


def test_a_plane_that_turns_is_looked_at_again():
    plane = placed(PLANE)
    near = workspace(plane, placed(SPHERE, (0.1, 0, 0), (1e3, 0.0, 1.0)))
    for angle, met in ((0.0, 0), (2e-3, 0), (-2e-3, 1), (0.0, 0)):
        R = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        assert len(near(0.1, replace(plane, R=R))[0]) == met


def test_a_workspace_says_what_it_cannot_take():
    kinds, size = np.array([SPHERE, BOX], dtype=np.int32), np.ones((2, 3))
    none, pair = [np.zeros((0, 3))] * 2, np.array([[0, 1]], dtype=np.int32)
    with pytest.raises(ValueError, match="kind of shape"):
        _core.Proximity(kinds + 10, size, none, pair)
    with pytest.raises(ValueError, match="each shape"):
        _core.Proximity(kinds, size[:1], none, pair)
    with pytest.raises(ValueError, match="names a shape"):
        _core.Proximity(kinds, size, none, pair + 1)
    near = _core.Proximity(kinds, size, none, pair)
    with pytest.raises(ValueError, match="each shape"):
        near.query(np.zeros((1, 3)), np.zeros((1, 9)), 0.1)
    with pytest.raises(ValueError, match="counts"):
        near.query(np.zeros((2, 3)), np.zeros((2, 9)), 0.1, np.ones(3, dtype=bool))
