"""Static stability against hand-computed cases, HiGHS, SciPy's hull and Klampt."""

import json
import math
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from scipy.optimize import linprog

from clamber.model.se3 import matrix_from_rpy
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.statics import (
    BALANCE_TOL,
    GRAVITY,
    ContactForces,
    ContactPoints,
    Load,
    StaticEquilibrium,
    TorqueLimits,
    cone_generators,
    contact_angle,
    contact_forces,
    contact_frames,
    contact_phase,
    is_statically_stable,
    projected_distance,
    static_equilibrium,
    strength_needed,
    theta_max,
)

UP = np.array([0.0, 0.0, 1.0])
MASS = 30.0
WEIGHT = MASS * GRAVITY
SQUARE = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])


def flat(xy: np.ndarray, mu: float, *names: str) -> ContactPoints:
    """Contacts on level ground, all of one foot or by name."""
    n = len(xy)
    return ContactPoints(
        points=np.c_[xy, np.zeros(n)],
        normals=np.tile(UP, (n, 1)),
        mu=np.full(n, mu),
        names=names or ("foot",) * n,
    )


def random_stance(rng: np.random.Generator) -> tuple[ContactPoints, np.ndarray]:
    """2 to 8 points, tilted normals, mu from 0.2 to 1, a centre of mass near."""
    nc = int(rng.integers(2, 9))
    points = rng.uniform(-0.4, 0.4, (nc, 3)) * [1.0, 1.0, 0.5]
    normals = np.c_[rng.normal(0.0, 0.35, (nc, 2)), np.ones(nc)]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    com = np.append(points[:, :2].mean(axis=0) + rng.normal(0.0, 0.08, 2), 0.5)
    mu, names = rng.uniform(0.2, 1.0, nc), [str(i) for i in range(nc)]
    return ContactPoints(points=points, normals=normals, mu=mu, names=names), com


def judged(contacts: ContactPoints, com, torque=None) -> StaticEquilibrium:
    """The verdict on a robot of `MASS`."""
    load = Load(com=np.asarray(com, dtype=float), mass=MASS)
    return static_equilibrium(contacts, load, torque=torque)


def least_forces(contacts: ContactPoints, com, torque=None) -> ContactForces:
    """That hold a robot of `MASS`."""
    load = Load(com=np.asarray(com, dtype=float), mass=MASS)
    return contact_forces(contacts, load, torque=torque)


def random_torque(
    rng: np.random.Generator, contacts: ContactPoints, com: np.ndarray
) -> TorqueLimits:
    """Of a robot of `MASS` with five joints, in any direction, some of them weak."""
    J = rng.normal(size=(3 * len(contacts.points), 11)) * 0.3
    for i, p in enumerate(contacts.points):
        J[3 * i : 3 * i + 3, :6] = np.c_[np.eye(3), np.cross(np.eye(3), p - com).T]
    return TorqueLimits(
        jacobian=J,
        gravity=np.r_[0.0, 0.0, WEIGHT, 0.0, 0.0, 0.0, rng.normal(0.0, 10.0, 5)],
        dofs=np.arange(6, 11),
        limits=rng.uniform(5.0, 80.0, 5),
        names=[f"joint {j}" for j in range(5)],
    )


def lp_holds(
    c: ContactPoints, com, weight=(0.0, 0.0, 1.0), torque: TorqueLimits | None = None
) -> bool:
    """The defining LP, written out contact by contact, solved by HiGHS."""
    columns, loads = [], []
    cones = cone_generators(c.normals, c.mu, c.cone_edges)
    for i, (p, edges) in enumerate(zip(c.points, cones, strict=True)):
        columns += [np.append(e, np.cross(p - com, e)) for e in edges]
        if torque is not None:
            J = torque.jacobian[3 * i : 3 * i + 3, torque.dofs]
            loads += [J.T @ e for e in edges]
    A, b = np.array(columns).T, [*weight, 0.0, 0.0, 0.0]
    A_ub = b_ub = None
    if torque is not None:
        T, g = np.array(loads).T, torque.gravity[torque.dofs]
        A_ub = np.r_[T, -T] * WEIGHT
        b_ub = np.r_[g + torque.limits, torque.limits - g]
    return linprog(np.zeros(A.shape[1]), A_ub, b_ub, A, b).status == 0


# The geometric measure.


