"""Plans from the middle of a climb: where the robot is, and what is left."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from clamber import cli
from clamber.contact.contact import Stance
from clamber.contact.steps import split_steps
from clamber.errors import InputError, Status
from clamber.execution.disturbance import Disturbance
from clamber.execution.simulation import simulate
from clamber.execution.verdict import judge
from clamber.model.kinematics import Kinematics
from clamber.model.scene import Scene
from clamber.model.world import build_world
from clamber.planning import planner, start
from clamber.planning.planner import plan
from clamber.planning.records import Budget, Fallback, State
from clamber.planning.search import Search
from clamber.planning.start import (
    from_here,
    measured_contact,
    settle,
    state_of,
    steps_done,
)
from clamber.planning.trajectory import HOLD_START, RATE, holding_torque
from clamber.run.folder import load_plan, save_plan
from clamber.run.state import load_state
from clamber.step.change import Failure
from clamber.step.ik import IK
from clamber.step.path import bridge, can_be_gone
from oracles import contact_drift

OFFSETS = [(0.0, 0.0, 0.02), (0.0, 0.0, -0.03), (0.012, -0.01, 0.015)]


def moved(scene: Scene, *offset: float, roughness: float = 0.0) -> Scene:
    """The box elsewhere."""
    box = scene.boxes[0]
    box = replace(box, centre=box.centre + offset, roughness=roughness)
    return replace(scene, boxes=(box,))


def as_measured(contacts, offset, on="box"):
    """Contacts on a box that is elsewhere."""
    return tuple(
        replace(c, position=c.position + np.array(offset)) if c.support == on else c
        for c in contacts
    )


def rest_of(made, done, stance, scene=None, loaded=None, q=None, **how):
    """What is left of a plan, as it was demonstrated, from a stance of it."""
    loaded = stance if loaded is None else loaded
    q = made.keyframes[done].q if q is None else q
    now = State(done=done, stance=tuple(stance), loaded=tuple(loaded), q=q)
    return plan(
        made.policy or made.sequence,
        made.world.robot,
        scene or made.world.scene,
        start=now,
        options=made.options,
        **{"contacts": "demonstrated", **how},
    )


def described(contacts) -> list[str]:
    return [f"{c.surface}@{c.support}" for c in contacts]


# Where the robot is.


def done(made, sequence, stance) -> int:
    steps = split_steps(sequence, made.world)[0]
    return steps_done(sequence, steps, stance, made.world)


@pytest.mark.parametrize("k", range(7))
def test_a_posture_tells_how_far_the_climb_has_come(demo_plan, k):
    key = demo_plan.keyframes[k]
    now = state_of(demo_plan, demo_plan.world.scene, key.q)
    assert now.done == k
    there = {c.surface: c for c in key.stance}
    assert {c.surface for c in now.stance} == set(there)
    assert now.loaded == now.stance
    for c in now.stance:
        assert c.support == there[c.surface].support
        # A contact that has rolled touches farther on.
        assert np.linalg.norm(c.position - there[c.surface].position) < 0.05


def test_a_contact_that_is_missed_is_a_step_to_be_made(demo_plan):
    stance = demo_plan.keyframes[3].stance
    for k, gone in ((2, "LElbow"), (3, "RHand")):
        left = [c for c in stance if c.surface != gone]
        assert done(demo_plan, demo_plan.sequence, left) == k
    standing = demo_plan.keyframes[0].stance
    assert done(demo_plan, demo_plan.sequence, standing) == 0


def test_the_same_surfaces_twice_are_told_apart_by_where_they_are(demo_plan):
    """A crawl makes the same stance again, farther on."""
    first, last = (demo_plan.keyframes[k].stance for k in (0, -1))
    step = np.array([0.1, 0.0, 0.0])
    on = [replace(c, position=c.position + step) for c in last]
    stances, contacts = [Stance(contacts=x) for x in (first, last)], list(last)
    for c in on:
        contacts = [c if x.surface == c.surface else x for x in contacts]
        stances.append(Stance(contacts=tuple(contacts)))
    crawl = replace(
        demo_plan.sequence, stances=tuple(stances), t=np.arange(len(stances) + 1.0)
    )
    assert done(demo_plan, crawl, last) == 4
    assert done(demo_plan, crawl, on) == 8


@pytest.mark.parametrize(
    ("contacts", "said"),
    [
        ({"LHand": "shelf"}, "contacts.LHand is 'shelf'; expected one of ground, box"),
        ({"Tail": "box"}, "contacts.Tail is 'Tail'; expected one of LHand"),
        ({"LHand": "ground"}, "mm above ground"),
        ({"LFoot": "box"}, "expected a surface on box"),
        ({}, "expected a posture with a surface on a support"),
    ],
)
def test_contacts_that_are_not_there_are_the_users_mistake(demo_plan, contacts, said):
    key = demo_plan.keyframes[2]
    with pytest.raises(InputError) as wrong:
        state_of(demo_plan, demo_plan.world.scene, key.q, contacts, source="s.yaml")
    assert str(wrong.value).startswith("s.yaml: contacts")
    assert said in str(wrong.value)


def test_a_hand_whose_box_has_gone_is_in_the_air(demo_plan):
    key = demo_plan.keyframes[2]
    now = state_of(demo_plan, moved(demo_plan.world.scene, 0.0, 0.0, -0.05), key.q)
    assert {c.surface for c in now.stance} == {"LFoot", "RFoot"}
    assert now.done == 0


def test_contacts_of_the_middle_are_of_the_moved_world(demo_plan):
    """A box that has risen under the hands by a little: they are on its top."""
    key, scene = demo_plan.keyframes[2], demo_plan.world.scene
    up = moved(scene, 0.0, 0.0, 0.004)
    now = state_of(demo_plan, up, key.q)
    assert {c.surface for c in now.stance} >= {"LHand", "RHand"}
    kin = Kinematics(build_world(demo_plan.world.robot, up))
    kin.update(key.q)
    for c in now.stance:
        if c.support == "box":
            p = kin.contact_point(c.surface, np.array([0.0, 0.0, 1.0]))
            assert np.allclose(c.position, p)


# Steps from where the limbs really are.


def test_each_limb_leaves_the_surface_that_it_is_on(demo_plan):
    world = demo_plan.world
    steps = split_steps(demo_plan.sequence, world)[0]
    key = demo_plan.keyframes[2]
    # The left elbow has met the box where the hand was to be.
    other = tuple(
        replace(c, surface="LElbow") if c.surface == "LHand" else c for c in key.stance
    )
    new = from_here(steps, 2, other, world)
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
    steps = split_steps(demo_plan.sequence, world)[0]
    hand = [s for s in steps if s.limb == "left_arm"]
    on = demo_plan.keyframes[1].stance
    other = tuple(replace(c, surface="LElbow") for c in on if c.surface == "LHand")
    later = hand[-1]
    new = from_here([later, later], 0, other, world)
    assert [s.breaks for s in new] == [("LElbow",), later.breaks]
    # One that should be in the air, and is not, lets go of what it is on.
    (air,) = from_here([hand[0]], 0, other, world)
    assert (hand[0].breaks, air.breaks) == ((), ("LElbow",))


def test_a_limb_that_is_back_on_the_ground_has_its_step_left(demo_plan):
    """A knee has slipped off the box: first of all its foot leaves the ground again."""
    world = demo_plan.world
    steps = split_steps(demo_plan.sequence, world)[0]
    n = len(steps)
    foot = demo_plan.start.stance[0]
    assert (foot.surface, foot.support) == ("LFoot", "ground")
    end = demo_plan.keyframes[-1].stance
    slipped = (foot, *(c for c in end if c.surface != "LKnee"))
    assert from_here(steps, n, end, world) == []
    (again,) = from_here(steps, n, slipped, world)
    assert (again.limb, again.breaks) == ("left_leg", ("LFoot",))
    assert again.makes is steps[-2].makes
    assert again.makes.surface == "LKnee"
    # Another step that is still to come is planned after it.
    left = from_here(steps, n - 1, slipped, world)
    assert [s.makes.surface for s in left] == ["LKnee", "RKnee"]
    # On another surface, or in the air, it is where it is.
    other = [replace(c, surface="LFoot") if c.surface == "LKnee" else c for c in end]
    assert from_here(steps, n, other, world) == []
    assert from_here(steps, n, slipped[1:], world) == []


# What is left, from a stance as it was measured.


@pytest.fixture(scope="module", params=OFFSETS, ids=str)
def measured(request, fast_plan):
    """Both hands on a box that is elsewhere: its scene, contacts, what was found."""
    scene = moved(fast_plan.world.scene, *request.param)
    contacts = as_measured(fast_plan.keyframes[2].stance, request.param)
    return scene, contacts, rest_of(fast_plan, 2, contacts, scene)


def test_the_first_keyframe_has_the_contacts_that_were_measured(measured):
    _, contacts, found = measured
    key, kin = found.start, Kinematics(found.world)
    assert key.status is Status.SOLVED
    assert described(key.stance) == described(contacts)
    for c, there in zip(contacts, key.stance, strict=True):
        assert np.array_equal(c.position, there.position)
    kin.update(key.q)
    assert max(contact_drift(kin, c) for c in contacts) < 1e-3


def test_all_steps_that_are_left_are_planned_on_the_top_as_it_is(fast_plan, measured):
    scene, _, found = measured
    assert found.complete
    assert [c.step.index for c in found.changes] == [2, 3, 4, 5]
    last, planned = found.keyframes[-1].stance, fast_plan.keyframes[-1].stance
    assert sorted(described(last)) == sorted(described(planned))
    kin, top = Kinematics(found.world), scene.boxes[0].top
    for key in found.keyframes:
        assert key.status is Status.SOLVED
        kin.update(key.q)
        for c in key.stance:
            if c.support == "box":
                assert abs(top.height(c.position)) < 1e-3
                assert top.inside(c.position)
            assert contact_drift(kin, c) < 1e-3


def test_the_new_trajectory_comes_to_the_stances_of_the_new_keyframes(measured):
    _, _, found = measured
    t, kin = found.trajectory, Kinematics(found.world)
    ends = [t.at(x) for x in t.keyframes]
    assert ends[0] > 0  # there is a way to the first one
    assert ends == sorted(set(ends))
    for k, i in (ends[0], 0), (ends[-1], -1):  # the others it need not pass through
        assert np.abs(kin.difference(t.q[k], found.keyframes[i].q)).max() < 2e-3
    for k, key in zip(ends, found.keyframes, strict=True):
        closed = {s for s, c in zip(t.surfaces, t.contact[k], strict=True) if c}
        assert {c.surface for c in key.stance} <= closed


def test_it_goes_on_from_what_is_commanded_and_from_the_base_as_measured(fast_plan):
    """Joints begin where the servos are, so that nothing jumps."""
    world, key = fast_plan.world, fast_plan.keyframes[2]
    q = key.q.copy()
    q[world.qadr] += 0.004 * np.cos(np.arange(len(world.qadr)))
    t = rest_of(fast_plan, 2, key.stance, q=q).trajectory
    assert np.allclose(t.q[0, world.qadr], q[world.qadr], atol=1e-12)
    assert np.abs(t.q[0, :3] - key.q[:3]).max() < 0.01
    hold = round(HOLD_START * RATE)
    assert np.all(t.q[:hold] == t.q[0])
    assert not t.v[:hold].any()


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_a_contact_that_does_not_bear_yet_is_loaded_little_by_little(demo_plan, speed):
    key = demo_plan.keyframes[2]
    loaded = tuple(c for c in key.stance if c.surface != "RHand")
    made = replace(demo_plan, options=replace(demo_plan.options, speed=speed))
    found = rest_of(made, 2, key.stance, loaded=loaded)
    kin, t = Kinematics(found.world), found.trajectory
    tau = holding_torque(kin, t.q[0], loaded)
    assert np.allclose(t.tau[0], tau, atol=1e-6)
    there = [np.abs(kin.difference(q, found.start.q)).max() for q in t.q[:9000]]
    settled = int(np.argmin(there))
    assert there[settled] < 2e-3
    assert settled > 350
    before = holding_torque(kin, found.start.q, loaded)
    tau = holding_torque(kin, found.start.q, key.stance)
    assert np.abs(tau - before).max() > 0.1
    away = [np.abs(t.tau[settled] - x).max() for x in (tau, before)]
    assert away[0] < away[1]
    jump = np.abs(np.diff(t.tau[: settled + 1], axis=0)).max()
    assert jump < 2.0 * speed  # none, in a millisecond
    # The contact is closed all the while.
    assert t.contact[: settled + 1, t.surfaces.index("RHand")].all()


def test_with_no_steps_left_there_is_still_the_way_to_a_good_posture(fast_plan):
    offset = (0.0, 0.0, 0.01)
    contacts = as_measured(fast_plan.keyframes[-1].stance, offset)
    found = rest_of(fast_plan, 6, contacts, moved(fast_plan.world.scene, *offset))
    assert (found.complete, found.changes) == (True, ())
    assert described(found.start.stance) == described(contacts)
    end = Kinematics(found.world).difference(found.trajectory.q[-1], found.start.q)
    assert np.abs(end).max() < 1e-6


def test_a_contact_that_slipped_to_the_border_need_not_roll_back(demo_plan):
    """Rolling a hand inwards by two centimetres would take all of the body along."""
    key, world = demo_plan.keyframes[2], demo_plan.world
    hand = max(c.position[0] for c in key.stance if c.support == "box")
    box = world.scene.boxes[0]
    near = float(box.centre[0] - box.size[0] / 2)
    there = build_world(world.robot, moved(world.scene, hand + 0.005 - near, 0.0, 0.0))
    kin = Kinematics(there)
    kin.update(key.q)
    contacts = tuple(measured_contact(kin, c) for c in key.stance)
    now = State(stance=contacts, loaded=contacts, q=key.q, done=2)
    _, lead = settle(IK(there), now, demo_plan.options)
    begin, here = lead[0].q
    assert np.abs(kin.difference(begin, here)).max() < 5e-3


@pytest.mark.parametrize("open_way", [True, False])
def test_where_the_way_to_a_better_posture_lets_go_of_a_contact_it_is_not_gone(
    demo_plan, monkeypatch, open_way
):
    """A posture with the same contacts may lie on the other side of one that slips."""
    monkeypatch.setattr(start, "can_be_gone", lambda *_: open_way)
    ik, stance = IK(demo_plan.world), demo_plan.keyframes[5].stance
    now = State(done=5, stance=stance, loaded=stance, q=demo_plan.changes[4].touching)
    key, (here, way) = settle(ik, now, demo_plan.options)
    assert key.status is Status.SOLVED
    assert described(key.stance) == described(stance)
    moved = np.abs(ik.kin.difference(here.q[-1], key.q)).max()
    assert (moved > 0.03) == open_way
    np.testing.assert_array_equal(way.q[[0, -1]], [here.q[-1], key.q])


def test_a_way_on_which_a_contact_opens_cannot_be_gone(demo_plan):
    ik = IK(demo_plan.world)
    key, other = demo_plan.keyframes[3], demo_plan.keyframes[0]
    assert can_be_gone(ik, np.stack([key.q, key.q]), key.stance)
    way = bridge(ik, key.q, key.q, key.stance)
    assert can_be_gone(ik, way, key.stance)
    assert not can_be_gone(ik, np.stack([key.q, other.q]), key.stance)


def test_a_stance_that_cannot_be_is_said_to_be_none(fast_plan):
    stance = fast_plan.start.stance
    far = as_measured(stance[:1], (0.0, 3.0, 0.0), on="ground")
    for contacts in ("demonstrated", "any"):
        found = rest_of(fast_plan, 0, (*far, stance[1]), contacts=contacts)
        assert found.trajectory is found.fallback is None
        assert str(found.failures[0]).startswith("no stable posture here: ")
        assert found.start.status is found.failures[0].status


def test_a_step_that_has_no_way_is_named(fast_plan, monkeypatch):
    """The box has moved away: the rest of the climb is out of reach."""
    monkeypatch.setattr(planner, "VARIATIONS", ({},))
    scene = moved(fast_plan.world.scene, 3.0, 0.0, 0.0)
    found = rest_of(fast_plan, 0, fast_plan.start.stance, scene)
    assert str(found.failures[0]).startswith("air -> LHand on box: ")
    assert not found.complete


def test_a_world_without_the_box_is_the_users_mistake(demo_plan):
    scene = replace(demo_plan.world.scene, boxes=())
    with pytest.raises(InputError) as error:
        rest_of(demo_plan, 0, demo_plan.start.stance, scene)
    assert error.value.field == "scene.boxes"


def test_where_there_is_no_way_at_the_distance_asked_for_it_is_not_kept(
    fast_plan, monkeypatch
):
    """Roughness, or clearance: the one that goes farther, else the careful one."""
    world, keys, asked, plain = fast_plan.world, fast_plan.keyframes, [], planner.IK
    pair = next(set(p) for p in world.pairs if world.support_geom["box"] in p)
    (link,) = pair - {world.support_geom["box"]}
    farther = {(int(link), "box"): 0.03}

    def workspace(world, clearance):
        asked.append(bool(clearance) or world.scene.boxes[0].roughness > 0)
        return plain(world)

    def follow(search, start, steps, proposer, variations):
        """As many steps as are to be made, one is left out if any is."""
        n = answers[asked[-1]]
        missed = (Failure(status=Status.COLLIDING, step=steps[0]),) if n < 4 else ()
        changes = fast_plan.changes[2 : 2 + n]
        route = planner.Route(
            start=start, changes=changes, failures=missed, arrived=not missed
        )
        return route, search.options

    monkeypatch.setattr(planner, "IK", workspace)
    monkeypatch.setattr(planner, "follow_steps", follow)
    monkeypatch.setattr(planner, "timed", lambda *a: None)
    rough = moved(world.scene, 0.0, 0.0, 0.0, roughness=0.03)
    for how in ({"scene": rough}, {"clearance": farther}):
        for answers, taken, twice in (
            ({True: 4, False: 4}, True, False),
            ({True: 1, False: 4}, False, True),
            ({True: 1, False: 2}, False, True),
            ({True: 2, False: 2}, True, True),
        ):
            asked.clear()
            found = rest_of(fast_plan, 2, keys[2].stance, **how)
            assert asked == [True, False][: 1 + twice]
            assert len(found.changes) == answers[taken]
            assert found.world.scene.boxes[0].roughness == (
                0.03 if taken and "scene" in how else 0.0
            )
    asked.clear()  # where nothing is asked for nothing is tried twice
    rest_of(fast_plan, 2, keys[2].stance)
    assert asked == [False]


def test_a_keyframe_to_go_on_from_is_taken_as_it_is(fast_plan):
    key = fast_plan.keyframes[-2]
    found = plan(
        fast_plan.sequence,
        fast_plan.world.robot,
        fast_plan.world.scene,
        start=State(done=5, stance=key.stance, loaded=key.stance, q=key.q),
        options=fast_plan.options,
    )
    assert found.start is not key  # a state is settled in
    last = plan(
        replace(
            fast_plan.sequence,
            stances=fast_plan.sequence.stances[:1],
            t=fast_plan.sequence.t[:2],
        ),
        fast_plan.world.robot,
        fast_plan.world.scene,
        start=key,
    )
    assert (last.start, last.changes, last.complete) == (key, (), True)


def test_from_another_start_the_whole_plan_is_made_anew(fast_plan):
    scene = fast_plan.world.scene
    scene = replace(scene, start=scene.start + np.array([0.02, -0.03, 0.05]))
    robot = fast_plan.world.robot
    found = plan(fast_plan.sequence, robot, scene, options=fast_plan.options)
    assert found.complete
    assert len(found.changes) == len(fast_plan.changes)
    home = build_world(robot, scene).home
    assert np.array_equal(found.start.q, home)
    assert np.allclose(found.trajectory.q[0], home, atol=1e-9)
    last, planned = found.keyframes[-1].stance, fast_plan.keyframes[-1].stance
    assert sorted(described(last)) == sorted(described(planned))
    assert found.trajectory.keyframes[0] == 0.0


def test_from_where_it_was_planned_the_plan_is_found_again(demo_plan):
    """Its sequence is in the robot's scene already."""
    world = demo_plan.world
    found = plan(demo_plan.sequence, world.robot, world.scene)
    for a, b in zip(found.keyframes, demo_plan.keyframes, strict=True):
        assert np.allclose(a.q, b.q, atol=1e-6)


