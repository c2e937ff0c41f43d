"""The search for contacts: what it tries first, what it finds, and why it ends."""

from __future__ import annotations

import multiprocessing
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clamber.contact.contact import region_of
from clamber.contact.policy import DemoPolicy
from clamber.contact.scaling import retarget
from clamber.contact.steps import split_steps
from clamber.errors import InputError, Status
from clamber.model.scene import Scene
from clamber.model.world import build_world
from clamber.planning import search as search_module
from clamber.planning.free import (
    action_counts,
    policy_counts,
    search_contacts,
    sequence_of,
)
from clamber.planning.records import Budget, PlanOptions, Route
from clamber.planning.search import Search
from clamber.step.change import Failure, standing
from clamber.step.ik import IK
from clamber.step.stability import equilibrium_at
from oracles import contact_drift


@pytest.fixture(scope="module")
def ik(coman):
    return IK(build_world(coman, Scene.from_height(0.275)))


@pytest.fixture(scope="module")
def goal(demo_sequence, ik):
    return retarget(demo_sequence, ik.kin)


@pytest.fixture
def tried(monkeypatch):
    """Every step is said to be impossible, and noted."""
    moves = []

    def fail(ik, before, step, *rest):
        moves.append(step)
        return Failure(status=Status.COLLIDING, step=step)

    monkeypatch.setattr(search_module, "change_contact", fail)
    monkeypatch.setattr(search_module, "threads", lambda: 1)  # noted in order
    return moves


def search(ik, goal, counts=None, start=None, **budget):
    counts = action_counts(goal, ik.world) if counts is None else counts
    shared = Search(ik, PlanOptions(), Budget(**budget))
    if not isinstance(start, Route):
        start = Route(start=start or standing(ik, PlanOptions().keyframe))
    return search_contacts(shared, start, goal, counts)


def why(route) -> Status:
    return route.failures[0].status


def test_actions_are_counted_in_the_regions_in_which_they_are_taken(goal, ik):
    assert action_counts(goal, ik.world) == {
        ("G", "LHand"): 1,
        ("M", "RHand"): 1,
        ("M", "LElbow"): 1,
        ("M", "RElbow"): 1,
        ("M", "LKnee"): 1,
        ("M", "RKnee"): 1,
    }


def test_a_policy_counts_the_actions_of_all_its_demonstrations(goal):
    on = goal.stances[-1]
    table = DemoPolicy(
        source="one",
        scene=goal.scene,
        subject={},
        states=(on,) * 5,
        actions=("LKnee", None, "LKnee", "RElbow"),
    )
    policy = SimpleNamespace(demos=(table, table))
    assert policy_counts(policy) == {("O", "LKnee"): 4, ("O", "RElbow"): 2}


@pytest.fixture(scope="module")
def found(ik, goal):
    return search(ik, goal)


def test_a_way_up_is_found_on_a_box_that_can_be_climbed(found):
    assert found.arrived
    assert region_of(found.keyframes[-1].stance) == "O"
    assert len(found.keyframes[-1].stance) == 4  # a surface of each limb


def test_what_is_found_is_a_sequence_of_single_moves_that_plans_as_it_is(found, ik):
    steps, skipped = split_steps(sequence_of(ik.world, found), ik.world)
    assert skipped == []
    for step, change in zip(steps, found.changes, strict=True):
        move = change.step
        assert step.breaks == move.breaks
        assert step.makes.surface == move.makes.surface
        assert np.allclose(step.makes.position, move.makes.position)
    own = sequence_of(ik.world, found)
    again = retarget(own, ik.kin)
    for a, b in zip(again.stances, own.stances, strict=True):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            assert np.linalg.norm(c.position - d.position) < 0.01


def test_every_keyframe_that_is_found_closes_its_contacts_and_holds(found, ik):
    for key in found.keyframes:
        ik.kin.update(key.q)
        assert equilibrium_at(ik.kin, key.q, key.stance).feasible
        assert max(contact_drift(ik.kin, c) for c in key.stance) < 1e-3


def test_the_same_search_finds_the_same(found, ik, goal):
    again = search(ik, goal)
    for a, b in zip(again.keyframes, found.keyframes, strict=True):
        assert np.array_equal(a.q, b.q)