def test_projected_distance_is_horizontal_on_level_ground():
    assert projected_distance([0.1, 0.2, 0.3], [0.4, 0.6, 0.9]) == pytest.approx(0.5)


def test_projected_distance_is_measured_across_the_given_normal():
    R = matrix_from_rpy([0.3, -0.2, 0.5])
    contact, mass = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.6, 0.9])
    d = projected_distance(R @ contact, R @ mass, R[:, 2])
    assert d == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("mass", "angle"),
    [((0, 0, 1), 0.0), ((1, 0, 1), math.pi / 4), ((0, 0, -1), math.pi)],
)
def test_contact_angle_is_from_the_vertical(mass, angle):
    assert contact_angle([0, 0, 0], mass) == pytest.approx(angle)


def test_d_is_l_times_the_sine_of_the_contact_angle():
    rng = np.random.default_rng(0)
    for contact, mass in rng.normal(size=(20, 2, 3)):
        l = np.linalg.norm(mass - contact)
        d = l * math.sin(contact_angle(contact, mass))
        assert projected_distance(contact, mass) == pytest.approx(d)


def test_theta_max_is_the_friction_angle_up_to_25_degrees():
    assert theta_max(0.2) == pytest.approx(math.atan(0.2))
    assert theta_max(0.8) == pytest.approx(math.radians(25))


def test_a_contact_supports_up_to_the_bound_and_slides_beyond():
    bound = 0.5 * math.sin(theta_max(0.8))
    near, far = bound - 1e-9, bound + 1e-9
    assert contact_phase(near, 0.5, theta_max(0.8), loaded=True) == "supporting"
    wanted = "reach-to-supportable"
    assert contact_phase(near, 0.5, theta_max(0.8), loaded=False) == wanted
    for loaded in (True, False):
        assert contact_phase(far, 0.5, theta_max(0.8), loaded=loaded) == "sliding"


# Friction cones.


def test_contact_frames_are_rotations_onto_the_normal():
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.r_[normals, np.eye(3), -np.eye(3)]
    R = contact_frames(normals)
    np.testing.assert_allclose(R[:, :, 2], normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    gram = R.transpose(0, 2, 1) @ R
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (56, 1, 1)), atol=1e-9)


def test_pyramids_lie_inside_the_cone_with_their_edges_on_it():
    rng = np.random.default_rng(9)
    contacts, _ = random_stance(rng)
    normals, mu = contacts.normals, contacts.mu
    for edges in (4, 8):
        E = cone_generators(normals, mu, edges)
        normal_part = np.einsum("nmj,nj->nm", E, normals)
        tangential = np.linalg.norm(E - normals[:, None], axis=2)
        np.testing.assert_allclose(normal_part, 1.0)
        np.testing.assert_allclose(tangential, np.tile(mu[:, None], edges))


# Balance of the whole body.


@pytest.mark.parametrize("slope", [0.05, 0.2, 0.4, 0.6])
def test_a_block_on_a_slope_holds_iff_the_slope_is_within_the_friction_angle(slope):
    """The slope runs along a pyramid's edge, where the pyramid reaches the cone."""
    R = matrix_from_rpy([0.0, slope, 0.0])
    com = R @ [0.0, 0.0, 0.05]
    for factor, holds in ((1.001, True), (0.999, False)):
        level = flat(SQUARE, math.tan(slope) * factor)
        block = replace(level, points=level.points @ R.T, normals=level.normals @ R.T)
        assert is_statically_stable(block, com) == holds
        verdict = judged(block, com)
        assert verdict.feasible == holds
        assert verdict.limiting == "foot"


def test_on_level_ground_forces_and_support_polygon_agree():
    rng = np.random.default_rng(10)
    stable = 0
    for _ in range(300):
        xy = rng.uniform(-0.3, 0.3, (int(rng.integers(3, 9)), 2))
        com = np.append(rng.uniform(-0.3, 0.3, 2), 0.6)
        margin = com_margin(com, support_polygon(xy))
        if abs(margin) < 1e-4:
            continue
        stable += margin > 0
        assert is_statically_stable(flat(xy, 0.3), com) == (margin > 0)
    assert 50 < stable < 250


@pytest.mark.parametrize("edges", [4, 8])
@pytest.mark.whole
def test_the_quick_verdict_is_that_of_the_linear_program(edges):
    rng = np.random.default_rng(11)
    verdicts = []
    for _ in range(300):
        contacts, com = random_stance(rng)
        contacts = replace(contacts, cone_edges=edges)
        verdicts.append(is_statically_stable(contacts, com))
        assert verdicts[-1] == lp_holds(contacts, com)
    assert 60 < sum(verdicts) < 240