# Other contacts from the middle.


@pytest.fixture
def sore(monkeypatch):
    """A limb's surface cannot make a contact, whoever asks but the search."""

    def make(surface, of=lambda proposer: proposer != "search"):
        plain = Search.change

        def change(self, proposer, before, step, options=None):
            if of(proposer) and step.makes is not None:
                if step.makes.surface == surface:
                    return Failure(status=Status.UNREACHABLE, step=step, detail="sore")
            return plain(self, proposer, before, step, options)

        monkeypatch.setattr(Search, "change", change)
        monkeypatch.setattr("clamber.planning.demonstrated.MAX_REPAIRS", 0)
        monkeypatch.setattr(planner, "VARIATIONS", ({},))

    return make


def test_the_rest_has_its_alternatives_too(demo_plan, sore):
    """An elbow is nowhere to be had: the hand stays."""
    sore("LElbow")
    rest = rest_of(demo_plan, 2, demo_plan.keyframes[2].stance, contacts="any")
    assert rest.complete
    assert "sore" in rest.fallback.reason
    assert rest.fallback.source == "alternatives"
    assert "LHand" in rest.fallback.surfaces
    steps = split_steps(rest.sequence, rest.world)[0][rest.state.done :]
    made = [c.step for c in rest.changes]
    assert [s.makes.surface for s in steps] == [s.makes.surface for s in made]
    assert [s.index for s in steps] == [s.index for s in made]


