"""Moving one contact: weight shifted first, the new contact closed before it bears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber import _core
from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.se3 import matrix_from_rpy
from clamber.step import change
from clamber.step.change import change_contact
from clamber.step.ik import IK
from clamber.step.path import Path
from clamber.step.polygon import com_margin, support_ellipse, support_polygon
from clamber.step.posture import KeyframeOptions
from clamber.step.stability import LEAST_ROOM, equilibrium_at, is_stable, statics_at
from clamber.step.transition import (
    MARGINS,
    approach_contact,
    balance_problem,
    plan_shift,
    plan_transition,
    rolled,
)
from oracles import contact_drift

UP = np.array([0.0, 0.0, 1.0])
AHEAD = np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def transitions(demo_paths):
    return [p.transition for p in demo_paths]


@pytest.fixture(scope="module")
def ik(demo_plan):
    return IK(demo_plan.world)


def polygon_of(kin, contacts) -> np.ndarray:
    """Support polygon of contacts at the present posture."""
    return support_polygon(statics_at(kin, kin.q, contacts)[0].points[:, :2])


def shifted(ik, before, step):
    """The weight on the contacts that stay, by the least of `MARGINS`."""
    held = tuple(c for c in before.stance if c.surface not in step.breaks)
    return plan_shift(ik, before, step, held, margin=MARGINS[-1])


# The orientation of reach-to-support (4.26, 4.27).

REACH_ANGLE = np.radians(25.0)
lean_direction = _core.lean_direction


def test_a_contact_that_does_not_move_asks_for_no_turn():
    p = np.array([0.3, 0.1, 0.2])
    assert np.allclose(lean_direction(p, p, np.eye(3)), UP)


def test_the_lean_points_to_where_the_contact_comes_from_by_at_most_phi(rng):
    level = lean_direction(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.eye(3))
    assert np.arccos(level[2]) == pytest.approx(REACH_ANGLE)
    Q = matrix_from_rpy([0, 0, 1.1])
    for p1, p2, rpy in rng.uniform(-1, 1, (200, 3, 3)):
        R, back = matrix_from_rpy(rpy), (p1 - p2)[:2]
        lean = lean_direction(p1, p2, R)
        # Two angles whose sines are added: half a degree more on the diagonal.
        assert np.arccos(lean[2]) < REACH_ANGLE + np.radians(0.5)
        assert np.allclose(lean_direction(Q @ p1, Q @ p2, Q @ R), Q @ lean)
        lean = lean_direction(p1, p2, matrix_from_rpy([0, 0, 3.0 * rpy[2]]))
        assert np.linalg.norm(lean) == pytest.approx(1.0)
        # sin(phi x) and sin(phi y) against x and y: parallel but for curvature
        cosine = lean[:2] @ back / np.linalg.norm(lean[:2]) / np.linalg.norm(back)
        assert cosine > 0.999


# The postures of every move of the demonstration.


def test_every_move_of_the_demonstration_has_solved_transitions(transitions):
    assert [t.status for t in transitions] == [Status.SOLVED] * 6


@pytest.mark.parametrize("posture", ["shifted", "touching"])
def test_the_centre_of_mass_is_inside_the_polygon_of_the_contacts_that_stay(
    transitions, demo_kinematics, posture
):
    for t in transitions:
        demo_kinematics.update(getattr(t, posture))
        margin = com_margin(demo_kinematics.com, polygon_of(demo_kinematics, t.held))
        assert t.margin in MARGINS
        assert margin >= t.margin - 2e-3


@pytest.mark.parametrize("posture", ["shifted", "touching"])
def test_forces_on_the_contacts_that_stay_hold_the_robot_alone(
    transitions, demo_kinematics, posture
):
    for t in transitions:
        assert equilibrium_at(demo_kinematics, getattr(t, posture), t.held).feasible


def test_before_the_shift_some_move_could_not_do_without_its_contact(
    transitions, demo_kinematics
):
    """Else shifting the weight would prove nothing."""
    margins = []
    for t in transitions:
        demo_kinematics.update(t.before)
        polygon = polygon_of(demo_kinematics, t.held)
        margins.append(com_margin(demo_kinematics.com, polygon))
    assert min(margins) < 0.0


def test_while_the_weight_shifts_all_old_contacts_stay_closed(
    transitions, demo_kinematics
):
    for t in transitions:
        demo_kinematics.update(t.shifted)
        for c in (*t.held, *t.rolling):
            assert contact_drift(demo_kinematics, c) < 1e-3


def test_the_new_contact_touches_while_those_that_stay_are_closed(
    transitions, demo_kinematics
):
    for t in transitions:
        demo_kinematics.update(t.touching)
        for c in (*t.held, t.step.makes):
            assert contact_drift(demo_kinematics, c) < 1e-3
            support = demo_kinematics.world.supports[c.support]
            points = demo_kinematics.bearing_points(c.surface, support.normal, c.edge)
            assert np.abs(support.height(points)).max() < 1e-3
            assert support.inside(points).all()


def test_transitions_lead_from_keyframe_to_keyframe(demo_plan, transitions):
    for t, a, b in zip(
        transitions, demo_plan.keyframes, demo_plan.keyframes[1:], strict=False
    ):
        assert np.array_equal(t.before, a.q)
        assert np.array_equal(t.after, b.q)
        names = {c.surface for c in t.held}
        assert names | {t.step.makes.surface} == {c.surface for c in b.stance}
        assert names | {c.surface for c in t.leaving} == {c.surface for c in a.stance}


def test_a_worse_posture_is_named(demo_plan, ik):
    """A contact out of reach: the transition says so instead of pretending."""
    before, after = demo_plan.keyframes[1:3]
    move = demo_plan.changes[1].step
    far = replace(move.makes, position=move.makes.position + 0.6 * AHEAD)
    states = tuple(
        replace(s, contact=far) if s.contact.surface == far.surface else s
        for s in after.contacts
    )
    shift = shifted(ik, before, move)
    t = plan_transition(ik, shift, replace(after, contacts=states), move)
    assert t.status is Status.UNREACHABLE
    assert t.residuals.contact > 0.01


# Feet that are about to leave.


def test_a_foot_rolls_onto_the_edge_that_lies_towards_the_others(ik, demo_plan):
    """Toes or heel, and no farther once it is there."""
    q, foot = demo_plan.keyframes[0].q, demo_plan.keyframes[0].stance[0]
    ik.kin.update(q)
    corners = ik.kin.bearing_points(foot.surface, UP)
    for ahead, end in ((0.4, corners[:, 0].max()), (-0.4, corners[:, 0].min())):
        tipped = rolled(ik, q, foot, foot.position + ahead * AHEAD)
        edge = ik.world.edges[foot.surface][tipped.edge]
        ends = ik.kin.point(edge.body, edge.corners)
        assert np.allclose(ends[:, 0], end, atol=1e-6)
        assert np.allclose(tipped.position, ends.mean(axis=0))
        assert rolled(ik, q, tipped, foot.position - ahead * AHEAD) is tipped


def test_joints_too_weak_for_a_shift_are_named(demo_plan, ik):
    """The same postures, but motors that cannot hold them."""
    before, after = demo_plan.keyframes[4:6]
    move = demo_plan.changes[4].step
    weak = IK(replace(ik.world, tau_max=0.05 * ik.world.tau_max))
    strong, feeble = (
        plan_transition(x, shifted(x, before, move), after, move) for x in (ik, weak)
    )
    assert strong.status is Status.SOLVED
    assert feeble.status is Status.OVERLOADED
    assert np.array_equal(strong.shifted, feeble.shifted)


def test_the_weight_is_shifted_once_wherever_the_contact_goes(
    demo_plan, ik, monkeypatch
):
    """Where it cannot be, no place is looked for."""
    before, after = demo_plan.keyframes[4:6]
    asked, places = [], []

    def counted_shift(ik, before, step, held, *, margin):
        asked.append((held, margin))
        return plan_shift(ik, before, step, held, margin=margin)

    def found_place(*args, **_):
        places.append(args)
        return after

    def no_path(ik, transition):
        phases = demo_plan.changes[4].phases
        return Path(transition=transition, phases=phases, status=Status.COLLIDING)

    monkeypatch.setattr(change, "plan_shift", counted_shift)
    monkeypatch.setattr(change, "direct", found_place)
    monkeypatch.setitem(change.METHODS, "direct", found_place)
    monkeypatch.setattr(change, "plan_path", no_path)
    strong, weak = ik, IK(replace(ik.world, tau_max=0.05 * ik.world.tau_max))
    step, options = demo_plan.changes[4].step, KeyframeOptions()
    for x, of_each in ((strong, 2), (weak, 0)):
        asked.clear()
        places.clear()
        found = change_contact(x, before, step, options)
        expected = Status.COLLIDING if x is strong else Status.OVERLOADED
        assert found.status is expected
        assert len(set(asked)) == len(asked)
        footings = {held for held, _ in asked}
        assert len(asked) == len(footings) * len(MARGINS)
        assert len(places) == len(footings) * of_each


@pytest.mark.parametrize(
    ("k", "joint", "share"), [(3, "WaistYaw", 0.06), (5, "RShSag", 0.29)]
)
def test_the_centre_of_mass_keeps_its_margin_from_what_a_weak_joint_bears(
    demo_plan, ik, k, joint, share
):
    """The joint holds the usual posture, not one whose CoM is as far aside."""
    before, move = demo_plan.keyframes[k], demo_plan.changes[k].step
    held = tuple(c for c in before.stance if c.surface not in move.breaks)
    tau_max = ik.world.tau_max.copy()
    tau_max[ik.world.joints.index(joint)] *= share
    weak = IK(replace(ik.world, tau_max=tau_max))
    usual, found = (
        plan_shift(x, before, move, held, margin=MARGINS[0]) for x in (ik, weak)
    )

    def room(q):
        weak.kin.update(q)
        points, load, torque = statics_at(weak.kin, q, held)
        return _core.com_room(*points.arrays, load.com, load.mass, torque.arrays)

    assert 0.005 < room(usual.solution.q) < 0.030
    assert found.status is Status.SOLVED
    assert room(found.solution.q) > MARGINS[0] - 0.002
    assert found.solution.residuals.com_margin > MARGINS[0] - 0.002


def test_a_round_surface_does_not_roll_onto_an_edge(ik, demo_plan):
    last = demo_plan.keyframes[-1]
    elbow = last.stance[0]
    assert ik.world.surfaces[elbow.surface].rotation is None
    assert rolled(ik, last.q, elbow, elbow.position + AHEAD) is elbow


def test_no_corner_of_a_rolling_foot_enters_the_ground_and_toes_stay(
    transitions, demo_kinematics
):
    lifted = []
    for t in transitions:
        for c in t.rolling:
            if c.edge is None:
                continue
            demo_kinematics.update(t.shifted)
            heights = demo_kinematics.bearing_points(c.surface, UP)[:, 2]
            toes = demo_kinematics.bearing_points(c.surface, UP, c.edge)[:, 2]
            assert heights.min() > -2e-3
            assert np.abs(toes).max() < 1e-3
            lifted.append(heights.max())
    assert max(lifted) > 0.005  # the last foot needs it: its heel comes off


# The ellipse (4.28).


def test_the_ellipse_task_pulls_the_centre_of_mass_into_the_ellipse(ik, transitions):
    t = transitions[-1]  # off the last foot: the polygon alone stops at its border

    def excess(**weight: float) -> float:
        problem = balance_problem(
            ik.world, held=t.held, unloaded=t.rolling, q_reference=t.before
        )
        problem = replace(problem, com_weight=0.0, balance_margin=0.0, **weight)
        solution = ik.solve_hard(problem, t.before)
        assert solution.status is Status.SOLVED
        ik.kin.update(solution.q)
        return support_ellipse(polygon_of(ik.kin, t.held)).excess(ik.kin.com)[0]

    without, usual = excess(ellipse_weight=0.0), excess()
    strong = excess(ellipse_weight=20.0)
    assert without > 1e-3
    assert strong < 0.5 * without
    assert usual < without + 1e-4  # against the other tasks it hardly counts
    assert strong < 0.3 * without


# Contacts that give way.


def test_a_contact_out_of_reach_is_approached_as_near_as_it_goes(ik, demo_plan):
    feet = demo_plan.keyframes[0]
    wanted = Contact(
        surface="LHand",
        support="box",
        position=np.array([0.8, 0.1, 0.275]),
        quaternion=np.array([1.0, 0, 0, 0]),
    )
    near, solution = approach_contact(ik, feet.stance, wanted, demo_plan.keyframes[1].q)
    assert solution.status is Status.SOLVED
    ik.kin.update(solution.q)
    assert np.allclose(ik.kin.contact_point("LHand", UP), near.position, atol=1e-3)
    assert near.position[2] == pytest.approx(0.275, abs=1e-9)
    assert near.position[0] > 0.45  # at arm's length, not given up
    assert near.position[0] < 0.75


def test_a_contact_within_reach_is_approached_exactly(ik, demo_plan):
    before, after = demo_plan.keyframes[1:3]
    wanted = next(c for c in after.stance if c.surface == "RHand")
    near, solution = approach_contact(ik, before.stance, wanted, after.q)
    assert solution.status is Status.SOLVED
    assert np.linalg.norm(near.position - wanted.position) < 5e-3


def test_a_posture_that_holds_without_room_is_no_shift(demo_plan, ik):
    """Joints bear it as it stands, and not with its CoM 2 cm elsewhere."""
    before, move = demo_plan.keyframes[4], demo_plan.changes[4].step
    statuses = []
    for share in np.linspace(0.6, 0.1, 51):
        weak = IK(replace(ik.world, tau_max=share * ik.world.tau_max))
        found = shifted(weak, before, move)
        q, held = found.solution.q, found.held
        weak.kin.update(q)
        points, load, torque = statics_at(weak.kin, q, held)
        room = _core.com_room(*points.arrays, load.com, load.mass, torque.arrays)
        assert (found.status is Status.SOLVED) == (room >= LEAST_ROOM - 1e-6)
        if room < LEAST_ROOM - 1e-6 and is_stable(weak.kin, q, held):
            assert "20 mm to spare" in found.note
            statuses.append(found.status)
    assert set(statuses) == {Status.OVERLOADED}
