"""Paths: arcs over the edge, pushed clear of everything, contacts in place."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from clamber import _core
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.planning.planner import plan
from clamber.recording.detect import detect_contacts
from clamber.recording.recording import load_demo
from clamber.step.ik import IK
from clamber.step.path import (
    bridge,
    check_phases,
    interpolate,
    overlap,
    plan_path,
)
from clamber.step.polygon import com_margin, support_polygon
from clamber.step.posture import CLEARANCE
from clamber.step.stability import statics_at
from clamber.step.transition import plan_shift, plan_transition
from oracles import contact_drift

SAFE_HEIGHT, TOP_RISE = 0.05, 0.05  # [m] h_safe of (4.29); of arcs on top


@pytest.fixture(scope="module")
def ik(demo_plan):
    return IK(demo_plan.world)


def halves(kin, nodes):
    """All postures of a phase and those half-way between."""
    yield nodes[0]
    for a, b in itertools.pairwise(nodes):
        yield interpolate(kin, a, b, 0.5)
        yield b


def apart(world, contacts) -> np.ndarray:
    """(P,) bool: pairs that are no surface on the support it is in contact with."""
    out = np.ones(len(world.pairs), bool)
    for c in contacts:
        mine = np.isin(world.pairs, world.surfaces[c.surface].geoms).any(axis=1)
        out &= ~(mine & (world.pairs == world.support_geom[c.support]).any(axis=1))
    return out


def limb_to_box(world, q, limb: str, box: str = "box") -> float:
    """Least distance of any link of a limb to a box, by MuJoCo alone [m]."""
    model, data = world.model, mujoco.MjData(world.model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    root = world.landmark(world.robot.limbs[limb].root)[0]

    def below(body: int) -> bool:
        while body and body != root:
            body = int(model.body_parentid[body])
        return body == root

    target, fromto = model.geom(box).id, np.zeros(6)
    return min(
        mujoco.mj_geomDistance(model, data, g, target, 1.0, fromto)
        for g in range(model.ngeom)
        if model.geom_contype[g] | model.geom_conaffinity[g]
        and below(int(model.geom_bodyid[g]))
    )


# Arcs (4.29).


def dense(p1, p2, top=0.0, on_top=False) -> np.ndarray:
    return _core.arc(np.array(p1), np.array(p2), top, on_top, 4001)


@pytest.mark.parametrize(
    ("p1", "p2", "top", "on_top", "apex"),
    [
        # Half the way above the middle.
        ([0.0, 0.0, 0.1], [0.6, 0.0, 0.3], 0.0, False, 0.2 + np.hypot(0.6, 0.2) / 2),
        # Clear of the obstacle, where that is higher.
        ([0.0, 0.0, 0.0], [0.1, 0.0, 0.4], 0.4, False, 0.4 + SAFE_HEIGHT),
        # Capped, where both ends are on top, which does not raise a short arc.
        ([0.3, 0.1, 0.4], [0.9, 0.1, 0.4], 0.4, False, 0.7),
        ([0.3, 0.1, 0.4], [0.9, 0.1, 0.4], 0.4, True, 0.4 + TOP_RISE + SAFE_HEIGHT),
        ([0.3, 0.1, 0.4], [0.34, 0.1, 0.4], 0.4, True, 0.4 + SAFE_HEIGHT),
        # Straight up there is no bulge.
        ([0.2, 0.1, 0.0], [0.2, 0.1, 0.5], 0.0, False, 0.5),
    ],
)
def test_the_apex_is_that_computed_by_hand(p1, p2, top, on_top, apex):
    assert dense(p1, p2, top, on_top)[:, 2].max() == pytest.approx(apex, abs=1e-5)


def test_an_arc_goes_straight_and_rises_once_to_the_apex_of_the_formula(rng):
    for p1, p2 in rng.uniform(-1, 1, (100, 2, 3)):
        top, on_top = rng.uniform(0, 1), bool(rng.integers(2))
        apex = max((p1 + p2)[2] / 2 + np.linalg.norm(p1 - p2) / 2, top + SAFE_HEIGHT)
        if on_top:
            apex = min(apex, max(p1[2], p2[2]) + TOP_RISE + SAFE_HEIGHT)
        points = dense(p1, p2, top, on_top)
        assert np.allclose(points[[0, -1]], [p1, p2])
        gone = (points - p1)[:, :2] @ (p2 - p1)[:2] / np.sum((p2 - p1)[:2] ** 2)
        assert np.allclose(points[:, :2], p1[:2] + np.outer(gone, (p2 - p1)[:2]))
        assert np.all(np.diff(gone) > 0)
        z = points[:, 2]
        k = int(np.argmax(z))
        assert z[k] == pytest.approx(apex, abs=1e-4)
        assert np.all(np.diff(z[: k + 1]) >= 0)
        assert np.all(np.diff(z[k:]) <= 0)


def test_an_arc_leaves_and_comes_down_upright():
    """So that a top of another height is met near where it should be."""
    points = dense([0.0, 0.0, 0.1], [0.6, 0.2, 0.3])
    for ends in (points[:40], points[-40:]):
        way = np.ptp(ends, axis=0)
        assert np.hypot(*way[:2]) < 0.05 * way[2]


@pytest.mark.parametrize(("asked", "given"), [(2, 5), (5, 5), (12, 12)])
def test_an_arc_has_at_least_five_control_points(asked, given):
    assert len(_core.arc(np.zeros(3), np.ones(3), 0.0, False, asked)) == given


# The paths of the demonstration.


def test_every_path_of_the_demonstration_is_solved(demo_paths):
    assert [p.status for p in demo_paths] == [Status.SOLVED] * 6


def test_end_points_are_the_postures_of_the_transition(demo_paths):
    for path in demo_paths:
        t, (shift, swing, settle) = path.transition, path.phases
        assert [p.kind for p in path.phases] == ["shift", "swing", "settle"]
        for a, b in (
            (shift.q[0], t.before),
            (shift.q[-1], t.shifted),
            (swing.q[0], t.shifted),
            (swing.q[-1], t.touching),
            (settle.q[0], t.touching),
            (settle.q[-1], t.after),
        ):
            assert np.array_equal(a, b)


def test_each_path_begins_where_the_last_one_ended(demo_plan):
    for a, b in itertools.pairwise(demo_plan.changes):
        assert np.array_equal(a.phases[-1].q[-1], b.phases[0].q[0])


def test_contacts_stay_in_place_at_and_between_all_postures(demo_plan, demo_kinematics):
    """They neither slide along nor leave nor enter their supports."""
    kin = demo_kinematics
    for path in demo_plan.changes:
        for phase in path.phases:
            for q in halves(kin, phase.q):
                kin.update(q)
                for c in phase.contacts:
                    assert contact_drift(kin, c) < 5e-3
                    support = kin.world.supports[c.support]
                    p = kin.contact_point(c.surface, support.normal, c.edge)
                    assert abs(support.height(p)) < 5e-3


def test_the_centre_of_mass_stays_over_the_contacts_that_bear_load(
    demo_plan, demo_kinematics
):
    for path in demo_plan.changes:
        for phase in path.phases:
            load = {c.surface: c for c in (*phase.load_before, *phase.load_after)}
            for q in phase.q:
                demo_kinematics.update(q)
                at, *_ = statics_at(demo_kinematics, q, tuple(load.values()))
                polygon = support_polygon(at.points[:, :2])
                assert com_margin(demo_kinematics.com, polygon) > 5e-3


def test_the_moving_surface_follows_its_arc(demo_plan, demo_kinematics):
    for path in demo_plan.changes:
        made, swing = path.step.makes, path.phases[1]
        normal = demo_kinematics.world.supports[made.support].normal
        way = []
        for q in swing.q:
            demo_kinematics.update(q)
            way.append(demo_kinematics.contact_point(made.surface, normal))
        off = [np.linalg.norm(swing.arc - p, axis=1).min() for p in way]
        assert np.median(off) < 0.05  # it cuts corners
        assert np.array(way)[:, 2].max() > 0.6 * SAFE_HEIGHT + made.position[2]


def test_the_centre_of_mass_does_not_turn_back_in_a_swing(demo_plan, demo_kinematics):
    """It goes straight: back and forth it would take twice the time."""
    for path in demo_plan.changes:
        com = []
        for q in path.phases[1].q:
            demo_kinematics.update(q)
            com.append(demo_kinematics.com[:2].copy())
        a, way = com[0], com[-1] - com[0]
        share = np.clip((com - a) @ way / (way @ way), 0, 1)
        assert np.linalg.norm(com - a - np.outer(share, way), axis=1).max() < 0.015


def test_a_foot_swings_onto_the_box_without_entering_it_and_turns_on_the_way():
    """Its toes point down at first: flat at once or at last, joints turn too far."""
    source = Path(__file__).parents[1] / "examples/recordings/climb-1-stand.yaml"
    made = plan(
        detect_contacts(load_demo(source)), load_robot("coman"), Scene.from_height(0.38)
    )
    kin = Kinematics(made.world)
    feet = [c for c in made.changes if c.step.makes and "Foot" in c.step.makes.surface]
    assert len(feet) >= 2
    for change in feet:
        c, swing = change.step.makes, change.phases[1].q
        limb, up = change.step.limb, np.array([0.0, 0.0, 1.0])
        body = made.world.surfaces[c.surface].body
        ways, turns = [], []
        for q in halves(kin, swing):
            kin.update(q)
            ways.append(np.linalg.norm(kin.contact_point(c.surface, up) - c.position))
            turns.append(kin.data.xmat[body].reshape(3, 3)[2, 0])
        assert all(
            limb_to_box(made.world, q, limb) > -2e-3
            for q, way in zip(halves(kin, swing), ways, strict=True)
            if way > 0.02
        )
        # Not in the first two of its steps.
        assert abs(turns[4] - turns[0]) < 0.3 * abs(turns[-1] - turns[0])


def test_no_link_enters_another_or_the_scene_on_any_path(demo_plan, demo_kinematics):
    """All pairs but those of closed contacts, by MuJoCo's distances."""
    world = demo_kinematics.world
    for path in demo_plan.changes:
        for phase in path.phases:
            # At its very ends the moving surface touches what it leaves and meets.
            closed = phase.contacts
            ends = (*closed, *path.leaving, path.step.makes)
            inner, outer = apart(world, closed), apart(world, ends)
            for i, q in enumerate(phase.q):
                demo_kinematics.update(q)
                is_end = i in (0, len(phase.q) - 1)
                near = demo_kinematics.proximity(0.0, outer if is_end else inner)
                assert near.distance.min(initial=0.0) > -4e-3


