"""Other contacts of a sequence, ranked; the rest of a climb from its middle."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from clamber import cli
from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.steps import split_moves
from clamber.errors import InputError, Status
from clamber.execution.disturbance import Disturbance
from clamber.execution.simulation import simulate
from clamber.execution.verdict import judge
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world
from clamber.planning import search
from clamber.planning import substitutes as alternatives
from clamber.planning.free import Bounds, Explored, Stop
from clamber.planning.records import Fallback
from clamber.planning.substitutes import (
    Ranked,
    contact_alternatives,
    contact_differences,
    plan_cost,
    plan_or_replan,
    replan,
    replan_rest,
    stand_ins,
    state_of,
    steps_made,
)
from clamber.run.folder import load_plan, save_plan, save_sequence
from clamber.run.state import load_state
from clamber.step.change import Failure

SORE = Failure(status=Status.UNREACHABLE, detail="an elbow is sore")
HANDS, ELBOWS = {"LHand", "RHand"}, {"LElbow", "RElbow"}


def sequence_of(*stances: str) -> ContactSequence:
    """Stances by the surfaces in them; where they are does not matter."""
    return ContactSequence(
        source="test",
        subject=None,
        scene=Scene.from_height(0.2),
        stances=tuple(
            Stance(
                contacts=tuple(
                    Contact(
                        surface=s,
                        support="ground" if s.endswith("Foot") else "box",
                        position=np.array([0.5, 0.0, 0.0]),
                        quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
                    )
                    for s in names.split()
                )
            )
            for names in stances
        ),
        t=np.arange(len(stances) + 1.0),
    )


# The example of thesis 5.3.
EXAMPLE = (
    "LFoot RFoot",
    "LFoot RFoot LHand RHand",
    "LFoot RFoot LHand RHand LElbow RElbow",
    "RFoot LHand RHand LElbow RElbow LKnee",
    "LHand RHand LElbow RElbow LKnee RKnee",
)


def test_the_differences_are_those_of_the_thesis():
    assert [set(d) for d in contact_differences(sequence_of(*EXAMPLE))] == [
        HANDS,
        HANDS | ELBOWS,
        HANDS | ELBOWS | {"LKnee"},
        HANDS | ELBOWS | {"LKnee", "RKnee"},
    ]


def test_the_four_plans_are_those_of_the_thesis_and_no_others(coman):
    plans = contact_alternatives(sequence_of(*EXAMPLE), coman)
    assert len(plans) == 4
    assert {frozenset(p.surfaces) for p in plans} == {
        frozenset({"LElbow", "RElbow"}),
        frozenset({"RElbow", "LHand"}),
        frozenset({"LElbow", "RHand"}),
        frozenset({"LHand", "RHand"}),
    }


def test_a_plan_keeps_its_combination_and_all_other_contacts(coman):
    sequence = sequence_of(*EXAMPLE)
    for plan in contact_alternatives(sequence, coman):
        gone = (HANDS | ELBOWS) - set(plan.surfaces)
        assert len(plan.sequence.stances) == len(sequence.stances)
        for a, b in zip(plan.sequence.stances, sequence.stances, strict=True):
            assert a.surfaces == tuple(s for s in b.surfaces if s not in gone)


@pytest.mark.parametrize(
    ("stances", "offers"),
    [
        (EXAMPLE[:2], [()]),  # one surface of each arm
        (
            ("LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot LElbow"),
            [()],
        ),  # never both
        (("LFoot RFoot", "LFoot RFoot LHand LElbow"), [("LElbow",), ("LHand",)]),
        # What the first stance has is no difference, and no choice.
        (("LFoot RFoot LHand", "LFoot RFoot LHand LElbow"), [()]),
        (("LFoot RFoot", "LFoot LKnee RFoot"), [()]),
        (EXAMPLE[:1], [()]),
    ],
)
def test_a_choice_is_between_surfaces_that_a_limb_offers_at_once(
    coman, stances, offers
):
    found = contact_alternatives(sequence_of(*stances), coman)
    assert [a.surfaces for a in found] == offers


def test_a_surface_that_the_robot_has_not_is_no_choice(coman):
    left = replace(coman.limbs["left_arm"], surfaces=("LHand",))
    robot = replace(coman, limbs={**coman.limbs, "left_arm": left})
    found = contact_alternatives(sequence_of(*EXAMPLE), robot)
    assert [a.surfaces for a in found] == [("RElbow",), ("RHand",)]


# Cost and rank.


ON_HANDS = ("LFoot RFoot", "LFoot RFoot LHand", "RFoot LHand RHand LKnee")


def test_elbows_stand_in_for_hands_both_before_one(coman):
    found = stand_ins(sequence_of(*ON_HANDS), coman)
    assert [set(a.surfaces) for a in found] == [
        {"LElbow", "RElbow"},
        {"LElbow", "RHand"},
        {"LHand", "RElbow"},
    ]
    both = found[0].sequence
    assert [set(s.surfaces) for s in both.stances] == [
        {"LFoot", "RFoot"},
        {"LFoot", "RFoot", "LElbow"},
        {"RFoot", "LElbow", "RElbow", "LKnee"},
    ]
    for a, b in zip(both.stances, sequence_of(*ON_HANDS).stances, strict=True):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            assert np.array_equal(c.position, d.position)


def test_an_elbow_that_is_demonstrated_is_no_stand_in(coman):
    assert stand_ins(sequence_of(*EXAMPLE), coman) == ()
    one = ("LFoot RFoot", "LFoot RFoot LHand RHand", "LFoot RFoot LElbow RHand")
    assert [a.surfaces for a in stand_ins(sequence_of(*one), coman)] == [("RElbow",)]


def test_hands_that_stay_on_the_ground_have_no_stand_ins(coman):
    sequence = sequence_of(*ON_HANDS)
    ground = [
        replace(s, contacts=tuple(replace(c, support="ground") for c in s.contacts))
        for s in sequence.stances
    ]
    assert stand_ins(replace(sequence, stances=tuple(ground)), coman) == ()


def test_the_cost_is_the_way_to_each_contact_and_its_projected_distance(demo_plan):
    world, kin, expected = demo_plan.world, Kinematics(demo_plan.world), 0.0
    for before, change in zip(demo_plan.keyframes, demo_plan.changes, strict=False):
        made = change.step.makes
        kin.update(before.q)
        p = kin.contact_point(made.surface, np.array([0.0, 0.0, 1.0]))
        kin.update(change.keyframe.q)
        stance = change.keyframe.stance
        there = next(c for c in stance if c.surface == made.surface)
        mass = kin.landmark(world.robot.limb_of(made.surface).root)[1]
        expected += np.linalg.norm(made.position - p)
        expected += np.linalg.norm((mass - there.position)[:2])
    assert plan_cost(demo_plan) == pytest.approx(expected, abs=2e-3)


def test_a_step_that_is_missed_costs_what_is_left_of_it(demo_plan):
    """The robot stands: nothing is made, all is left."""
    steps = split_moves(demo_plan.sequence, demo_plan.world)[0]
    failures = tuple(Failure(status=Status.COLLIDING, step=s) for s in steps)
    none = replace(demo_plan, changes=(), failures=failures)
    kin, expected = Kinematics(demo_plan.world), 0.0
    kin.update(demo_plan.keyframes[0].q)
    for step in steps:
        c = step.makes
        mass = kin.landmark(demo_plan.world.robot.limb_of(c.surface).root)[1]
        p = kin.contact_point(c.surface, np.array([0.0, 0.0, 1.0]))
        expected += np.linalg.norm(c.position - p)
        expected += np.linalg.norm((mass - c.position)[:2])
    assert plan_cost(none) == pytest.approx(expected, abs=1e-9)


def test_what_is_stable_comes_first_then_what_costs_less(demo_plan):
    short = replace(demo_plan, changes=demo_plan.changes[:2])
    names = [alternatives.Alternative(surfaces=(s,), sequence=None) for s in "abc"]
    unstable = replace(short, complete=False)
    order = alternatives._ranked(
        list(zip(names, (unstable, demo_plan, short), strict=True))
    )
    assert [r.surfaces for r in order] == [("c",), ("b",), ("a",)]
    assert order[0].cost < order[1].cost
    assert order[2].cost == order[0].cost  # it is cheap, and of no use


@pytest.fixture(scope="module")
def low(demo_sequence, coman):
    """The alternatives on a box of 0.15 m."""
    return replan(demo_sequence, coman, Scene.from_height(0.15))


def test_on_a_low_box_every_alternative_is_shorter_than_the_demonstration(
    low, demo_sequence, coman
):
    shown = alternatives.plan(demo_sequence, coman, Scene.from_height(0.15))
    assert len(low.ranked) == 4
    assert low.explored is None
    assert all(r.stable for r in low.ranked)
    costs = [r.cost for r in low.ranked]
    assert costs == sorted(costs)
    assert costs[-1] < plan_cost(shown)
    for r in low.ranked:
        assert len(r.plan.changes) == len(shown.changes) - 2
        made = {c.step.makes.surface for c in r.plan.changes}
        assert made == {*r.surfaces, "LKnee", "RKnee"}


@pytest.mark.slow
def test_the_best_alternative_gets_up_the_low_box(low):
    rollout = simulate(low.best.plan)
    assert judge(low.best.plan, rollout).reached
    assert not rollout.stopped


# Falling back.


def test_a_plan_that_is_complete_is_all_there_is(demo_sequence, coman, monkeypatch):
    def never(*args, **kwargs):
        raise AssertionError("alternatives are not looked at")

    monkeypatch.setattr(alternatives, "_replanned", never)
    found = plan_or_replan(demo_sequence, coman, Scene.from_height(0.275))
    assert found.complete
    assert found.fallback is None


@pytest.fixture
def failing(demo_plan, monkeypatch):
    """`plan` of a sequence with all of these surfaces fails; others are the demo's."""
    asked = []

    def fail(*surfaces: str):
        def stub(sequence, robot, scene, **_):
            used = {c for s in sequence.stances for c in s.surfaces}
            asked.append(used)
            if not all(used & set(s.split("|")) for s in surfaces):
                return demo_plan
            why = Failure(status=Status.UNREACHABLE, detail="too high")
            return replace(demo_plan, complete=False, failures=(why,), changes=())

        monkeypatch.setattr(alternatives, "plan", stub)
        return asked

    return fail


