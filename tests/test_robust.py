"""The margin that is left in the worst case."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from clamber import _core
from clamber.contact.steps import split_steps
from clamber.model.kinematics import Kinematics
from clamber.planning.planner import plan
from clamber.planning.records import Plan, PlanOptions
from clamber.step.change import Failure, change_contact
from clamber.step.ik import IK
from clamber.step.posture import KeyframeOptions
from clamber.step.robust import (
    COM,
    CONTACT,
    FRICTION,
    MASS,
    robust_margin,
    robust_margin_along,
)
from clamber.step.stability import statics_at
from clamber.step.statics import contact_forces

KEYS = range(7)
HOLDS = 1e-5  # [weights] left over by forces that hold


@pytest.fixture(scope="module")
def robust_plan(demo_plan: Plan) -> Plan:
    return plan(
        demo_plan.sequence,
        demo_plan.world.robot,
        demo_plan.world.scene,
        options=PlanOptions(robust=True),
    )


def worst(kin: Kinematics, key) -> float:
    return robust_margin(kin, key.q, key.stance)


def off_by(kin: Kinematics, key, mass, friction, com, contacts):
    """Whether forces hold a keyframe that is a little off; contacts (k, 2) [m]."""
    points, load, torque = statics_at(kin, key.q, key.stance)
    of = [[c.surface for c in key.stance].index(name) for name in points.names]
    moved = points.points.copy()
    moved[:, :2] += np.asarray(contacts)[of]
    points = replace(
        points, points=moved, mu=np.minimum(points.mu, friction * np.ones(len(of)))
    )
    load = replace(load, com=load.com + np.array([*com, 0.0]), mass=mass * load.mass)
    torque = replace(torque, gravity=mass * torque.gravity)
    return contact_forces(points, load, torque=torque).residual < HOLDS


@pytest.mark.parametrize("k", KEYS)
def test_the_room_of_the_centre_of_mass_is_that_of_the_linear_programme(demo_plan, k):
    """The border of where it may lie, direction by direction, by another solver."""
    kin, key = Kinematics(demo_plan.world), demo_plan.keyframes[k]
    points, load, torque = statics_at(kin, key.q, key.stance)
    room = _core.com_room(*points.arrays, load.com, load.mass, torque.arrays)
    rows = _core.load_rows(*points.arrays, load.com, torque.arrays)
    weight, n = 9.81 * load.mass, rows.shape[1]
    g = torque.gravity[torque.dofs]
    moments = np.zeros((6, 2))
    moments[3, 1], moments[4, 0] = -1.0, 1.0  # of a weight at (x, y)
    limits = np.concatenate([g + torque.limits, torque.limits - g]) / weight

    def reaches(angle: float) -> float:
        """How far the centre of mass may lie that way, wherever else it lies [m]."""
        u = np.array([np.cos(angle), np.sin(angle)])
        found = linprog(
            [*np.zeros(n), *-u],
            A_ub=np.pad(np.concatenate([rows[6:], -rows[6:]]), ((0, 0), (0, 2))),
            b_ub=limits,
            A_eq=np.column_stack([rows[:6], moments]),
            b_eq=[0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            bounds=[*[(0.0, None)] * n, (-1.0, 1.0), (-1.0, 1.0)],
        )
        assert found.status == 0
        return -found.fun

    # The nearest border is where that is least: it has a kink there.
    about, step = 0.0, np.pi
    for _ in range(5):
        angles = about + step * np.linspace(-1.0, 1.0, 61)
        about, step = angles[np.argmin([reaches(x) for x in angles])], step / 25
    least = reaches(about)
    assert room == pytest.approx(least, abs=1e-4)
    assert room <= least + 1e-6


def test_on_level_ground_it_is_the_margin_less_three_centimetres(demo_plan):
    key = demo_plan.keyframes[0]
    left = worst(Kinematics(demo_plan.world), key)
    assert left == pytest.approx(key.com_margin - COM - CONTACT, abs=1e-3)


@pytest.mark.parametrize("k", KEYS)
def test_what_is_off_by_no_more_than_it_may_is_held(robust_plan, k, rng):
    kin, key = Kinematics(robust_plan.world), robust_plan.keyframes[k]
    assert worst(kin, key) > 0.0
    for _ in range(40):
        mass, friction = rng.uniform(1 - MASS, 1 + MASS), rng.uniform(FRICTION, 1.0)
        angles = rng.uniform(0.0, 2 * np.pi, 1 + len(key.stance))
        ways = np.column_stack([np.cos(angles), np.sin(angles)])
        assert off_by(kin, key, mass, friction, COM * ways[0], CONTACT * ways[1:])


def test_where_it_is_negative_something_that_may_be_off_is_not_held(demo_plan):
    kin, key = Kinematics(demo_plan.world), demo_plan.keyframes[1]
    left = worst(kin, key)
    assert -0.02 < left < 0.0
    angles = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
    ways = np.column_stack([np.cos(angles), np.sin(angles)])

    def held(mass: float, way: np.ndarray, share: float) -> bool:
        contacts = np.tile(-share * CONTACT * way, (len(key.stance), 1))
        return off_by(kin, key, mass, FRICTION, share * COM * way, contacts)

    cases = [(m, way) for m in (1 - MASS, 1 + MASS) for way in ways]
    assert not all(held(m, way, 1.0) for m, way in cases)
    inside = 1.0 + left / (COM + CONTACT) - 0.02
    assert all(held(m, way, inside) for m, way in cases)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_mass_counts_where_torques_are_at_their_limits(demo_plan, share):
    """As the planner counts on them, and on weaker joints."""
    kin, key = Kinematics(demo_plan.world), demo_plan.keyframes[-1]
    points, load, torque = statics_at(kin, key.q, key.stance)

    def room(mass: float) -> float:
        limits = replace(
            torque, gravity=mass * torque.gravity, limits=share * torque.limits
        )
        return _core.com_room(*points.arrays, load.com, mass * load.mass, limits.arrays)

    light, heavy = room(0.9), room(1.1)
    assert heavy <= light + 1e-6
    if share < 1.0:
        assert heavy < light - 1e-3


def test_a_robust_plan_is_robust_all_along(demo_plan, robust_plan):
    kin = Kinematics(robust_plan.world)
    assert robust_plan.complete
    least = [robust_margin_along(kin, c.phases) for c in robust_plan.changes]
    assert min(least) >= 0.0
    usual = [robust_margin_along(kin, c.phases) for c in demo_plan.changes]
    assert min(usual) < 0.0
    assert robust_margin_along(kin, ()) is None


def test_a_change_that_is_not_robust_is_refused_with_its_margin(demo_plan, monkeypatch):
    monkeypatch.setattr("clamber.step.robust.COM", 0.1)
    steps, _ = split_steps(demo_plan.sequence, demo_plan.world)
    found = change_contact(
        IK(demo_plan.world), demo_plan.start, steps[0], KeyframeOptions(robust=True)
    )
    assert isinstance(found, Failure)
    assert "not robust: its worst margin is -" in str(found)