def test_gaps_are_halved_where_a_contact_drifts(demo_paths, ik):
    """Straight through the air from lift-off to touch-down the feet would slide."""
    t = demo_paths[-1].transition

    def drift(nodes: np.ndarray) -> float:
        worst = 0.0
        for q in halves(ik.kin, nodes):
            ik.kin.update(q)
            worst = max(worst, *(contact_drift(ik.kin, c) for c in t.held))
        return worst

    refined = bridge(ik, t.shifted, t.touching, t.held)
    assert drift(refined[[0, -1]]) > 5e-3
    assert drift(refined) < 2.5e-3
    assert np.array_equal(refined[[0, -1]], [t.shifted, t.touching])


# Collisions and how they are found.


def postures(path):
    return [p.q for p in path.phases]


def test_a_swing_straight_through_the_box_is_refused(demo_paths, ik):
    path = next(p for p in demo_paths if "LFoot" in p.transition.step.breaks)
    shift, swing, settle = postures(path)
    # The right shank, which has no business on the box, goes through its edge.
    sunk = swing.copy()
    sunk[3:-3, 0] += 0.25
    alone = replace(path.transition, held=())  # no contact is said to be open
    status, note = check_phases(ik, alone, (shift, sunk, settle))
    assert status is Status.COLLIDING
    assert "box" in note
    assert "(swing)" in note