def test_the_rest_that_was_searched_for_is_counted_from_standing(demo_plan, sore):
    """Execution counts steps: those before the middle are done already."""
    sore("RKnee")
    stance = demo_plan.keyframes[5].stance
    rest = rest_of(demo_plan, 5, stance, contacts="any")
    assert rest.complete
    assert rest.fallback.source == "search"
    made = [c.step for c in rest.changes]
    assert rest.fallback.surfaces == tuple(s.makes.surface for s in made)
    steps = split_steps(rest.sequence, rest.world)[0][rest.state.done :]
    assert [s.makes.surface for s in steps] == [s.makes.surface for s in made]
    assert [s.index for s in steps] == [s.index for s in made]
    assert [s.stance for s in steps] == [s.stance for s in made]
    none = rest_of(demo_plan, 5, stance, contacts="any", budget=Budget(tries=0))
    assert not none.complete
    assert none.fallback.source is None


@pytest.mark.slow
@pytest.mark.parametrize("k", [2, 3])
@pytest.mark.parametrize(
    "offset", [(0.05, 0.0, 0.0), (-0.05, 0.0, 0.0), (0.0, 0.05, 0.0)]
)
def test_stopped_in_the_middle_a_climb_goes_on_to_the_top_of_a_box_that_moved(
    demo_plan, demo_rollout, k, offset
):
    states = demo_rollout.time.searchsorted(demo_plan.trajectory.keyframes[k])
    q = demo_rollout.qpos[states]
    scene = moved(demo_plan.world.scene, *offset)
    now = state_of(demo_plan, scene, q)
    rest = rest_of(demo_plan, now.done, now.stance, scene, q=now.q, contacts="any")
    assert (now.done, rest.complete, rest.fallback) == (k, True, None)
    assert len(rest.changes) == 6 - k
    rollout = simulate(rest)
    assert np.array_equal(rollout.qpos[0], q)  # it starts where it was
    verdict = judge(rest, rollout)
    assert verdict.reached, verdict
    near = scene.boxes[0].centre - scene.boxes[0].size / 2
    for c in rest.keyframes[-1].stance:
        assert c.support == "box"
        assert np.all(c.position[:2] > near[:2])