def test_a_normal_of_the_wrong_sign_is_no_support():
    foot, com = flat(SQUARE, 0.5), np.array([0.0, 0.0, 0.4])
    ceiling = replace(foot, normals=-foot.normals)
    assert is_statically_stable(foot, com)
    assert not is_statically_stable(ceiling, com)
    verdict = judged(ceiling, com)
    assert (verdict.feasible, verdict.margin) == (False, -1.0)
    assert verdict.limiting == "foot"


def test_nothing_holds_a_robot_without_contacts():
    nothing = flat(np.zeros((0, 2)), 0.5)
    assert not is_statically_stable(nothing, UP)
    verdict = judged(nothing, UP)
    assert (verdict.feasible, verdict.margin, verdict.limiting) == (False, -1.0, None)
    assert least_forces(nothing, UP).residual == 1.0


def test_the_margin_on_level_ground_is_the_push_that_tips_or_slides():
    """A push at height h tips at distance / h and slides at the pyramid's mu."""
    foot = flat(SQUARE, 0.5)
    for x, h, push in (
        (0.0, 0.8, 0.1 / 0.8),
        (0.06, 0.8, 0.04 / 0.8),
        (0.14, 0.8, -0.04 / 0.8),
        (0.0, 0.1, 0.5 / math.sqrt(2)),
    ):
        assert judged(foot, [x, 0.0, h]).margin == pytest.approx(push, abs=1e-5)
    for edges in (8, 16):  # closer to the cone
        verdict = judged(replace(foot, cone_edges=edges), [0.0, 0.0, 0.1])
        reach = math.cos(math.pi / edges)
        assert verdict.margin == pytest.approx(0.5 * reach, abs=1e-5)


def test_the_margin_on_level_ground_is_that_of_the_centre_of_mass_over_its_height():
    """Outside too, where the nearest push that helps may be towards a corner."""
    rng = np.random.default_rng(20)
    outside = 0
    for _ in range(40):
        xy = rng.uniform(-0.1, 0.1, (7, 2))
        com = np.append(rng.uniform(-0.12, 0.12, 2), 0.8)
        expected = com_margin(com, support_polygon(xy)) / 0.8
        outside += expected < 0
        assert judged(flat(xy, 0.9), com).margin == pytest.approx(expected, abs=2e-6)
    assert 10 < outside < 35


def test_the_margin_falls_as_the_centre_of_mass_moves_outwards():
    rng = np.random.default_rng(12)
    feet = flat(rng.uniform(-0.3, 0.3, (6, 2)), 0.9)
    tilts = [matrix_from_rpy([*rng.normal(0, 0.1, 2), 0])[:, 2] for _ in feet.mu]
    feet = replace(feet, normals=np.stack(tilts))
    centre = feet.points.mean(axis=0) + 0.7 * UP
    margins = [
        judged(feet, centre + x * np.array([1.0, 0.3, 0.0])).margin
        for x in np.linspace(0.05, 0.5, 8)
    ]
    assert np.all(np.diff(margins) < 0)
    assert margins[0] > 0 > margins[-1]


def test_the_sign_of_the_margin_is_the_quick_verdict():
    rng = np.random.default_rng(13)
    for _ in range(60):
        contacts, com = random_stance(rng)
        verdict = judged(contacts, com)
        assert verdict.feasible == (verdict.margin >= -1e-6)
        assert verdict.feasible == is_statically_stable(contacts, com)


@pytest.mark.parametrize("jointed", [False, True])
@pytest.mark.whole
def test_the_margin_is_the_least_push_over_all_directions(jointed):
    """Pushes just within the margin hold in every direction, one beyond it does not."""
    rng = np.random.default_rng(14)
    angles = np.linspace(0, 2 * math.pi, 180)
    ring = np.c_[np.cos(angles), np.sin(angles)]
    checked = 0
    while checked < 5:
        contacts, com = random_stance(rng)
        torque = random_torque(rng, contacts, com) if jointed else None
        margin = judged(contacts, com, torque).margin
        if not 0.01 < margin < 0.9:
            continue
        if torque is not None and margin > judged(contacts, com).margin - 1e-3:
            continue  # no joint limits it
        checked += 1

        def holds(push, contacts=contacts, com=com, torque=torque):
            return lp_holds(contacts, com, (*-push, 1.0), torque)

        assert all(holds(0.999 * margin * u) for u in ring)
        assert not all(holds(1.02 * margin * u) for u in ring)