def test_what_is_found_does_not_depend_on_the_number_of_threads(ik, goal, monkeypatch):
    """Also in which order it is noted, and why what failed did."""
    plain, before = search_module.change_contact, standing(ik, PlanOptions().keyframe)
    routes, logs, aside = [], [], []

    def count(*args):
        if threading.current_thread() is not threading.main_thread():
            aside.append(args)
        return plain(*args)

    monkeypatch.setattr(search_module, "change_contact", count)
    for n in (1, 2, 4):
        monkeypatch.setattr(search_module, "threads", lambda n=n: n)
        shared = Search(ik, PlanOptions(), Budget(tries=40))
        counts = {("G", "RKnee"): 5.0, ("M", "RKnee"): 5.0}  # leads astray at first
        route = search_contacts(shared, Route(start=before), goal, counts)
        routes.append(route)
        logs.append([(str(a.step), str(a.failure)) for a in shared.attempts])
        assert bool(aside) == (n > 1)
    assert any(failure != "None" for _, failure in logs[0])
    assert logs[0] == logs[1] == logs[2]
    for route in routes[1:]:
        for a, b in zip(route.keyframes, routes[0].keyframes, strict=True):
            assert np.array_equal(a.q, b.q)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_tries_in_threads_of_its_own():
    def works() -> None:
        assert search_module._pool(1, "jobs").submit(len, "ok").result(timeout=10) == 2

    works()
    child = multiprocessing.get_context("fork").Process(target=works)
    child.start()
    child.join()
    assert child.exitcode == 0


def test_where_the_robot_is_there_already_nothing_is_planned(
    ik, goal, demo_plan, tried
):
    there = search(ik, goal, start=demo_plan.keyframes[-1])
    assert (there.arrived, there.changes, tried) == (True, (), [])
    assert len(sequence_of(ik.world, there).stances) == 1
    almost = search(ik, goal, start=demo_plan.keyframes[-2], tries=3)
    assert why(almost) is Status.BUDGET


def test_a_goal_in_the_scene_is_to_be_reached_too(demo_plan, coman, goal, tried):
    key = demo_plan.keyframes[-1]
    for off, there in ((0.1, True), (0.2, False)):
        xy = key.q[:2] + np.array([off, 0.0])
        ik = IK(build_world(coman, replace(demo_plan.world.scene, goal=xy)))
        ended = search(ik, goal, start=key, tries=2)
        assert ended.arrived is there


def test_a_demonstration_that_ends_where_it_began_asks_for_a_place(ik, goal, tried):
    """Back on the ground, on the far side of the box."""
    far = [
        replace(c, position=c.position + np.array([1.6, 0.0, 0.0]))
        for c in goal.stances[0].contacts
    ]
    there = replace(goal.stances[0], contacts=tuple(far))
    back = replace(goal, stances=(*goal.stances[:-1], there))
    assert why(search(ik, back, tries=1)) is Status.BUDGET  # not FOUND at once
    here = replace(goal, stances=(*goal.stances[:-1], goal.stances[0]))
    assert search(ik, here, tries=1).arrived


def standing_on_box(goal, world):
    """The sequence, ended on the feet alone, on the box."""
    feet = [
        replace(
            c,
            support="box",
            position=c.position + np.array([0.5, 0.0, world.scene.boxes[0].size[2]]),
        )
        for c in goal.stances[0].contacts
    ]
    last = replace(goal.stances[-1], contacts=tuple(feet))
    return replace(goal, stances=(*goal.stances[:-1], last)), feet


@pytest.mark.parametrize("height", [1.0, 0.7])
def test_to_stand_is_to_be_on_the_feet_alone_and_up(ik, goal, tried, height):
    upright, feet = standing_on_box(goal, ik.world)
    key = standing(ik, PlanOptions().keyframe)
    states = tuple(
        replace(s, contact=c) for s, c in zip(key.contacts, feet, strict=True)
    )
    q = key.q.copy()
    q[2] = height * q[2] + feet[0].position[2]
    ended = search(ik, upright, start=replace(key, contacts=states, q=q), tries=1)
    assert ended.arrived is (height == 1.0)


def test_kneeling_is_no_standing_and_arms_may_let_go(ik, goal, demo_plan, tried):
    upright, _ = standing_on_box(goal, ik.world)
    ended = search(ik, upright, start=demo_plan.keyframes[-1], tries=1000)
    assert not ended.arrived
    lets_go = {m.breaks for m in tried if m.makes is None}
    assert lets_go == {("LElbow",), ("RElbow",)}
    tried.clear()
    search(ik, goal, start=demo_plan.keyframes[-2], tries=1000)
    assert all(m.makes is not None for m in tried)  # who kneels needs them


# Bounds.


def test_a_search_ends_when_everything_within_its_bounds_is_tried(ik, goal, tried):
    ended = search(ik, goal, tries=1000)
    assert why(ended) is Status.EXHAUSTED
    assert not ended.arrived
    assert ended.changes == ()
    moves = [
        (m.breaks, m.makes.surface, m.makes.support, *m.makes.position.round(3))
        for m in tried
    ]
    assert len(set(moves)) == len(moves)  # nothing is tried twice


def test_no_more_steps_are_planned_than_allowed(ik, goal, tried):
    ended = search(ik, goal, tries=3)
    assert (why(ended), len(tried)) == (Status.BUDGET, 3)


def test_without_moves_there_is_nothing(ik, goal, tried):
    ended = search(ik, goal, depth=0)
    assert (why(ended), tried) == (Status.EXHAUSTED, [])