# On disk and from the command line.


def test_a_plan_from_the_middle_survives_the_disk(demo_plan, tmp_path):
    key = demo_plan.keyframes[2]
    now = state_of(demo_plan, demo_plan.world.scene, key.q)
    now = replace(now, loaded=now.stance[1:])
    because = Fallback(reason="because", source="search", surfaces=("LHand",))
    save_plan(replace(demo_plan, state=now, fallback=because), tmp_path)
    again = load_plan(tmp_path)
    assert again.fallback == because
    assert again.state.done == 2
    assert np.array_equal(again.state.q, key.q)
    assert [c.surface for c in again.state.loaded] == [c.surface for c in now.loaded]
    assert all(c in again.state.stance for c in again.state.loaded)
    for a, b in zip(again.state.stance, now.stance, strict=True):
        assert np.array_equal(a.position, b.position)
        assert (a.surface, a.support) == (b.surface, b.support)
    save_plan(demo_plan, tmp_path)
    assert load_plan(tmp_path).state is None
    assert "state" not in json.loads((tmp_path / "plan.json").read_text())


def test_a_start_in_the_middle_is_not_disturbed(demo_plan):
    now = state_of(demo_plan, demo_plan.world.scene, demo_plan.keyframes[2].q)
    middle = replace(demo_plan, state=now)
    with pytest.raises(InputError, match="begins in the middle of a climb"):
        simulate(middle, disturbance=Disturbance(x=0.01))