def test_another_contact_never_lowers_the_margin():
    rng = np.random.default_rng(15)
    for _ in range(15):
        c, com = random_stance(rng)
        fewer = ContactPoints(
            points=c.points[:-1],
            normals=c.normals[:-1],
            mu=c.mu[:-1],
            names=c.names[1:],
        )
        assert judged(c, com).margin >= judged(fewer, com).margin - 1e-5


@pytest.mark.parametrize("mu_floor", [0.2, 0.3])
def test_a_ladder_holds_iff_its_foot_does_not_slide(mu_floor):
    """Against a slippery wall: W d / (2 h) at the wall, borne by the floor's mu W."""
    h = 1.0
    for factor, holds in ((0.98, True), (1.02, False)):
        d = 2 * h * mu_floor * factor
        rails = np.array([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])
        ladder = ContactPoints(
            points=np.r_[rails, rails + np.array([d, 0.0, h])],
            normals=np.repeat([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], 2, axis=0),
            mu=np.array([mu_floor, mu_floor, 1e-3, 1e-3]),
            names=["foot", "foot", "top", "top"],
        )
        verdict = judged(ladder, [d / 2, 0.0, h / 2])
        assert verdict.feasible == holds
        assert verdict.limiting == "foot"


def test_what_limits_is_what_had_to_pull_or_turns_or_nothing():
    apart = np.array([0.0, 0.2])
    feet = flat(
        np.r_[SQUARE + apart, SQUARE - apart], 0.9, *["left"] * 4, *["right"] * 4
    )
    tips = judged(feet, [0.0, -0.32, 0.8])
    assert not tips.feasible
    assert tips.limiting == "left"
    # On one point there is no margin: it leans back by 0.05 / 0.5.
    hand = flat(np.zeros((1, 2)), 0.5, "hand")
    for x, margin in ((0.0, 0.0), (0.05, -0.1)):
        verdict = judged(hand, [x, 0.0, 0.5])
        assert verdict.margin == pytest.approx(margin, abs=1e-6)
        assert verdict.limiting == "hand"
    # Four feet of a table tip over two of them, by a push of 0.1 / 0.5 of the weight.
    corners = np.array([[x, y] for x in (0.1, -0.1) for y in (0.2, -0.2)])
    verdict = judged(flat(corners, 0.8, *"abcd"), [0.0, 0.0, 0.5])
    assert verdict.margin == pytest.approx(0.2, abs=1e-6)
    assert verdict.limiting in {*"abcd"}
    # Six faces that grip: four walls around, floor and ceiling.
    directions = np.r_[np.eye(3), -np.eye(3)]
    points = np.repeat(-0.3 * directions, 4, axis=0)
    for i, d in enumerate(directions):
        axes = np.array([np.roll(np.abs(d), 1), np.roll(np.abs(d), 2), d])
        points[4 * i : 4 * i + 4] += 0.05 * np.c_[SQUARE, np.zeros(4)] @ axes
    shaft = ContactPoints(
        points=points,
        normals=np.repeat(directions, 4, axis=0),
        mu=np.full(24, 0.5),
        names=["wall"] * 24,
    )
    verdict = judged(shaft, np.zeros(3))
    assert verdict.margin == pytest.approx(1.0)
    assert verdict.limiting is None


def test_of_contacts_that_yield_alike_the_first_limits():
    """Both feet slide as one, whatever the last bits of their duals say."""
    rng = np.random.default_rng(23)
    apart = np.array([0.0, 0.3])
    feet = flat(
        np.r_[SQUARE + apart, SQUARE - apart], 0.1, *["left"] * 4, *["right"] * 4
    )
    for _ in range(40):
        verdict = judged(feet, [*rng.uniform(-0.05, 0.05, 2), 0.1])
        assert verdict.margin == pytest.approx(0.1 / math.sqrt(2), abs=1e-5)
        assert verdict.limiting == "left"


# Contact forces.


