"""Following a policy: proposals tried, from one contact to a whole crossing."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.errors import Status
from clamber.model.kinematics import Kinematics
from clamber.model.scene import GROUND, Scene
from clamber.model.world import build_world
from clamber.planning.gait import Gait
from clamber.planning.planner import plan
from clamber.planning.records import Budget, Plan, PlanOptions
from clamber.planning.search import Search
from clamber.planning.traverse import (
    PATIENCE,
    cost_to_go,
    follow,
    followers_of,
    quadrupedal_posture,
)
from clamber.run.folder import load_plan, save_plan
from clamber.step.change import Failure, standing
from clamber.step.ik import IK
from clamber.step.methods import direct
from clamber.step.path import interpolate, overlap, watched_pairs
from clamber.step.posture import KeyframeTask
from conftest import stairs
from oracles import contact_drift
from test_gait import FEET, POLICY, ROBOT, contact, row, table

OPTIONS = PlanOptions()
NO_IK: IK = None  # nothing is tried


def assert_contacts_are_kept(plan: Plan) -> None:
    kin = Kinematics(plan.world)
    for change in plan.changes:
        for phase in change.phases:
            for q in phase.q:
                kin.update(q)
                assert max(contact_drift(kin, c) for c in phase.contacts) < 0.005


@pytest.fixture(scope="module")
def crossing() -> Plan:
    return plan(POLICY, ROBOT, table())


# How long it is followed: with followers that answer at once.


class Scripted:
    """A follower that answers as it is told."""

    def __init__(self, answers, goal=(1.0, 0.0)) -> None:
        self.gait = SimpleNamespace(goal=np.array(goal))
        self.search, self.asked = Search(NO_IK, OPTIONS), 0
        self._answers = answers

    def next_changes(self, key):
        self.asked += 1
        answer = self._answers(key, self.asked)
        if answer is None or isinstance(answer, Failure):
            return (), answer
        return [(SimpleNamespace(keyframe=answer), "ac3")], None


def knees_at(x: float):
    return SimpleNamespace(stance=(contact("LKnee", x, 0.1), contact("RKnee", x, -0.1)))


def test_cost_to_go_is_the_distance_of_the_contacts_mean():
    stance = (contact("LKnee", 0.0, 1.0), contact("RKnee", 2.0, 1.0))
    assert cost_to_go(stance, np.array([1.0, 4.0])) == pytest.approx(3.0)


def test_contacts_that_come_back_to_where_they_were_end_it():
    """To and fro, without getting nearer: it would go on so for ever."""
    back, ahead = knees_at(0.6), knees_at(0.7)
    swapped = SimpleNamespace(stance=back.stance[::-1])
    to_and_fro = Scripted(lambda key, _: swapped if key is ahead else ahead)
    route = follow([to_and_fro], back, 100).route
    assert (route.arrived, len(route.changes)) == (False, 3)  # and ahead again
    assert "back and forth" in str(route.failures[0])
    # Other surfaces there are not the same.
    fewer = SimpleNamespace(stance=back.stance[:1])
    none = Scripted(lambda key, k: (ahead, fewer, None)[k - 1])
    assert follow([none], back, 100).route.arrived


def test_going_on_without_getting_nearer_is_given_up():
    away = Scripted(lambda key, k: knees_at(0.6 - 0.02 * k))
    route = follow([away], knees_at(0.6), 1000).route
    assert len(route.changes) == PATIENCE + 1
    assert "no nearer to the goal" in str(route.failures[0])


def test_it_is_cut_short_without_a_failure_and_ends_where_it_arrives():
    nearer = Scripted(lambda key, k: knees_at(0.1 * k))
    route = follow([nearer], knees_at(0.0), 4).route
    assert (len(route.changes), route.arrived, route.failures) == (4, False, ())
    nearer.search = Search(NO_IK, replace(OPTIONS, max_changes=4))
    route = follow([nearer], knees_at(0.0), 4).route
    assert "4 contact changes were not enough" in str(route.failures[0])
    nearer.search = Search(NO_IK, OPTIONS, Budget(seconds=0.0))
    route = follow([nearer], knees_at(0.0), 4).route
    assert (route.changes, route.failures[0].status) == ((), Status.BUDGET)
    there = Scripted(lambda key, _: None)
    assert follow([there], knees_at(1.0), 9).route.arrived


def test_a_secondary_policy_is_followed_where_the_first_has_no_stable_step():
    stuck = Failure(status=Status.STUCK, detail="stuck")
    first = Scripted(lambda key, k: knees_at(0.1) if k == 1 else stuck)
    other = Scripted(lambda key, k: knees_at(0.2) if k == 1 else stuck)
    found = follow([first, other], knees_at(0.0), 9)
    # The first is asked first again after each.
    assert (first.asked, other.asked) == (3, 2)
    assert [i.option for i in found.iterations] == ["ac3", "ac3, secondary 1"]
    assert found.fallback.source == "secondary"
    assert found.fallback.detail == "secondary 1 from change 2 on (stuck)"
    assert found.route.failures == (stuck,)


def test_policies_that_do_not_know_how_to_go_on_on_top_are_not_followed():
    lost = replace(POLICY, options=POLICY.options[-1:])
    other = replace(POLICY, reach={"LKnee": 0.1})
    policy = replace(POLICY, secondary=(lost, other))
    search = Search(IK(build_world(ROBOT, table())), OPTIONS)
    assert [f.gait.policy for f in followers_of(search, policy)] == [policy, other]


# With the robot.


def test_the_posture_on_all_fours_rests_on_them_level():
    ik = IK(build_world(ROBOT, table()))
    gait = Gait(ik.world, POLICY)
    kin = Kinematics(ik.world)
    kin.update(quadrupedal_posture(ik, gait))
    up = np.array([0.0, 0.0, 1.0])
    heights = [kin.contact_point(s, up)[2] for s in gait.cycle.surfaces]
    np.testing.assert_allclose(heights, 0.0, atol=1e-3)


@pytest.fixture(scope="module")
def climbing():
    """The first contacts of a flight of 0.25 m treads."""
    ik = IK(build_world(ROBOT, stairs(3, 0.15, 0.25)))
    start = standing(ik, OPTIONS.keyframe)
    search = Search(ik, OPTIONS)
    found = follow(followers_of(search, POLICY), start, 8)
    assert not found.route.failures
    assert {a.proposer for a in search.attempts} == {"gait"}
    return ik, found.route


def test_hands_then_feet_get_to_their_treads_the_weight_between_them(climbing):
    """Not over the hands, where legs that come after them would push it."""
    _, route = climbing
    hands, feet = route.keyframes[2], route.keyframes[4]
    assert {c.support for c in hands.stance} == {GROUND, "s2"}
    on = {c.surface: c for c in feet.stance}
    assert {on[s].support for s in ("LHand", "RHand")} == {"s2"}
    assert {on[s].support for s in FEET} == {"s1"}
    assert abs(feet.com[0] - np.mean([c.position[0] for c in on.values()])) < 0.03
    assert feet.com_margin > 0.08


def test_a_limb_that_goes_up_does_not_graze_the_riser_of_its_tread(climbing):
    """Between postures too, where it is not about to leave or to touch."""
    ik, route = climbing
    assert len(route.changes) == 8
    for change in route.changes:
        swing = change.phases[1]
        watched = watched_pairs(ik.world, swing.contacts)
        start, end = swing.arc[0], swing.arc[-1]
        for a, b in itertools.pairwise(swing.q):
            q = interpolate(ik.kin, a, b, 0.5)
            ik.kin.update(q)
            up = np.array([0.0, 0.0, 1.0])
            p = ik.kin.contact_point(change.step.makes.surface, up)
            away = min(np.linalg.norm(p - start), np.linalg.norm(p - end))
            if away > 0.25 * np.linalg.norm(end - start):
                depth, _ = overlap(ik, q, watched)
                assert depth < 0.0015


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "rise", "tread"), [(3, 0.1, 0.4), (6, 0.15, 0.25), (2, 0.08, 0.25)]
)
def test_stairs_are_climbed_until_all_weight_is_on_the_last(steps, rise, tread):
    found = plan(POLICY, ROBOT, stairs(steps, rise, tread))
    assert found.complete, found.failures
    assert {c.support for c in found.keyframes[-1].stance} == {f"s{steps}"}
    used = {c.support for k in found.keyframes for c in k.stance}
    assert used == {GROUND, *(f"s{i + 1}" for i in range(steps))}
    assert_contacts_are_kept(found)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.1, 0.3])
def test_a_gap_between_boxes_is_crossed_on_top(gap):
    scene = row(gap, 0.6, 0.6)
    found = plan(POLICY, ROBOT, scene)
    assert found.complete, found.failures
    assert all(c.support == GROUND for c in found.keyframes[-1].stance)
    assert found.keyframes[-1].q[0] > 1.43 + gap
    tops = {b.name: b.top for b in scene.boxes}
    supports = [{c.support for c in k.stance} for k in found.keyframes]
    up, down = supports.index({"b1"}), supports.index({"b2"})
    assert up < down
    assert not any(GROUND in s for s in supports[up:down])
    for c in (c for k in found.keyframes[up:down] for c in k.stance):
        assert tops[c.support].inside(c.position, 0.01)
    assert_contacts_are_kept(found)


@pytest.mark.slow
def test_on_bare_ground_it_steps_to_the_goal_and_stands():
    bare = Scene(start=np.zeros(3), goal=np.array([0.3, 0.1, 0.5]))
    found = plan(POLICY, ROBOT, bare)
    assert found.complete
    last = found.keyframes[-1]
    assert {c.surface for c in last.stance} == set(FEET)
    assert np.linalg.norm(last.q[:2] - [0.3, 0.1]) < 0.1
    assert {i.option for i in found.iterations} == {"ac4"}


@pytest.mark.slow
def test_a_box_is_crossed_and_the_robot_stands_beyond_it(crossing):
    assert crossing.complete
    start, last = crossing.keyframes[0], crossing.keyframes[-1]
    assert {(c.surface, c.support) for c in last.stance} == {(s, GROUND) for s in FEET}
    assert last.q[0] > 0.83
    assert last.q[2] > 0.8 * start.q[2]
    assert_contacts_are_kept(crossing)
    for before, change in zip(crossing.keyframes, crossing.changes, strict=False):
        np.testing.assert_array_equal(change.phases[0].q[0], before.q)
        np.testing.assert_array_equal(change.phases[-1].q[-1], change.keyframe.q)
    assert len(crossing.iterations) == len(crossing.changes)
    costs = [i.cost for i in crossing.iterations]
    assert costs[-1] < 0.1 < costs[0]
    assert len(crossing.changes) < 50  # it turns round on top in few cycles


@pytest.mark.slow
def test_a_plan_with_its_policy_survives_disk(crossing, tmp_path):
    save_plan(crossing, tmp_path)
    again = load_plan(tmp_path)
    assert again.policy is not None
    assert again.policy.options == POLICY.options
    assert again.iterations == crossing.iterations


def followed_from(ik: IK, q: np.ndarray, stance: tuple[Contact, ...], changes: int):
    """From a posture that is stable on some contacts."""
    task = KeyframeTask(held=stance, new=(), q_reference=q)
    key = direct(ik, task, q, OPTIONS.keyframe)
    found = follow(followers_of(Search(ik, OPTIONS), POLICY), key, changes)
    assert not found.route.failures
    return found.route


@pytest.mark.slow
@pytest.mark.parametrize("lost", [None, "LKnee", "RElbow"])
def test_it_goes_on_from_any_stance_and_sets_a_lost_limb_down_first(crossing, lost):
    middle = next(
        k
        for k in crossing.keyframes
        if all(c.support == "table" for c in k.stance) and len(k.stance) == 4
    )
    stance = tuple(c for c in middle.stance if c.surface != lost)
    route = followed_from(IK(crossing.world), middle.q, stance, 2)
    assert not route.arrived
    assert len(route.end.stance) == 4
    first = route.changes[0].step
    assert lost is None or (first.makes.surface, first.breaks) == (lost, ())


@pytest.mark.slow
def test_a_foot_that_lost_the_ground_is_set_down():
    bare = Scene(start=np.zeros(3), goal=np.array([0.3, 0.0]))
    ik = IK(build_world(ROBOT, bare))
    both = standing(ik, OPTIONS.keyframe)
    left = tuple(c for c in both.stance if c.surface == "LFoot")
    route = followed_from(ik, both.q, left, 2)
    assert {c.surface for c in route.end.stance} == set(FEET)