def test_no_sequence_is_longer_than_allowed(ik, goal, demo_plan, monkeypatch):
    """Every step is possible, and none gets there."""
    change = replace(demo_plan.changes[0], keyframe=demo_plan.start)
    monkeypatch.setattr(search_module, "change_contact", lambda *a: change)
    ended = search(ik, goal, tries=10_000, depth=2)
    assert why(ended) is Status.EXHAUSTED


def test_what_is_gone_on_from_is_part_of_what_is_found(ik, goal, demo_plan):
    """Five steps are made: one more gets there, and that is all that depth counts."""
    made = Route(start=demo_plan.start, changes=demo_plan.changes[:5])
    ended = search(ik, goal, start=made, tries=20, depth=1)
    assert ended.arrived
    assert len(ended.changes) == 6
    assert ended.changes[:5] == made.changes
    again = split_steps(sequence_of(ik.world, ended), ik.world)[0]
    surfaces = [s.makes.surface for s in again]
    assert surfaces[:5] == [c.step.makes.surface for c in made.changes]
    assert surfaces[5] == "RKnee"


def test_the_last_step_to_the_feet_rises_and_no_other_does(ik, goal, monkeypatch):
    """A robot on its feet and one hand on the box has only to let go."""
    upright, feet = standing_on_box(goal, ik.world)
    hand = next(c for s in goal.stances for c in s.contacts if c.surface == "LHand")
    key = standing(ik, PlanOptions().keyframe)
    states = [replace(key.contacts[0], contact=c) for c in (*feet, hand)]
    steps = []

    def refuse(ik, key, step, *rest):
        steps.append(step)
        return Failure(status=Status.COLLIDING, step=step)

    monkeypatch.setattr(search_module, "change_contact", refuse)
    search(ik, upright, start=replace(key, contacts=tuple(states)), tries=1000)
    assert any(s.makes is None for s in steps)
    for s in steps:
        assert s.stands_up == (s.makes is None)


@pytest.mark.parametrize("name", ["tries", "depth", "seconds", "ahead"])
def test_a_bound_is_not_negative(name):
    with pytest.raises(InputError, match=f"{name} is -1; expected 0 or more"):
        Budget(**{name: -1})


# What comes first.


@pytest.mark.parametrize("surface", ["LHand", "RElbow", "LKnee"])
def test_what_the_demonstration_does_most_is_tried_first(ik, goal, tried, surface):
    counts = {("G", s): 1.0 for s in ik.world.surfaces} | {("G", surface): 50.0}
    search(ik, goal, counts, tries=1)
    assert tried[0].makes.surface == surface
    assert tried[0].makes.support == "box"  # what leads nowhere can wait


def test_counts_of_another_region_do_not_matter(ik, goal, tried):
    even = {("G", s): 1.0 for s in ik.world.surfaces}
    search(ik, goal, even, tries=4)
    first = [(m.makes.surface, m.makes.support) for m in tried]
    tried.clear()
    search(ik, goal, even | {("O", "RKnee"): 100.0}, tries=4)
    assert [(m.makes.surface, m.makes.support) for m in tried] == first


def test_the_nearer_of_two_places_is_tried_first(ik, goal, tried):
    search(ik, goal, {("G", "LHand"): 1000.0}, tries=2)
    shoulder = ik.world.robot.limbs["left_arm"].root
    ik.kin.update(ik.world.home)
    root = ik.kin.landmark(shoulder)[1]
    away = [np.linalg.norm(m.makes.position - root) for m in tried]
    assert [m.makes.surface for m in tried] == ["LHand", "LHand"]
    assert away[0] < away[1]


def test_places_beyond_reach_are_not_tried(coman, demo_sequence, tried):
    scene = Scene.from_height(0.275)
    away = np.array([2.5, 0.0, 0.0])
    box = replace(scene.boxes[0], centre=scene.boxes[0].centre + away)
    ik = IK(build_world(coman, replace(scene, boxes=(box,))))
    ended = search(ik, retarget(demo_sequence, ik.kin), tries=1000)
    assert why(ended) is Status.EXHAUSTED
    assert all(m.makes.support == "ground" for m in tried)


def test_places_lie_on_their_supports(ik, goal, tried):
    search(ik, goal, tries=1000)
    for m in tried:
        support = ik.world.supports[m.makes.support]
        assert abs(support.height(m.makes.position)) < 1e-9
        assert support.inside(m.makes.position)


@pytest.mark.slow
def test_a_box_too_high_for_all_alternatives_has_a_way_up(coman, demo_sequence):
    ik = IK(build_world(coman, Scene.from_height(0.62)))
    found = search(ik, retarget(demo_sequence, ik.kin))
    assert found.arrived
    assert region_of(found.keyframes[-1].stance) == "O"