def test_contact_forces_balance_gravity_within_the_cones():
    rng = np.random.default_rng(16)
    checked = 0
    for _ in range(100):
        c, com = random_stance(rng)
        if not is_statically_stable(c, com):
            continue
        checked += 1
        held = least_forces(c, com)
        f = held.forces
        wrench = [*f.sum(axis=0), *np.cross(c.points - com, f).sum(axis=0)]
        np.testing.assert_allclose(
            wrench, [0, 0, WEIGHT, 0, 0, 0], atol=2 * BALANCE_TOL * WEIGHT
        )
        assert held.residual <= BALANCE_TOL
        fn = np.sum(f * c.normals, axis=1)
        ft = np.linalg.norm(f - fn[:, None] * c.normals, axis=1)
        assert np.all(ft <= c.mu * fn + 1e-5 * WEIGHT)
    assert checked > 30


def test_contact_forces_are_the_least_of_those_that_balance():
    """Against the weighted pseudo-inverse, where no cone binds."""
    level = flat(np.r_[SQUARE, [[0.3, 0.0]]], 0.8)
    hand = np.outer([0, 0, 0, 0, 1], [0.0, 0.0, 0.3])  # on a table
    stance = replace(level, points=level.points + hand)
    com = np.array([0.06, 0.02, 0.5])
    moments = [np.cross(p - com, np.eye(3)).T for p in stance.points]
    G = np.concatenate([np.tile(np.eye(3), (1, 5)), np.concatenate(moments, axis=1)])
    S = np.tile([0.5, 0.5, 1.0], 5)  # tangential forces weigh four times as much
    expected = S * (np.linalg.pinv(G * S) @ [0, 0, WEIGHT, 0, 0, 0])
    held = least_forces(stance, com)
    np.testing.assert_allclose(held.forces.ravel(), expected, atol=1e-3)


@pytest.mark.parametrize("edges", [4, 7])
def test_contact_forces_are_those_of_the_program_written_out(edges):
    """With what is left over as variables, bound to the forces by equations."""
    rng = np.random.default_rng(21)
    for _ in range(20):
        c, com = random_stance(rng)
        c = replace(c, cone_edges=edges)
        torque, price = random_torque(rng, c, com), rng.uniform(0.5, 2.0, len(c.mu))
        load = Load(com=com, mass=MASS)
        held = contact_forces(c, load, torque=torque, price=price)
        nf, ns = 3 * len(c.mu), 11
        n = nf + ns  # forces in the world [weights], wrench left, torques left
        H = np.diag(np.r_[np.zeros(nf), np.full(ns, 1e8)])
        facets = np.zeros((edges * len(c.mu), n))
        balance = np.zeros((6, n))
        for i, (p, normal) in enumerate(zip(c.points, c.normals, strict=True)):
            at = slice(3 * i, 3 * i + 3)
            H[at, at] = price[i] * (4.0 * np.eye(3) - 3.0 * np.outer(normal, normal))
            balance[:, at] = np.r_[np.eye(3), np.cross(p - com, np.eye(3)).T]
            cone = cone_generators(normal[None], c.mu[i : i + 1], edges)[0]
            between = np.cross(np.roll(cone, -1, axis=0), cone)
            facets[i * edges : (i + 1) * edges, at] = between
        balance[:, nf : nf + 6] = np.eye(6)
        turns = np.zeros((5, n))
        turns[:, :nf] = torque.jacobian[:, torque.dofs].T
        turns[:, nf + 6 :] = np.eye(5)
        g = torque.gravity[torque.dofs]
        bounds = np.r_[g + torque.limits, torque.limits - g] / WEIGHT
        found = qpsolvers.solve_qp(
            H,
            np.zeros(n),
            np.r_[facets, turns, -turns],
            np.r_[np.zeros(len(facets)), bounds],
            balance,
            np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
            solver="daqp",
        )
        assert found is not None
        np.testing.assert_allclose(
            held.forces.ravel(), WEIGHT * found[:nf], atol=3e-5 * WEIGHT
        )
        left = np.linalg.norm(found[nf:])
        assert held.residual == pytest.approx(left, abs=3e-6)


def test_what_was_solved_before_or_beside_changes_no_bit():
    rng = np.random.default_rng(22)
    cases = []
    for _ in range(30):
        c, com = random_stance(rng)
        cases.append((c, com, random_torque(rng, c, com)))

    def solved(case):
        verdict = judged(*case)
        return verdict.margin, verdict.limiting, verdict.forces.tobytes()

    alone = [solved(case) for case in cases]
    assert [solved(case) for case in cases[::-1]] == alone[::-1]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(solved, cases)) == alone


