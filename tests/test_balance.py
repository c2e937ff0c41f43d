"""The centre of mass brought back from the border of its support."""

from __future__ import annotations

import math

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.execution.balance import FADE, HIGH, MOST, ON_GROUND, SAG, Balance
from clamber.model.kinematics import Kinematics
from clamber.model.se3 import quat_from_matrix
from clamber.planning.records import Plan
from clamber.step.polygon import com_margin, support_polygon

PERIOD = 0.01
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def kneeling(demo_plan: Plan) -> tuple[np.ndarray, tuple[Contact, ...]]:
    """Posture (nq,) on elbows and knees on the box, and its contacts."""
    key = demo_plan.keyframes[-1]
    return key.q, key.stance


@pytest.fixture
def kin(demo_plan: Plan) -> Kinematics:
    return Kinematics(demo_plan.world)


def margin_of(kin: Kinematics, q: np.ndarray, contacts) -> float:
    kin.update(q)
    points = np.vstack([kin.bearing_points(c.surface, UP, c.edge) for c in contacts])
    return com_margin(kin.com[:2], support_polygon(points[:, :2]))


def narrow(kin: Kinematics, q: np.ndarray, contacts) -> tuple[tuple[Contact, ...], ...]:
    """The contacts without one of them, from the least margin to the largest."""
    ways = [tuple(c for c in contacts if c is not x) for x in contacts]
    return tuple(sorted(ways, key=lambda way: margin_of(kin, q, way)))


def moved(kin: Kinematics, q: np.ndarray, xy: np.ndarray, contacts) -> np.ndarray:
    """(nq,) with the centre of mass moved by `xy` (2,), the contacts where they were.

    By Newton steps on all of them together, independent of what is tested.
    """
    kin.update(q)
    goal = kin.com[:2] + xy
    places = [kin.contact_point(c.surface, UP, c.edge).copy() for c in contacts]
    for _ in range(20):
        kin.update(q)
        rows, errors = [kin.com_jacobian()[:2].copy()], [goal - kin.com[:2]]
        for c, p in zip(contacts, places, strict=True):
            body = kin.world.surfaces[c.surface].body
            here = kin.contact_point(c.surface, UP, c.edge)
            rows.append(kin.point_jacobian(body, here).copy())
            errors.append(p - here)
        d, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(errors), rcond=None)
        q = kin.integrate(q, d)
    assert np.abs(np.concatenate(errors)).max() < 1e-6
    return q


def answered(plan: Plan, q, reference, contacts, ticks: int = 1) -> np.ndarray:
    """(na,) offset of the joints after some looks at the same posture."""
    balance = Balance(plan.world, PERIOD)
    for _ in range(ticks):
        balance.update(q, reference, contacts)
    return balance.goal


def shift_of(kin: Kinematics, q: np.ndarray, offset: np.ndarray, contacts):
    """(2,) how far joint offsets move the centre of mass, the contacts held."""
    w = kin.world
    kin.update(q)
    rows, own = [], []
    for c in contacts:
        s = w.surfaces[c.surface]
        p = kin.contact_point(c.surface, UP, c.edge)
        rows.append(kin.point_jacobian(s.body, p).copy())
    J = np.vstack(rows)
    free = np.setdiff1d(np.arange(w.model.nv), w.dadr)
    # What the base does so that the contacts stay, as well as they can.
    own, *_ = np.linalg.lstsq(J[:, free], -J[:, w.dadr] @ offset, rcond=None)
    v = np.zeros(w.model.nv)
    v[free], v[w.dadr] = own, offset
    slip = np.abs(J @ v).max()
    return kin.com_jacobian()[:2] @ v, slip


def outward(kin: Kinematics, q: np.ndarray, contacts) -> np.ndarray:
    """(2,) unit vector along which the margin shrinks fastest, by differences."""
    kin.update(q)
    points = np.vstack([kin.bearing_points(c.surface, UP, c.edge) for c in contacts])
    polygon, com = support_polygon(points[:, :2]), kin.com[:2].copy()
    g = [
        com_margin(com - h, polygon) - com_margin(com + h, polygon)
        for h in 1e-5 * np.eye(2)
    ]
    return np.array(g) / np.linalg.norm(g)


def endangered(plan: Plan, kin: Kinematics, kneeling):
    """Reference on three contacts with 30 mm, and as it has sagged to 8 mm."""
    q, contacts = kneeling
    three = narrow(kin, q, contacts)[-1]
    q = at_margin(kin, q, three, 0.03)
    return q, at_margin(kin, q, three, 0.008), three, outward(kin, q, three)


def at_margin(kin: Kinematics, q: np.ndarray, contacts, margin: float) -> np.ndarray:
    for _ in range(10):
        more = margin_of(kin, q, contacts) - margin
        q = moved(kin, q, more * outward(kin, q, contacts), contacts)
    assert margin_of(kin, q, contacts) == pytest.approx(margin, abs=1e-6)
    return q


def test_with_its_margin_the_robot_is_let_alone(demo_plan, kin):
    """To the last bit, whatever its deviation."""
    q, contacts = demo_plan.start.q, demo_plan.start.stance
    assert margin_of(kin, q, contacts) > HIGH + 0.02
    n = outward(kin, q, contacts)
    aside = moved(kin, q, 0.01 * n, contacts)
    assert not answered(demo_plan, aside, q, contacts, ticks=100).any()