def test_where_the_demonstration_fails_an_alternative_takes_its_place(
    failing, demo_sequence, coman
):
    asked = failing("LElbow|RElbow")
    found = plan_or_replan(demo_sequence, coman, Scene.from_height(0.275))
    assert found.complete
    assert "(too high)" in found.fallback.reason
    assert found.fallback.source == "alternatives"
    assert found.fallback.surfaces == ("LHand", "RHand")
    assert str(found.fallback).endswith("of the alternatives: LHand, RHand")
    assert len(asked) == 5


def test_where_nothing_is_found_it_says_what_was_tried(failing, demo_sequence, coman):
    failing("LFoot")
    scene = Scene.from_height(0.275)
    found = plan_or_replan(demo_sequence, coman, scene, bounds=Bounds(tries=0))
    assert not found.complete
    assert found.fallback.source is None
    assert found.fallback.tried == "none of 4 alternatives has one"
    found = plan_or_replan(demo_sequence, coman, scene, bounds=Bounds(tries=1, depth=1))
    assert not found.complete
    assert "expanded 1 states and planned 1 steps" in found.fallback.tried
    assert Stop.TRIES.value in found.fallback.tried


def test_contacts_without_alternatives_are_planned_once(failing, demo_sequence, coman):
    """The only combination is the demonstrated one, which has just failed."""
    asked = failing("LFoot")
    bare = alternatives.without_surfaces(demo_sequence, {"LHand", "RHand"})
    scene = Scene.from_height(0.275)
    found = plan_or_replan(bare, coman, scene, bounds=Bounds(tries=0))
    assert found.fallback.tried == "there is no alternative"
    assert len(asked) == 1