def test_contact_forces_are_continuous_also_where_the_stance_stops_to_hold():
    """Beyond the border, the best effort leaves the lever arm over, and no more."""
    stance = flat(np.r_[SQUARE, [[0.3, 0.0]]], 0.4)
    xs = np.linspace(-0.3, 0.5, 1601)
    track = [least_forces(stance, [x, 0.03, 0.5]) for x in xs]
    forces = np.array([h.forces for h in track])
    jumps = np.abs(np.diff(forces, axis=0)).max(axis=(1, 2))
    assert jumps.max() < 0.02 * WEIGHT
    polygon = support_polygon(stance.points[:, :2])
    inside = np.array([com_margin([x, 0.03], polygon) for x in xs])
    residual = np.array([h.residual for h in track])
    assert np.all(residual[inside > 0] <= BALANCE_TOL)
    assert np.all(residual[inside < -1e-3] > 1e-4)
    assert np.all(forces[:, :, 2] >= -1e-6 * WEIGHT)
    assert 0.05 < least_forces(flat(SQUARE, 0.8), [0.2, 0.0, 0.5]).residual < 0.1


# Joint torques: a body on two straight legs whose feet are at (+-a, 0, -h) from the
# hips; both hips turn about y. A foot's force (fx, fz) costs its hip a torque.

A_LEG, H_LEG = 0.2, 0.5


