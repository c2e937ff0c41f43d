"""From a stance as it was felt: the posture, the way on, and feeling for a contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clamber.contact.steps import split_moves
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.se3 import matrix_from_rpy
from clamber.model.world import World, build_world
from clamber.planning import adaptation
from clamber.planning.adaptation import (
    FEELING_SPEED,
    FOLLOWED,
    REACH,
    adapt_plan,
    feeling,
    from_here,
    go_on,
    start_again,
)
from clamber.planning.records import State
from clamber.planning.trajectory import HOLD_START, RATE, holding_torque
from clamber.step.change import Failure
from clamber.step.ik import IK
from clamber.step.stability import contact_drift, contact_points
from clamber.step.statics import com_margin, support_polygon

STEPS = range(6)
OFFSETS = [(0.0, 0.0, 0.02), (0.0, 0.0, -0.03), (0.012, -0.01, 0.015)]


def made_at(plan, step):
    """The contact that a step makes, those that bear meanwhile, and the touch."""
    after = plan.keyframes[step + 1].stance
    before = {c.surface for c in plan.keyframes[step].stance}
    made = next(c for c in after if c.surface not in before)
    held = tuple(c for c in after if c is not made)
    return made, held, plan.changes[step].touching


def depths(world: World, t, contact, normal, every: int = 20) -> np.ndarray:
    """(n, 2) how far the surface is below its contact, and to the side [m]."""
    kin, out = Kinematics(world), []
    for q in t.q[::every]:
        kin.update(q)
        off = kin.contact_point(contact.surface, normal) - contact.position
        up = float(off @ normal)
        out.append((-up, np.linalg.norm(off - up * normal)))
    return np.array(out)


def moved_world(world: World, offset) -> World:
    box = world.scene.boxes[0]
    box = replace(box, position=box.position + np.array(offset))
    return build_world(world.robot, replace(world.scene, boxes=(box,)))


def as_felt(contacts, offset, on="box"):
    """Contacts on a box that is elsewhere."""
    offset = np.array(offset)
    return tuple(
        replace(c, position=c.position + offset) if c.support == on else c
        for c in contacts
    )


def midway(done, stance, q, loaded=None) -> State:
    loaded = stance if loaded is None else loaded
    return State(done=done, stance=tuple(stance), loaded=tuple(loaded), q=q)


def described(contacts) -> list[str]:
    return [f"{c.surface}@{c.support}" for c in contacts]


def cut(plan, missed: str, n: int):
    """The first `n` changes, and why there are no more, if anything is missed."""
    failures = (Failure(status=Status.STUCK, detail=missed),) if missed else ()
    return replace(plan, changes=plan.changes[:n], failures=failures)


# Feeling for a contact.


@pytest.mark.parametrize("step", STEPS)
def test_feeling_goes_straight_down_the_normal_and_ends_within_reach(demo_plan, step):
    made, held, q = made_at(demo_plan, step)
    t = feeling(demo_plan.world, held, made, q)
    down, side = depths(demo_plan.world, t, made, np.array([0.0, 0.0, 1.0])).T
    assert abs(down[0]) < 1e-3
    assert np.all(np.diff(down) > -1e-4)
    assert down[-1] == pytest.approx(REACH, abs=FOLLOWED)
    assert down.max() < REACH + 1e-3
    # The last posture of a swing may lie beside the contact, which has rolled.
    assert np.abs(side - side[0]).max() < 2e-3


def test_a_limb_that_was_set_off_its_place_feels_under_itself(demo_plan):
    """It does not wander to where it was planned: it would slip off what it touches."""
    made, held, q = made_at(demo_plan, STEPS[-1])
    for aside in (-0.05, 0.05):
        other = replace(made, position=made.position + np.array([0.0, aside, 0.0]))
        t = feeling(demo_plan.world, held, other, q)
        down, side = depths(demo_plan.world, t, made, np.array([0.0, 0.0, 1.0])).T
        assert down[-1] > 0.5 * REACH
        assert np.abs(side - side[0]).max() < 2e-3


@pytest.mark.parametrize("step", STEPS)
def test_feeling_keeps_held_contacts_and_balance(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t, kin = feeling(world, held, made, q), Kinematics(world)
    for x in t.q[::40]:
        kin.update(x)
        assert max(contact_drift(kin, c) for c in held) < 5e-4
        polygon = support_polygon(contact_points(kin, held).points[:, :2])
        assert com_margin(kin.com[:2], polygon) > 0.005
        # Between postures at a limit the spline may pass it by a fifth of a degree.
        assert np.all(x[world.qadr] >= world.q_min[world.dadr] - 3.5e-3)
        assert np.all(x[world.qadr] <= world.q_max[world.dadr] + 3.5e-3)


@pytest.mark.parametrize("step", STEPS)
def test_feeling_is_slow_and_begins_and_ends_at_rest(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t = feeling(world, held, made, q)
    down = depths(world, t, made, np.array([0.0, 0.0, 1.0]))[:, 0]
    assert np.abs(np.diff(down)).max() * RATE / 20 < 1.2 * FEELING_SPEED
    assert np.median(np.diff(down)) * RATE / 20 > 0.4 * FEELING_SPEED
    assert np.allclose(t.q[0], q, atol=1e-5)
    assert np.abs(t.v[0]).max() < 1e-4
    assert np.abs(t.v[-1]).max() < 1e-4
    assert np.array_equal(t.time, np.arange(len(t.time)) / RATE)
    # Nothing is held before or after: it is felt for at once.
    assert np.abs(t.v[100]).max() > 1e-3
    assert np.abs(t.v[-100]).max() > 1e-3


@pytest.mark.parametrize("step", STEPS)
def test_meanwhile_only_what_is_held_is_closed_and_bears(demo_plan, step):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, step)
    t = feeling(world, held, made, q)
    closed = {s for s, c in zip(t.surfaces, t.contact.T, strict=True) if c.any()}
    assert closed == {c.surface for c in held}
    assert t.contact[:, [t.surfaces.index(c.surface) for c in held]].all()
    tau = holding_torque(Kinematics(world), t.q[0], held)
    assert np.allclose(t.tau[0], tau, atol=0.02 * np.abs(tau).max())


def test_on_a_slope_it_goes_along_that_normal(demo_plan):
    world = demo_plan.world
    made, held, q = made_at(demo_plan, 0)
    box = replace(world.scene.boxes[0], rotation=matrix_from_rpy((0.0, -0.25, 0.0)))
    tilted = build_world(world.robot, replace(world.scene, boxes=(box,)))
    n = tilted.supports["box"].normal
    kin = Kinematics(tilted)
    kin.update(q)
    contact = replace(made, position=kin.contact_point(made.surface, n))
    t = feeling(tilted, held, contact, q)
    down, side = depths(tilted, t, contact, n).T
    assert n[0] == pytest.approx(-np.sin(0.25))
    assert down[-1] > 0.05
    assert side.max() < 0.01


def test_the_box_that_is_believed_there_is_no_obstacle_to_feeling(demo_plan):
    """The surface goes deep into where the top was planned."""
    made, held, q = made_at(demo_plan, 0)
    t, kin = feeling(demo_plan.world, held, made, q), Kinematics(demo_plan.world)
    kin.update(t.q[-1])
    top = demo_plan.world.supports["box"]
    p = kin.contact_point(made.surface, top.normal)
    assert top.inside(p)
    assert top.height(p) < -0.1


def test_what_cannot_be_reached_is_not_felt_for(demo_plan):
    world = demo_plan.world
    made, held, _ = made_at(demo_plan, 0)
    down = replace(made, position=made.position - [0.0, 0.0, 1.5])
    assert feeling(world, held, down, world.home) is None


def test_feeling_leaves_the_world_and_its_start_as_they_were(demo_plan):
    made, held, q = made_at(demo_plan, 2)
    before, top = q.copy(), demo_plan.world.supports["box"].position.copy()
    a = feeling(demo_plan.world, held, made, q)
    b = feeling(demo_plan.world, held, made, q)
    assert np.array_equal(q, before)
    assert np.array_equal(demo_plan.world.supports["box"].position, top)
    assert np.array_equal(a.q, b.q)
    assert np.array_equal(a.tau, b.tau)


# The rest of a plan from a stance as it was felt.


@pytest.fixture(scope="module", params=OFFSETS, ids=str)
def felt(request, fast_plan):
    """Both hands on a box that is elsewhere: the offset, contacts, what was found."""
    offset = request.param
    scene = moved_world(fast_plan.world, offset).scene
    key = fast_plan.keyframes[2]
    contacts = as_felt(key.stance, offset)
    found = adapt_plan(fast_plan, scene, midway(2, contacts, key.q), key.q)
    return scene, contacts, found


def test_the_first_keyframe_has_the_contacts_that_were_felt(felt):
    _, contacts, found = felt
    key, kin = found.keyframes[0], Kinematics(found.world)
    assert key.status is Status.SOLVED
    assert described(key.stance) == described(contacts)
    for c, there in zip(contacts, key.stance, strict=True):
        assert np.array_equal(c.position, there.position)
    kin.update(key.q)
    assert max(contact_drift(kin, c) for c in contacts) < 1e-3


def test_all_steps_that_are_left_are_planned_to_the_last_stance(fast_plan, felt):
    _, _, found = felt
    assert found.complete
    assert len(found.keyframes) == len(fast_plan.keyframes) - 2
    last, planned = found.keyframes[-1].stance, fast_plan.keyframes[-1].stance
    assert sorted(described(last)) == sorted(described(planned))


def test_every_later_contact_lies_on_the_top_as_it_is_believed(felt):
    scene, _, found = felt
    kin, top = Kinematics(found.world), scene.boxes[0].top
    assert np.allclose(found.world.supports["box"].position, top.position)
    for key in found.keyframes:
        assert key.status is Status.SOLVED
        kin.update(key.q)
        for c in key.stance:
            if c.support == "box":
                assert abs(top.height(c.position)) < 1e-3
                assert top.inside(c.position)
            assert contact_drift(kin, c) < 1e-3


def test_the_new_trajectory_passes_through_the_new_keyframes(felt):
    _, _, found = felt
    t, kin = found.trajectory, Kinematics(found.world)
    ends = [t.at(x) for x in t.keyframes]
    assert ends[0] > 0  # there is a way to the first one
    assert ends == sorted(set(ends))
    for k, key in zip(ends, found.keyframes, strict=True):
        assert np.abs(kin.difference(t.q[k], key.q)).max() < 1e-6
        closed = {s for s, c in zip(t.surfaces, t.contact[k], strict=True) if c}
        assert {c.surface for c in key.stance} <= closed


def test_it_goes_on_from_what_is_commanded_and_from_the_base_as_measured(fast_plan):
    """Joints begin where the servos are, so that nothing jumps."""
    world, key = fast_plan.world, fast_plan.keyframes[2]
    commanded = key.q.copy()
    commanded[world.qadr] += 0.004 * np.cos(np.arange(len(world.qadr)))
    commanded[:3] += 0.5  # of no use: the base is what was measured
    now = midway(2, key.stance, key.q)
    found = adapt_plan(fast_plan, world.scene, now, commanded)
    t = found.trajectory
    assert np.allclose(t.q[0, world.qadr], commanded[world.qadr], atol=1e-12)
    assert np.abs(t.q[0, :3] - key.q[:3]).max() < 0.01
    hold = round(HOLD_START * RATE)
    assert np.all(t.q[:hold] == t.q[0])
    assert not t.v[:hold].any()


def test_a_contact_that_does_not_bear_yet_is_loaded_little_by_little(demo_plan):
    world, key = demo_plan.world, demo_plan.keyframes[2]
    loaded = tuple(c for c in key.stance if c.surface != "RHand")
    found = adapt_plan(
        demo_plan, world.scene, midway(2, key.stance, key.q, loaded), key.q
    )
    kin, t = Kinematics(found.world), found.trajectory
    tau = holding_torque(kin, t.q[0], loaded)
    assert np.allclose(t.tau[0], tau, atol=1e-6)
    there = [np.abs(kin.difference(q, found.keyframes[0].q)).max() for q in t.q[:9000]]
    settled = int(np.argmax(np.array(there) < 1e-9))
    assert settled > 500
    tau = holding_torque(kin, found.keyframes[0].q, key.stance)
    assert np.allclose(t.tau[settled], tau, atol=1e-4)
    assert np.abs(tau - holding_torque(kin, found.keyframes[0].q, loaded)).max() > 0.1
    assert np.abs(np.diff(t.tau[: settled + 1], axis=0)).max() < 0.2  # no jump
    # The contact is closed all the while.
    assert t.contact[: settled + 1, t.surfaces.index("RHand")].all()


def test_with_no_steps_left_there_is_still_the_way_to_a_good_posture(fast_plan):
    key = fast_plan.keyframes[-1]
    offset = (0.0, 0.0, 0.01)
    scene = moved_world(fast_plan.world, offset).scene
    contacts = as_felt(key.stance, offset)
    found = adapt_plan(fast_plan, scene, midway(6, contacts, key.q), key.q)
    assert found.complete
    assert described(found.keyframes[0].stance) == described(contacts)
    assert len(found.keyframes) == 1
    kin = Kinematics(found.world)
    end = kin.difference(found.trajectory.q[-1], found.keyframes[0].q)
    assert np.abs(end).max() < 1e-6


def test_a_stance_that_cannot_be_is_said_to_be_none(fast_plan):
    key = fast_plan.keyframes[0]
    far = as_felt(key.stance[:1], (0.0, 3.0, 0.0), on="ground")
    contacts = (*far, key.stance[1])
    found = adapt_plan(
        fast_plan, fast_plan.world.scene, midway(0, contacts, key.q), key.q
    )
    assert found.trajectory is None
    assert str(found.failures[0]).startswith("no stable posture here: ")
    assert found.start.status is found.failures[0].status


def test_a_step_that_has_no_way_is_named(fast_plan, monkeypatch):
    """The box has moved away: the rest of the climb is out of reach."""
    monkeypatch.setattr("clamber.planning.planner.VARIATIONS", ({},))
    key = fast_plan.keyframes[0]
    scene = moved_world(fast_plan.world, (3.0, 0.0, 0.0)).scene
    found = adapt_plan(fast_plan, scene, midway(0, key.stance, key.q), key.q)
    assert str(found.failures[0]).startswith("air -> LHand on box: ")
    assert len(found.keyframes) < len(fast_plan.keyframes)


def test_a_support_that_is_believed_gone_is_the_reason(fast_plan):
    key = fast_plan.keyframes[0]
    scene = replace(fast_plan.world.scene, boxes=())
    found = adapt_plan(fast_plan, scene, midway(0, key.stance, key.q), key.q)
    assert found.trajectory is None
    assert len(found.keyframes) == 1
    assert "box" in str(found.failures[0])


def test_where_there_is_no_way_at_the_distance_of_what_is_rough_it_is_not_kept(
    fast_plan, monkeypatch
):
    world, asked = fast_plan.world, []

    answers = {}

    def stub(plan, scene, *rest):
        asked.append(scene.boxes[0].roughness)
        return answers[scene.boxes[0].roughness > 0]

    monkeypatch.setattr(adaptation, "_adapt", stub)
    box = world.scene.boxes[0]
    rough = replace(world.scene, boxes=(replace(box, roughness=0.03),))
    arguments = (midway(0, (), world.home), world.home)

    def found(missed, n):
        return cut(fast_plan, missed, n)

    answers = {True: found("", 6), False: found("no", 6)}
    assert adapt_plan(fast_plan, rough, *arguments) is answers[True]
    assert asked == [0.03]
    answers = {True: found("no", 1), False: found("", 6)}
    assert adapt_plan(fast_plan, rough, *arguments) is answers[False]
    assert asked == [0.03, 0.03, 0.0]
    # Neither goes all the way: the one that goes farther, else the careful one.
    answers = {True: found("no", 1), False: found("not", 2)}
    assert adapt_plan(fast_plan, rough, *arguments) is answers[False]
    answers = {True: found("no", 2), False: found("not", 2)}
    assert adapt_plan(fast_plan, rough, *arguments) is answers[True]
    # A smooth scene is not asked about twice.
    asked.clear()
    answers = {False: found("no", 1)}
    assert adapt_plan(fast_plan, world.scene, *arguments) is answers[False]
    assert asked == [0.0]


def test_a_policy_goes_on_with_what_leans_kept_farther_off_where_that_can_be(
    fast_plan, monkeypatch
):
    world, keys, asked = fast_plan.world, fast_plan.keyframes, []

    def found(missed, n):
        return cut(fast_plan, missed, n)

    pair = next(set(p) for p in world.pairs if world.support_geom["box"] in p)
    (leaning,) = pair - {world.support_geom["box"]}
    wary = {(int(leaning), "box"): 0.03}

    def stub(plan, ik, key):
        asked.append(bool(ik.extra))
        return answers[asked[-1]]

    monkeypatch.setattr(adaptation, "_rest", stub)
    answers = {True: found("", 6), False: found("", 6)}
    assert go_on(fast_plan, world, keys[-1], wary) is answers[True]
    assert asked == [True]
    answers = {True: found("no", 1), False: found("", 6)}
    assert go_on(fast_plan, world, keys[-1], wary) is answers[False]
    assert asked == [True, True, False]
    answers = {True: found("no", 1), False: found("no", 1)}
    assert go_on(fast_plan, world, keys[-1], wary) is answers[True]
    # Where nothing leans nothing is asked about twice.
    asked.clear()
    assert go_on(fast_plan, world, keys[-1]) is answers[False]
    assert asked == [False]


# The whole plan anew.


def test_from_another_start_the_whole_plan_is_made_anew(fast_plan):
    scene = fast_plan.world.scene
    start = scene.start + np.array([0.02, -0.03, 0.05])
    found = start_again(fast_plan, replace(scene, start=start))
    assert found.complete
    assert len(found.keyframes) == len(fast_plan.keyframes)
    home = build_world(fast_plan.world.robot, replace(scene, start=start)).home
    assert np.array_equal(found.keyframes[0].q, home)
    assert np.allclose(found.trajectory.q[0], home, atol=1e-9)
    feet = [c.position for c in found.keyframes[0].stance]
    assert np.allclose(np.mean(feet, axis=0)[1], -0.03, atol=0.01)
    last, planned = found.keyframes[-1].stance, fast_plan.keyframes[-1].stance
    assert sorted(described(last)) == sorted(described(planned))
    ends = found.trajectory.keyframes
    assert len(ends) == len(found.keyframes)
    assert ends[0] == 0.0


def test_from_where_it_was_planned_the_plan_is_found_again(demo_plan):
    found = start_again(demo_plan, demo_plan.world.scene)
    for a, b in zip(found.keyframes, demo_plan.keyframes, strict=True):
        assert np.allclose(a.q, b.q, atol=1e-6)


# Steps from where the limbs really are.


def test_each_limb_leaves_the_surface_that_it_is_on(demo_plan):
    world = demo_plan.world
    steps = split_moves(demo_plan.sequence, world)[0]
    key = demo_plan.keyframes[2]
    # The left elbow has met the box where the hand was to be.
    other = tuple(
        replace(c, surface="LElbow") if c.surface == "LHand" else c for c in key.stance
    )
    new = from_here(steps[2:], other, world)
    assert [s.breaks for s in steps[2:]] == [
        ("LHand",),
        ("RHand",),
        ("LFoot",),
        ("RFoot",),
    ]
    assert [s.breaks for s in new] == [
        ("LElbow",),
        ("RHand",),
        ("LFoot",),
        ("RFoot",),
    ]
    for a, b in zip(steps[2:], new, strict=True):
        assert a.makes is b.makes
        assert (a.stance, a.limb) == (b.stance, b.limb)


def test_only_the_first_move_of_a_limb_is_another(demo_plan):
    world = demo_plan.world
    steps = split_moves(demo_plan.sequence, world)[0]
    hand = [s for s in steps if s.limb == "left_arm"]
    on = demo_plan.keyframes[1].stance
    other = tuple(replace(c, surface="LElbow") for c in on if c.surface == "LHand")
    later = hand[-1]
    new = from_here([later, later], other, world)
    assert [s.breaks for s in new] == [("LElbow",), later.breaks]
    # One that should be in the air, and is not, lets go of what it is on.
    (air,) = from_here([hand[0]], other, world)
    assert (hand[0].breaks, air.breaks) == ((), ("LElbow",))


@pytest.mark.parametrize("step", STEPS)
def test_where_one_margin_does_not_reach_the_next_goes_on(demo_plan, step):
    made, held, q = made_at(demo_plan, step)
    ik = IK(demo_plan.world)
    free = np.zeros(len(demo_plan.world.pairs), dtype=bool)

    def below(*margins):
        return adaptation._nodes_below(ik, held, made, q, free, margins)[1]

    assert below(0.5) == [0.0]  # no stance has that margin
    assert below(0.5, 0.01) == below(0.01)
    assert below(0.01)[-1] > 0.0
    assert below(0.045, 0.01)[-1] >= below(0.01)[-1]