def test_where_no_alternative_is_stable_the_search_takes_over(
    failing, demo_sequence, coman, tmp_path
):
    failing("LFoot")
    found = plan_or_replan(demo_sequence, coman, Scene.from_height(0.275))
    assert found.complete
    made = [c.step.makes.surface for c in found.changes]
    assert found.fallback.source == "search"
    assert found.fallback.surfaces == tuple(made)
    assert found.trajectory.keyframes[-1] > 0
    save_plan(found, tmp_path)
    again = load_plan(tmp_path)
    assert again.fallback == found.fallback
    steps = split_moves(again.sequence, again.world)[0]
    assert [s.makes.surface for s in steps] == made


def on_hands(demo_sequence):
    return alternatives.without_surfaces(demo_sequence, {"LElbow", "RElbow"})


def test_where_hands_fail_elbows_take_their_place(failing, demo_sequence, coman):
    failing("LHand")
    found = plan_or_replan(on_hands(demo_sequence), coman, Scene.from_height(0.2))
    assert found.complete
    assert found.fallback.surfaces == ("LElbow", "RElbow")
    made = [c.step.makes.surface for c in found.changes]
    assert made == ["LElbow", "RElbow", "LKnee", "RKnee"]


def test_the_search_goes_on_from_where_the_farthest_alternative_is_stuck(
    failing, demo_sequence, coman, monkeypatch
):
    """Nobody gets the right knee up."""
    failing("LHand")
    plain, begun = search.change_contact, []

    def no_right_knee(ik, before, step, *rest):
        if step.makes is not None and step.makes.surface == "RKnee":
            return Failure(status=Status.UNREACHABLE, step=step, detail="sore")
        return plain(ik, before, step, *rest)

    def explore(ik, goal, options, counts, bounds, start, *, report):
        begun.append([c.step.limb for c in start.changes])
        return Explored(
            route=start, sequence=None, states=1, tries=1, stop=Stop.EXHAUSTED
        )

    monkeypatch.setattr(search, "change_contact", no_right_knee)
    monkeypatch.setattr(alternatives, "explore", explore)
    found = plan_or_replan(on_hands(demo_sequence), coman, Scene.from_height(0.2))
    assert not found.complete
    farthest, anew = begun
    assert farthest == ["left_arm", "right_arm", "left_leg"]
    assert anew == []