def test_near_the_border_it_is_brought_back_and_contacts_stay(demo_plan, kin, kneeling):
    """By the proportional law at first: the rate and the integral are small."""
    q, sagged, three, n = endangered(demo_plan, kin, kneeling)
    offset = answered(demo_plan, sagged, q, three, ticks=30)
    shift, slip = shift_of(kin, q, offset, three)
    assert shift @ n < -5e-3  # inwards
    assert abs(shift @ [-n[1], n[0]]) < 0.3 * abs(shift @ n)
    assert slip < 1e-3
    assert np.linalg.norm(shift) < 1.05 * MOST


def test_the_integral_goes_on_up_to_its_bound(demo_plan, kin, kneeling):
    q, sagged, three, n = endangered(demo_plan, kin, kneeling)
    sizes = []
    for ticks in (20, 50, 80, 2000):
        offset = answered(demo_plan, sagged, q, three, ticks=ticks)
        sizes.append(-float(shift_of(kin, q, offset, three)[0] @ n))
    assert sizes == sorted(sizes)
    assert sizes[-1] == pytest.approx(MOST, rel=0.1)


@pytest.mark.parametrize("kneels", [False, True])
def test_it_sets_in_between_two_margins(demo_plan, kin, kneeling, kneels):
    """Nothing above the one, all of it below the other, and no jump; later on feet."""
    q, contacts = demo_plan.start.q, demo_plan.start.stance
    high, fade = ON_GROUND
    if kneels:
        q, contacts = kneeling
        high, fade = HIGH, FADE
    q = at_margin(kin, q, contacts, high + 0.01)
    sizes = []
    low = high - fade
    for margin in (high + 0.001, high - 0.001, high - 0.5 * fade, low, low - 0.001):
        sagged = at_margin(kin, q, contacts, margin)
        offset = answered(demo_plan, sagged, q, contacts, ticks=30)
        shift = shift_of(kin, q, offset, contacts)[0]
        sizes.append(float(np.linalg.norm(shift)))
    assert sizes[0] == 0.0
    assert 0.0 < sizes[1] < 0.3 * sizes[2]
    assert 0.3 * sizes[4] < sizes[2] < 0.8 * sizes[4]
    assert sizes[3] == pytest.approx(sizes[4], rel=0.15)


@pytest.mark.parametrize(("more", "acts"), [(0.9 * SAG, False), (1.5 * SAG, True)])
def test_what_was_planned_near_the_border_is_let_alone(
    demo_plan, kin, kneeling, more, acts
):
    """A narrow sole has no more: only what is lost of that is brought back."""
    q, contacts = kneeling
    three = narrow(kin, q, contacts)[-1]
    q = at_margin(kin, q, three, 0.015)
    sagged = at_margin(kin, q, three, 0.015 - more)
    assert answered(demo_plan, sagged, q, three, ticks=30).any() == acts


def test_where_the_robot_is_and_how_it_is_turned_does_not_matter(
    demo_plan, kin, kneeling
):
    """Its contacts are where they were felt, not where they were planned."""
    q, sagged, three, _ = endangered(demo_plan, kin, kneeling)
    c, s = math.cos(0.3), math.sin(0.3)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = sagged.copy()
    turned[:3] = R @ sagged[:3] + [0.2, -0.1, 0.03]
    kin.update(sagged)
    turned[3:7] = quat_from_matrix(R @ kin.rotation(kin.world.base))
    there = answered(demo_plan, turned, q, three, ticks=30)
    here = answered(demo_plan, sagged, q, three, ticks=30)
    assert np.allclose(there, here, atol=1e-9)


def test_back_within_its_margin_the_offset_fades(demo_plan, kin, kneeling):
    q, sagged, three, _ = endangered(demo_plan, kin, kneeling)
    balance = Balance(demo_plan.world, PERIOD)
    for _ in range(200):
        balance.update(sagged, q, three)
    sizes = []
    for _ in range(1000):
        balance.update(q, q, kneeling[1])
        sizes.append(float(np.abs(balance.goal).max()))
    assert np.all(np.diff(sizes[20:]) <= 1e-12)
    assert sizes[-1] < 1e-9


def test_in_the_air_nothing_is_asked_for(demo_plan, kneeling):
    q, _ = kneeling
    balance = Balance(demo_plan.world, PERIOD)
    balance.update(q, q, ())
    assert not balance.goal.any()


def test_a_sole_keeps_its_direction(demo_plan, kin):
    """Both feet on the ground, the centre of mass at their front."""
    key = demo_plan.keyframes[0]
    q, feet = key.q, key.stance
    n = outward(kin, q, feet)
    lean = margin_of(kin, q, feet) - 0.005
    w = kin.world
    J = kin.com_jacobian()[:2].copy()
    rows = [J]
    for c in feet:
        s = w.surfaces[c.surface]
        rows += [x.copy() for x in kin.jacobians(s.body, kin.contact_point(s.name, UP))]
    A = np.vstack(rows)
    b = np.zeros(len(A))
    b[:2] = lean * n
    ahead = kin.integrate(q, np.linalg.lstsq(A, b, rcond=None)[0])
    offset = answered(demo_plan, ahead, q, feet, ticks=30)
    kin.update(q)
    v = np.zeros(w.model.nv)
    v[w.dadr] = offset
    # Some motion of the base leaves both soles as they are, place and direction.
    J = np.vstack(rows[1:])
    free = np.setdiff1d(np.arange(w.model.nv), w.dadr)
    v[free] = np.linalg.lstsq(J[:, free], -J @ v, rcond=None)[0]
    assert np.abs(J @ v).max() < 1e-3
    kin.update(q)
    assert kin.com_jacobian()[:2] @ v @ n < -2e-3