def test_an_open_contact_is_refused(demo_paths, ik):
    path = demo_paths[2]
    lifted, *rest = postures(path)
    lifted = lifted.copy()
    lifted[:, 2] += 0.03
    status, note = check_phases(ik, path.transition, (lifted, *rest))
    assert status is Status.UNREACHABLE
    assert note == "a contact opens by 30 mm (shift)"


def test_a_swing_that_weak_joints_do_not_hold_is_refused(demo_paths, ik):
    """What the contacts that stay ask of the joints half-way, not at the ends alone."""
    path = demo_paths[-1]
    t, (shift, swing, settle) = path.transition, postures(path)
    assert check_phases(ik, t, (shift, swing, settle))[0] is Status.SOLVED
    weak = IK(replace(ik.world, tau_max=0.1 * ik.world.tau_max))
    status, note = check_phases(weak, t, (shift, swing, settle))
    assert status is Status.OVERLOADED
    assert "N m" in note
    assert check_phases(weak, t, (shift, swing[-1:], settle))[0] is Status.SOLVED


def test_overlap_is_the_depth_that_mujoco_measures(demo_plan, ik):
    world, q = demo_plan.world, demo_plan.keyframes[0].q.copy()
    q[0] += 0.08  # legs a little into the box
    depth, pair = overlap(ik, q, np.ones(len(world.pairs), bool))
    data, fromto = mujoco.MjData(world.model), np.zeros(6)
    data.qpos[:] = q
    mujoco.mj_kinematics(world.model, data)
    deepest = min(
        mujoco.mj_geomDistance(world.model, data, int(a), int(b), 0.1, fromto)
        for a, b in world.pairs
    )
    assert depth == pytest.approx(-deepest, abs=1e-6)
    a, b = world.pairs[pair]
    assert "box" in {world.model.geom(int(a)).name, world.model.geom(int(b)).name}