@pytest.mark.slow
def test_weak_wrists_leave_the_weight_to_the_elbows(demo_sequence):
    robot = load_robot("coman29")
    scene = Scene.from_height(0.275)
    hands = on_hands(demo_sequence)
    assert plan_or_replan(hands, robot, scene).fallback is None
    world = build_world(robot, scene)
    efforts = zip(world.joints, world.tau_max, strict=True)
    weak = {name: 1.0 for name, effort in efforts if effort <= 5.0}
    found = plan_or_replan(hands, replace(robot, effort=weak), scene)
    assert found.complete
    assert found.fallback.surfaces == ("LElbow", "RElbow")


@pytest.mark.slow
def test_a_box_too_high_for_the_demonstration_has_an_alternative(demo_sequence, coman):
    found = plan_or_replan(demo_sequence, coman, Scene.from_height(0.59))
    assert found.complete
    assert found.fallback.source == "alternatives"


@pytest.mark.slow
def test_a_box_too_high_for_the_demonstration_is_climbed(demo_sequence, coman):
    found = plan_or_replan(demo_sequence, coman, Scene.from_height(0.59))
    assert judge(found, simulate(found)).reached


# From the middle of a climb.


def moved(scene: Scene, *offset: float) -> Scene:
    box = scene.boxes[0]
    return replace(scene, boxes=(replace(box, position=box.position + offset),))


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
        assert steps_made(demo_plan.sequence, demo_plan.world, left) == k
    standing = demo_plan.keyframes[0].stance
    assert steps_made(demo_plan.sequence, demo_plan.world, standing) == 0


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
    assert steps_made(crawl, demo_plan.world, last) == 4
    assert steps_made(crawl, demo_plan.world, on) == 8


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
    rest = replan_rest(demo_plan, now, scene)
    assert (now.done, rest.complete, rest.fallback) == (k, True, None)
    assert len(rest.changes) == 6 - k
    rollout = simulate(rest)
    assert np.array_equal(rollout.qpos[0], q)  # it starts where it was
    verdict = judge(rest, rollout)
    assert verdict.reached, verdict
    near = scene.boxes[0].position - scene.boxes[0].size / 2
    for c in rest.keyframes[-1].stance:
        assert c.support == "box"
        assert np.all(c.position[:2] > near[:2])