def a_frame(
    limit: float, mu: float, *, leg_mass: float = 0.0, twice: bool = False
) -> tuple[ContactPoints, TorqueLimits]:
    """Feet and torque limits; dofs: base x y z, base rotation, left, right hip.

    The mass of each leg sits in its foot, so that feet cost the hips less torque. With
    `twice`, each leg has two feet, 0.1 m to either side.
    """
    legs = np.array([[A_LEG, 0.0, -H_LEG], [-A_LEG, 0.0, -H_LEG]])
    J = np.zeros((6, 8))
    for i, p in enumerate(legs):
        rows = slice(3 * i, 3 * i + 3)
        J[rows, :3] = np.eye(3)
        J[rows, 3:6] = np.cross(np.eye(3), p).T  # v = omega x p
        J[rows, 6 + i] = np.cross([0.0, 1.0, 0.0], p)
    leg = np.array([0.0, 0.0, leg_mass * GRAVITY])
    gravity = np.array([0.0, 0.0, WEIGHT, 0.0, 0.0, 0.0, 0.0, 0.0])
    gravity[6:] = J[:3, 6] @ leg, J[3:, 7] @ leg
    if twice:
        apart = np.array([0.0, 0.1, 0.0])
        legs, J = np.r_[legs + apart, legs - apart], np.tile(J, (2, 1))
    names = ["left_foot", "right_foot"] * (len(legs) // 2)
    feet = replace(flat(legs[:, :2], mu, *names), points=legs)
    return feet, TorqueLimits(
        jacobian=J,
        gravity=gravity,
        dofs=np.array([6, 7]),
        limits=np.full(2, limit),
        names=("left_hip", "right_hip"),
    )


def test_hip_torques_of_an_a_frame_are_those_computed_by_hand():
    """Vertical forces of half the weight: |tau| = a m g / 2, of opposite signs."""
    _, torque = a_frame(1e3, 0.5)
    forces = np.array([[0.0, 0.0, WEIGHT / 2], [0.0, 0.0, WEIGHT / 2]])
    expected = A_LEG * WEIGHT / 2
    np.testing.assert_allclose(torque.torques(forces), [expected, -expected])


@pytest.mark.parametrize("mu", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("leg_mass", [0.0, 2.0])
def test_an_a_frame_holds_iff_its_hips_bear_what_friction_leaves(mu, leg_mass):
    """Feet held together by mu m g / 2 relieve the hips to (a - mu h) m g / 2.

    Of a leg's own weight, which rests on the ground, the hip feels nothing.
    """
    needed = (A_LEG - mu * H_LEG) * WEIGHT / 2 - A_LEG * leg_mass * GRAVITY
    for factor, holds in ((1.001, True), (0.999, False)):
        feet, torque = a_frame(needed * factor, mu, leg_mass=leg_mass)
        assert is_statically_stable(feet, np.zeros(3))
        held = least_forces(feet, np.zeros(3), torque)
        assert (held.residual <= BALANCE_TOL) == holds
        verdict = judged(feet, np.zeros(3), torque)
        assert verdict.feasible == holds
        assert verdict.torques is not None
        if holds:
            assert np.all(np.abs(verdict.torques) <= torque.limits * (1 + 1e-5))


def test_torque_limits_lower_the_margin_and_name_the_weak_joint():
    feet, strong = a_frame(1e3, 0.3, twice=True)

    def verdict(*limits):
        return judged(feet, np.zeros(3), replace(strong, limits=np.array(limits)))

    free = judged(feet, np.zeros(3))
    assert verdict(1e3, 1e3).margin == pytest.approx(free.margin, abs=1e-6)
    assert free.margin > 0.1
    for k, weak in enumerate(strong.names):
        limits = [1e3, 1e3]
        limits[k] = 0.0
        weakened = verdict(*limits)
        assert not weakened.feasible
        assert weakened.margin < free.margin
        limits[k] = 9.0  # a little more than (a - mu h) m g / 2 = 7.4 N m
        assert 0 < verdict(*limits).margin < free.margin
        assert verdict(*limits).limiting == weak


def test_a_joint_that_no_contact_loads_limits_where_its_own_limb_is_too_heavy():
    feet, torque = a_frame(1e3, 0.5, twice=True)
    raised = replace(
        torque,
        jacobian=np.c_[torque.jacobian, np.zeros(12)],
        gravity=np.append(torque.gravity, 20.0),
        dofs=np.array([6, 7, 8]),
        limits=np.array([1e3, 1e3, 19.0]),
        names=(*torque.names, "shoulder"),
    )
    verdict = judged(feet, np.zeros(3), raised)
    assert (verdict.feasible, verdict.margin) == (False, -1.0)
    assert verdict.limiting == "shoulder"
    held = least_forces(feet, np.zeros(3), raised)
    assert held.residual == pytest.approx(1.0 / WEIGHT, rel=1e-3)
    enough = replace(raised, limits=np.array([1e3, 1e3, 21.0]))
    assert judged(feet, np.zeros(3), enough).feasible


# What is no stance.


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_stance_that_is_no_number_does_not_hold(bad):
    feet, torque = a_frame(1e3, 0.5, twice=True)
    points, jacobian = feet.points.copy(), torque.jacobian.copy()
    points[1, 2] = jacobian[4, 6] = bad
    for c, com, t in (
        (replace(feet, points=points), np.zeros(3), torque),
        (replace(feet, normals=points), np.zeros(3), torque),
        (feet, np.array([0.0, bad, 0.0]), torque),
        (feet, np.zeros(3), replace(torque, jacobian=jacobian)),
        (feet, np.zeros(3), replace(torque, gravity=np.full(8, math.nan))),
    ):
        with np.errstate(invalid="ignore"):
            verdict = judged(c, com, t)
        assert (verdict.feasible, verdict.margin) == (False, -1.0)
        assert not np.any(verdict.forces)
        assert least_forces(c, com, t).residual == 1.0
    assert not is_statically_stable(replace(feet, points=points), np.zeros(3))


def test_coincident_points_bear_as_one():
    one = flat(np.zeros((1, 2)), 0.5)
    eight = flat(np.zeros((8, 2)), 0.5)
    for x in (0.0, 0.05):
        com = [x, 0.0, 0.5]
        margin = judged(one, com).margin
        assert judged(eight, com).margin == pytest.approx(margin, abs=1e-6)
        total = least_forces(eight, com).forces.sum(axis=0)
        np.testing.assert_allclose(
            total, least_forces(one, com).forces.sum(axis=0), atol=1e-4 * WEIGHT
        )


def test_joints_without_strength_hold_nothing_and_ice_holds_what_is_upright():
    feet, torque = a_frame(0.0, 0.1, twice=True)
    verdict = judged(feet, np.zeros(3), torque)
    assert not verdict.feasible
    assert verdict.limiting in torque.names
    ice = flat(SQUARE, 1e-12)
    assert judged(ice, [0.05, 0.0, 0.5]).margin == pytest.approx(0.0, abs=1e-6)
    assert least_forces(ice, [0.05, 0.0, 0.5]).residual <= BALANCE_TOL


def test_the_strength_that_is_needed_is_that_computed_by_hand():
    """Upright forces on ice, and none that friction would turn inwards: a m g / 2."""
    needed, load = A_LEG * WEIGHT / 2, Load(com=np.zeros(3), mass=MASS)
    for limit in (0.1 * needed, needed, 3.0 * needed):
        feet, torque = a_frame(limit, 1e-9)
        torque = replace(torque, limits=np.array([limit, 10.0 * limit]))
        found = strength_needed(feet, load, torque)
        assert found is not None
        share, joint = found
        assert share == pytest.approx(needed / limit, rel=1e-5)
        assert torque.names[joint] == "left_hip"
    feet, torque = a_frame(needed, 0.5)
    beside = replace(load, com=np.array([2.0 * A_LEG, 0.0, 0.0]))
    assert strength_needed(feet, beside, torque) is None  # no strength stands there
    assert strength_needed(flat(np.zeros((0, 2)), 0.5), load, torque) is None


def test_the_strength_that_is_needed_is_where_postures_begin_to_hold():
    feet, torque = a_frame(1.0, 0.1, twice=True)
    found = strength_needed(feet, Load(com=np.zeros(3), mass=MASS), torque)
    assert found is not None
    for more, holds in ((0.99, False), (1.01, True)):
        scaled = replace(torque, limits=found[0] * more * torque.limits)
        assert judged(feet, np.zeros(3), scaled).feasible is holds


def test_the_rows_of_the_base_are_the_balance_of_the_whole_body():
    """What the record promises about J and g, hence why the base rows are left out."""
    feet, torque = a_frame(1e3, 0.5)
    held = least_forces(feet, np.zeros(3))
    base = torque.gravity[:6] - torque.jacobian[:, :6].T @ held.forces.ravel()
    np.testing.assert_allclose(base, 0.0, atol=1e-3)


def test_records_of_the_wrong_shape_are_refused():
    feet, good = a_frame(1.0, 0.5)
    for field, value in (("limits", np.ones(3)), ("jacobian", good.jacobian[:, :7])):
        with pytest.raises(ValueError, match=r"dofs|jacobian"):
            replace(good, **{field: value})
    with pytest.raises(ValueError, match="2 points"):
        replace(feet, mu=np.ones(3))
    com = np.zeros(3)
    with pytest.raises(ValueError, match="three edges"):
        judged(replace(feet, cone_edges=2), com)
    with pytest.raises(ValueError, match="dofs"):
        judged(feet, com, replace(good, dofs=np.array([6, 8])))
    with pytest.raises(ValueError, match="jacobian's rows"):
        judged(flat(SQUARE, 0.5), com, good)


# Against another library.


KLAMPT = """
import json, sys
from klampt import robotsim
edges, stances = json.load(sys.stdin)
robotsim.set_friction_cone_approximation_edges(edges)
found = [robotsim.com_equilibrium(c, (0, 0, -1), p) is not None for c, p in stances]
print(json.dumps(found))
"""


@pytest.mark.compare
@pytest.mark.parametrize("edges", [4, 8])
def test_verdicts_agree_with_klampt_on_a_thousand_stances(edges):
    """In a process of its own: without a terminal, Klampt's solver may abort."""
    pytest.importorskip("klampt.robotsim")
    rng = np.random.default_rng(17)
    stances = [random_stance(rng) for _ in range(1000)]
    asked = [
        (np.c_[c.points, c.normals, c.mu].tolist(), com.tolist()) for c, com in stances
    ]
    child = subprocess.run(
        [sys.executable, "-c", KLAMPT],
        input=json.dumps([edges, asked]),
        capture_output=True,
        text=True,
    )
    if child.returncode < 0:
        pytest.skip(f"Klampt ended by signal {-child.returncode}")
    theirs = json.loads(child.stdout.splitlines()[-1])
    stable = 0
    for (contacts, com), holds in zip(stances, theirs, strict=True):
        contacts = replace(contacts, cone_edges=edges)
        ours = is_statically_stable(contacts, com)
        stable += ours
        if ours != holds:  # only within rounding of the border
            assert abs(judged(contacts, com).margin) < 1e-5
    assert 200 < stable < 900


def test_the_quick_test_fits_a_planners_inner_loop():
    """5 us is the aim; a loaded machine gets ten times that."""
    rng = np.random.default_rng(18)
    took = []
    for contacts, com in [random_stance(rng) for _ in range(200)]:
        start = time.perf_counter()
        is_statically_stable(contacts, com)
        took.append(time.perf_counter() - start)
    assert np.median(took) < 50e-6