def test_standing_upright_nothing_overlaps(demo_plan, ik):
    key = demo_plan.keyframes[0]
    watched = apart(demo_plan.world, key.stance)
    assert overlap(ik, key.q, watched) == (0.0, -1)


def test_arcs_that_are_not_adapted_come_too_near_the_box_and_adapted_ones_do_not(
    demo_sequence, coman
):
    """Figure 4.16: the knees on their way up a high box."""
    result = plan(demo_sequence, coman, Scene.from_height(0.56))
    knees = [k for k, c in enumerate(result.changes) if "leg" in c.step.limb]
    assert len(knees) == 2
    ik = IK(result.world)
    entered = []
    for k in knees:
        path = result.changes[k]
        limb, made = path.step.limb, path.step.makes
        keys = result.keyframes[k : k + 2]
        held = path.phases[1].contacts
        shift = plan_shift(ik, keys[0], path.step, held, margin=path.margin)
        t = plan_transition(ik, shift, keys[1], path.step)
        plain = plan_path(ik, t, adapt=False).phases[1].q
        entered.append(min(limb_to_box(result.world, q, limb) for q in plain[1:-1]))
        for q in path.phases[1].q:
            distance = limb_to_box(result.world, q, limb)
            assert distance > -1e-3
            ik.kin.update(q)
            knee = ik.kin.contact_point(made.surface, np.array([0.0, 0.0, 1.0]))
            if np.linalg.norm(knee - made.position) > 0.02:  # not yet touching down
                assert distance > CLEARANCE - 1e-3
    assert min(entered) < 0.5 * CLEARANCE  # the right knee


def test_where_little_moves_a_bridge_has_no_postures_between(demo_paths, ik):
    t = demo_paths[0].transition
    small = np.zeros(ik.world.model.nv)
    small[ik.world.dadr[0]] = 0.01
    near = ik.kin.integrate(t.before, small)
    assert len(bridge(ik, t.before, near, t.held)) == 2
    far = max(p.phases[0].q.shape[0] for p in demo_paths)
    assert far > 2


def test_the_repr_of_what_a_change_is_made_of_is_short(demo_plan, demo_paths):
    change, key = demo_plan.changes[-1], demo_plan.keyframes[-1]
    for record in (
        change,
        change.step,
        change.step.makes,
        change.phases[0],
        key,
        key.contacts[0],
        demo_plan.equilibria[-1],
        demo_paths[-1],
        demo_paths[-1].transition,
    ):
        assert len(repr(record)) < 300, record