def test_the_rest_has_its_alternatives_too(demo_plan, monkeypatch):
    """The elbows are nowhere to be had: the hands stay."""
    key = demo_plan.keyframes[2]
    now = state_of(demo_plan, demo_plan.world.scene, key.q)
    plain = alternatives.adapt_plan

    def fails(*args):
        return replace(plain(*args), complete=False, failures=(SORE,))

    monkeypatch.setattr(alternatives, "adapt_plan", fails)
    rest = replan_rest(demo_plan, now, demo_plan.world.scene)
    assert rest.complete
    assert "(an elbow is sore)" in rest.fallback.reason
    assert rest.fallback.source == "alternatives"
    steps = split_moves(rest.sequence, rest.world)[0][rest.state.done :]
    moves = [c.step for c in rest.changes]
    assert [s.makes.surface for s in steps] == [m.makes.surface for m in moves]
    assert rest.start.stance[0].surface == "LHand"


def test_the_rest_that_was_searched_for_is_counted_from_standing(
    demo_plan, monkeypatch
):
    """Execution ticks steps off: those before the middle are made already."""
    now = state_of(demo_plan, demo_plan.world.scene, demo_plan.keyframes[3].q)
    plain = alternatives.adapt_plan
    monkeypatch.setattr(
        alternatives,
        "adapt_plan",
        lambda *a: replace(plain(*a), complete=False, failures=(SORE,)),
    )
    monkeypatch.setattr(alternatives, "contact_alternatives", lambda *a: ())

    def explore(ik, sequence, options, counts, bounds, start, *, report):
        stances = [Stance(contacts=k.stance) for k in demo_plan.keyframes[3:]]
        return Explored(
            route=replace(start, changes=demo_plan.changes[3:], arrived=True),
            sequence=replace(
                sequence, stances=tuple(stances), t=np.arange(len(stances) + 1.0)
            ),
            states=1,
            tries=3,
            stop=Stop.FOUND,
        )

    monkeypatch.setattr(alternatives, "explore", explore)
    monkeypatch.setattr(alternatives, "timed", lambda *a: demo_plan.trajectory)
    rest = replan_rest(demo_plan, now, demo_plan.world.scene)
    assert rest.complete
    assert rest.fallback.source == "search"
    assert rest.fallback.surfaces == ("RElbow", "LKnee", "RKnee")
    steps = split_moves(rest.sequence, rest.world)[0]
    left = [s.makes.surface for s in steps[rest.state.done :]]
    assert left == ["RElbow", "LKnee", "RKnee"]
    assert [c.step.index for c in rest.changes] == [s.index for s in steps[-3:]]
    assert [c.step.stance for c in rest.changes] == [s.stance for s in steps[-3:]]