def written_state(plan, k: int) -> dict:
    q = plan.keyframes[k].q
    joints = dict(zip(plan.world.joints, q[plan.world.qadr].tolist(), strict=True))
    return {
        "position": q[:3].tolist(),
        "quaternion": q[3:7].tolist(),
        "joints": joints,
        "contacts": {c.surface: c.support for c in plan.keyframes[k].stance},
    }


def test_a_state_file_gives_posture_and_contacts(demo_plan, tmp_path):
    path = tmp_path / "state.yaml"
    state = written_state(demo_plan, 2)
    path.write_text(yaml.safe_dump(state))
    q, touching = load_state(demo_plan, tmp_path, str(path))
    assert np.allclose(q, demo_plan.keyframes[2].q)
    assert touching == state["contacts"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"joints": {"Tail": 0.0}}, "joints.Tail is 0.0; expected the joints of coman"),
        ({"joints": {}}, "expected the joints of coman"),
        ({"quaternion": [2.0, 0.0, 0.0, 0.0]}, "expected a unit quaternion"),
        ({"position": [0.0, 0.0]}, "position"),
        ({"position": [float("nan"), 0.0, 0.0]}, "expected finite numbers only"),
        ({"velocity": 1.0}, "velocity is 1.0; expected no such field"),
    ],
)
def test_a_state_that_cannot_be_is_the_users_mistake(demo_plan, tmp_path, change, said):
    path = tmp_path / "state.yaml"
    path.write_text(yaml.safe_dump(written_state(demo_plan, 2) | change))
    with pytest.raises(InputError) as wrong:
        load_state(demo_plan, tmp_path, str(path))
    assert str(path) in str(wrong.value)
    assert said in str(wrong.value)


def test_replan_from_a_state_plans_the_rest(demo_plan, tmp_path, capsys):
    run, out = tmp_path / "run", tmp_path / "rest"
    run.mkdir()
    save_plan(demo_plan, run)
    state = tmp_path / "state.yaml"
    state.write_text(yaml.safe_dump(written_state(demo_plan, 2)))
    args = ["replan", str(run), "--from", str(state), "--out", str(out), "--json"]
    assert cli.main(args) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["done"], record["complete"]) == (2, True)
    rest = load_plan(out)
    assert rest.state.done == 2
    assert len(rest.keyframes) == 5
    assert np.allclose(rest.trajectory.q[0], demo_plan.keyframes[2].q, atol=0.01)