def test_a_stance_that_cannot_be_settled_in_is_said_to_be_none(demo_plan):
    """On one foot, the rest of the body far off it."""
    key = demo_plan.keyframes[-1]
    now = state_of(demo_plan, demo_plan.world.scene, key.q)
    elbow = tuple(c for c in now.stance if c.surface == "LElbow")
    now = replace(now, stance=elbow, loaded=elbow)
    rest = replan_rest(demo_plan, now, demo_plan.world.scene)
    assert not rest.complete
    assert rest.trajectory is None
    assert str(rest.failures[0]).startswith("no stable posture here")


def test_a_world_without_the_box_is_the_users_mistake(demo_plan):
    scene = replace(demo_plan.world.scene, boxes=())
    now = state_of(demo_plan, scene, demo_plan.keyframes[0].q)
    with pytest.raises(InputError, match="as many boxes"):
        replan_rest(demo_plan, now, scene)


def test_ranked_is_stable_where_its_plan_is_complete(demo_plan):
    for complete in (True, False):
        plan = replace(demo_plan, complete=complete)
        assert Ranked(surfaces=(), plan=plan, cost=1.0).stable is complete


def test_contacts_of_the_middle_are_of_the_moved_world(demo_plan):
    """A box that has risen under the hands by a little: they are on its top."""
    key, scene = demo_plan.keyframes[2], demo_plan.world.scene
    up = moved(scene, 0.0, 0.0, 0.004)
    now = state_of(demo_plan, up, key.q)
    assert {c.surface for c in now.stance} >= HANDS
    kin = Kinematics(build_world(demo_plan.world.robot, up))
    kin.update(key.q)
    for c in now.stance:
        if c.support == "box":
            p = kin.contact_point(c.surface, np.array([0.0, 0.0, 1.0]))
            assert np.allclose(c.position, p)


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


def test_replan_prints_differences_and_plans_and_nothing_else(
    demo_sequence, tmp_path, capsys
):
    source = tmp_path / "sequence.json"
    save_sequence(demo_sequence, source)
    out = tmp_path / "out"
    args = ["replan", str(source), "--height", "0.15", "--out", str(out), "--json"]
    assert cli.main(args) == 0
    record = json.loads(capsys.readouterr().out)
    assert set(record) == {"differences", "plans"}
    assert record["differences"] == [
        list(d) for d in contact_differences(demo_sequence)
    ]
    assert {frozenset(p["surfaces"]) for p in record["plans"]} == {
        frozenset({a, b}) for a in ("LHand", "LElbow") for b in ("RHand", "RElbow")
    }
    assert all(set(p) == {"surfaces", "cost", "stable"} for p in record["plans"])
    costs = [p["cost"] for p in record["plans"]]
    assert costs == sorted(costs)
    best = load_plan(out)
    assert best.complete
    assert plan_cost(best) == pytest.approx(costs[0])
    kept = json.loads((out / "replan.json").read_text())
    assert kept["search"] is None
    assert [p["cost"] for p in kept["plans"]] == costs


def test_replan_with_no_stable_plan_exits_with_1(
    failing, demo_sequence, tmp_path, capsys
):
    failing("LFoot")
    source = tmp_path / "sequence.json"
    save_sequence(demo_sequence, source)
    args = ["replan", str(source), "--height", "0.275", "--out", str(tmp_path)]
    assert cli.main([*args, "--search.tries", "2", "--json"]) == 1
    record = json.loads(capsys.readouterr().out)
    assert not any(p["stable"] for p in record["plans"])
    kept = json.loads((tmp_path / "replan.json").read_text())
    assert kept["search"] == {"states": 3, "tries": 2, "stop": Stop.TRIES.value}
    assert kept["plans"][0]["missed"] == ["too high"]


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
