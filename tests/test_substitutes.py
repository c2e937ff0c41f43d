"""Other contacts of a sequence: which there are, what they cost, the best of them."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from clamber import cli
from clamber.contact.contact import Contact, ContactSequence, Stance
from clamber.contact.steps import split_steps
from clamber.errors import Status
from clamber.execution.simulation import simulate
from clamber.execution.verdict import judge
from clamber.model.kinematics import Kinematics
from clamber.model.robot import load_robot
from clamber.model.scene import Scene
from clamber.model.world import build_world
from clamber.planning import planner, search
from clamber.planning.planner import plan, replan
from clamber.planning.records import Attempt, Budget
from clamber.planning.substitutes import (
    contact_alternatives,
    contact_differences,
    plan_cost,
    stand_ins,
    without_surfaces,
)
from clamber.run.folder import load_plan, save_plan, save_sequence
from clamber.step.change import Failure
from clamber.step.posture import KeyframeOptions

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
ON_HANDS = ("LFoot RFoot", "LFoot RFoot LHand", "RFoot LHand RHand LKnee")


def test_the_differences_are_those_of_the_thesis():
    assert [set(d) for d in contact_differences(sequence_of(*EXAMPLE))] == [
        HANDS,
        HANDS | ELBOWS,
        HANDS | ELBOWS | {"LKnee"},
        HANDS | ELBOWS | {"LKnee", "RKnee"},
    ]


def test_the_plans_are_the_four_of_the_thesis_and_keep_their_combination(coman):
    sequence = sequence_of(*EXAMPLE)
    plans = contact_alternatives(sequence, coman)
    assert sorted(map(sorted, (p.surfaces for p in plans))) == [
        ["LElbow", "RElbow"],
        ["LElbow", "RHand"],
        ["LHand", "RElbow"],
        ["LHand", "RHand"],
    ]
    for p in plans:
        gone = (HANDS | ELBOWS) - set(p.surfaces)
        for a, b in zip(p.sequence.stances, sequence.stances, strict=True):
            assert a.surfaces == tuple(s for s in b.surfaces if s not in gone)


@pytest.mark.parametrize(
    ("stances", "offers"),
    [
        (EXAMPLE[:2], [()]),  # one surface of each arm
        (("LFoot RFoot", "LFoot RFoot LHand", "LFoot RFoot LElbow"), [()]),  # or other
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


def test_elbows_stand_in_for_hands_both_before_one(coman):
    found = stand_ins(sequence_of(*ON_HANDS), coman)
    assert [set(a.surfaces) for a in found] == [
        {"LElbow", "RElbow"},
        {"LElbow", "RHand"},
        {"LHand", "RElbow"},
    ]
    for a, b in zip(
        found[0].sequence.stances, sequence_of(*ON_HANDS).stances, strict=True
    ):
        for c, d in zip(a.contacts, b.contacts, strict=True):
            assert c.surface == d.surface.replace("Hand", "Elbow")
            assert np.array_equal(c.position, d.position)


def test_hands_have_no_stand_in_that_is_used_nor_on_the_ground(coman):
    assert stand_ins(sequence_of(*EXAMPLE), coman) == ()
    one = ("LFoot RFoot", "LFoot RFoot LHand RHand", "LFoot RFoot LElbow RHand")
    assert [a.surfaces for a in stand_ins(sequence_of(*one), coman)] == [("RElbow",)]
    sequence = sequence_of(*ON_HANDS)
    ground = [
        replace(s, contacts=tuple(replace(c, support="ground") for c in s.contacts))
        for s in sequence.stances
    ]
    assert stand_ins(replace(sequence, stances=tuple(ground)), coman) == ()


# Cost and rank.


def test_the_cost_is_the_way_to_each_contact_and_its_projected_distance(demo_plan):
    world, kin, expected = demo_plan.world, Kinematics(demo_plan.world), 0.0
    for before, change in zip(demo_plan.keyframes, demo_plan.changes, strict=False):
        made = change.step.makes
        kin.update(before.q)
        p = kin.contact_point(made.surface, np.array([0.0, 0.0, 1.0]))
        kin.update(change.keyframe.q)
        mass = kin.landmark(world.robot.limb_of(made.surface).root)[1]
        expected += np.linalg.norm(made.position - p)
        expected += np.linalg.norm((mass - made.position)[:2])
    assert plan_cost(demo_plan) == pytest.approx(expected, abs=2e-3)


def test_a_step_that_is_missed_costs_what_is_left_of_it(demo_plan):
    """The robot stands: nothing is made, all is left."""
    steps = split_steps(demo_plan.sequence, demo_plan.world)[0]
    failures = tuple(Failure(status=Status.COLLIDING, step=s) for s in steps)
    none = replace(demo_plan, changes=(), failures=failures)
    kin, expected = Kinematics(demo_plan.world), 0.0
    kin.update(demo_plan.start.q)
    for c in (s.makes for s in steps):
        mass = kin.landmark(demo_plan.world.robot.limb_of(c.surface).root)[1]
        p = kin.contact_point(c.surface, np.array([0.0, 0.0, 1.0]))
        expected += np.linalg.norm(c.position - p)
        expected += np.linalg.norm((mass - c.position)[:2])
    assert plan_cost(none) == pytest.approx(expected, abs=1e-9)


@pytest.fixture(scope="module")
def low(demo_sequence, coman):
    """The alternatives on a box of 0.15 m."""
    return replan(demo_sequence, coman, Scene.from_height(0.15))


def test_on_a_low_box_every_alternative_is_shorter_than_the_demonstration(
    low, demo_sequence, coman
):
    shown = plan(demo_sequence, coman, Scene.from_height(0.15))
    assert shown.fallback is None
    assert len(low.ranked) == len(low.tried) == 4
    assert all(r.stable for r in low.ranked)
    costs = [r.cost for r in low.ranked]
    assert costs == sorted(costs)
    assert costs[-1] < plan_cost(shown)
    for r in low.ranked:
        assert r.source == "alternatives"
        assert len(r.plan.changes) == len(shown.changes) - 2
        made = {c.step.makes.surface for c in r.plan.changes}
        assert made == {*r.surfaces, "LKnee", "RKnee"}


@pytest.mark.slow
def test_the_best_alternative_gets_up_the_low_box(low):
    rollout = simulate(low.best.plan)
    assert judge(low.best.plan, rollout).reached


def test_alternatives_do_not_depend_on_the_number_of_threads(
    demo_sequence, coman, monkeypatch
):
    """Nor does what was tried; most of it fails but with some weights."""
    plain, thought = search.change_contact, planner.VARIATIONS[:4]

    def change(ik, before, step, options, method):
        threads.add(threading.current_thread().name)
        stiff = options.reference_weight > KeyframeOptions().reference_weight
        if step.makes is not None and step.makes.surface == "LKnee" and not stiff:
            return Failure(status=Status.UNREACHABLE, step=step)
        return plain(ik, before, step, options, method)

    monkeypatch.setattr(search, "change_contact", change)
    monkeypatch.setattr(planner, "VARIATIONS", thought)
    monkeypatch.setattr("clamber.planning.demonstrated.MAX_REPAIRS", 0)
    found = []
    for n in (1, 2, 4, 9):
        threads: set[str] = set()
        monkeypatch.setattr(search, "threads", lambda n=n: n)
        found.append(replan(demo_sequence, coman, Scene.from_height(0.2)))
        assert (len(threads) > 1) is (n > 1)
    first, *others = found
    assert [r.stable for r in first.ranked] == [True] * 4
    assert all(t.failed > 0 for t in first.tried)
    for other in others:
        assert other.tried == first.tried
        for a, b in zip(first.ranked, other.ranked, strict=True):
            assert (a.surfaces, a.cost) == (b.surfaces, b.cost)
            for x, y in zip(a.plan.keyframes, b.plan.keyframes, strict=True):
                assert np.array_equal(x.q, y.q)


# Falling back.


@pytest.fixture
def failing(monkeypatch):
    """Steps that make a contact by one of these surfaces fail, of some proposers."""

    def fail(*surfaces: str, of=lambda proposer: proposer != "search"):
        plain = search.Search.change

        def change(self, proposer, before, step, options=None):
            makes = step.makes
            if of(proposer) and makes is not None and makes.surface in surfaces:
                why = Failure(status=Status.UNREACHABLE, step=step, detail="sore")
                attempt = Attempt(proposer=proposer, step=step, failure=why)
                self.attempts.append(attempt)
                return why
            return plain(self, proposer, before, step, options)

        monkeypatch.setattr(search.Search, "change", change)
        monkeypatch.setattr("clamber.planning.demonstrated.MAX_REPAIRS", 0)
        monkeypatch.setattr(planner, "VARIATIONS", ({},))

    return fail


LOW = Scene.from_height(0.2)


def test_where_the_demonstration_fails_the_best_alternative_takes_its_place(
    failing, demo_sequence, coman
):
    failing("LElbow", "RElbow")
    alone = plan(demo_sequence, coman, LOW, contacts="demonstrated")
    assert not alone.complete
    assert alone.fallback is None
    found = plan(demo_sequence, coman, LOW)
    assert found.complete
    assert found.trajectory.keyframes[-1] > 0
    assert found.fallback.source == "alternatives"
    assert found.fallback.surfaces == ("LHand", "RHand")
    assert str(alone.failures[0]) in found.fallback.reason
    said = str(found.fallback)
    assert said.endswith("; instead, of the alternatives: LHand, RHand")


def test_where_hands_fail_elbows_take_their_place(failing, demo_sequence, coman):
    failing("LHand")
    found = plan(without_surfaces(demo_sequence, ELBOWS), coman, LOW)
    assert found.complete
    assert found.fallback.surfaces == ("LElbow", "RElbow")
    made = [c.step.makes.surface for c in found.changes]
    assert made == ["LElbow", "RElbow", "LKnee", "RKnee"]


def test_where_nothing_is_found_it_says_what_was_tried(
    failing, demo_sequence, coman, tmp_path
):
    failing("LKnee", "RKnee", "LFoot", "RFoot", of=lambda proposer: True)
    found = plan(demo_sequence, coman, LOW, budget=Budget(tries=3))
    assert not found.complete
    assert found.fallback.source is None
    tried = {t.proposer: t for t in found.fallback.tried}
    assert list(tried) == [
        "demonstrated",
        "LElbow, RElbow",
        "LElbow, RHand",
        "LHand, RElbow",
        "LHand, RHand",
        "search",
    ]
    assert tried["search"].steps == 6  # from where the best was stuck, from the start
    assert tried["demonstrated"].failed == len(found.failures) == 2
    assert tried["demonstrated"].last.endswith("sore")
    said = str(found.fallback)
    assert said.startswith(found.fallback.reason)
    assert "none of 4 alternatives has one" in said
    assert "the search (6 steps tried: " in said
    save_plan(found, tmp_path)
    assert load_plan(tmp_path).fallback == found.fallback
    none = plan(demo_sequence, coman, LOW, budget=Budget(tries=0))
    assert "search" not in {t.proposer for t in none.fallback.tried}


def test_where_the_time_is_over_nothing_else_is_tried(demo_sequence, coman):
    found = plan(demo_sequence, coman, LOW, budget=Budget(seconds=0.0))
    assert [f.status for f in found.failures] == [Status.BUDGET]
    assert "0 s allowed are spent" in found.fallback.reason
    assert not any(t.steps for t in found.fallback.tried)


def test_contacts_without_alternatives_are_tried_once(failing, demo_sequence, coman):
    """The only combination is the demonstrated one, which has just failed."""
    failing("LKnee")
    bare = without_surfaces(demo_sequence, HANDS)
    found = plan(bare, coman, LOW, budget=Budget(tries=0))
    assert [t.proposer for t in found.fallback.tried] == ["demonstrated"]


def test_where_no_alternative_is_stable_the_search_goes_on_from_the_farthest(
    failing, demo_sequence, coman, tmp_path
):
    failing("RKnee")
    found = plan(demo_sequence, coman, LOW)
    assert found.complete
    assert found.fallback.source == "search"
    made = [c.step.makes.surface for c in found.changes]
    assert found.fallback.surfaces == tuple(made)
    assert made[-1] == "RKnee"
    assert [c.step.index for c in found.changes] == list(range(len(made)))
    save_plan(found, tmp_path)
    again = load_plan(tmp_path)
    assert again.fallback == found.fallback
    steps = split_steps(again.sequence, again.world)[0]
    assert [s.makes.surface for s in steps] == made


@pytest.mark.slow
def test_weak_wrists_leave_the_weight_to_the_elbows(demo_sequence):
    robot = load_robot("coman29")
    scene = Scene.from_height(0.275)
    hands = without_surfaces(demo_sequence, ELBOWS)
    assert plan(hands, robot, scene).fallback is None
    world = build_world(robot, scene)
    efforts = zip(world.joints, world.tau_max, strict=True)
    weak = {name: 1.0 for name, effort in efforts if effort <= 5.0}
    found = plan(hands, replace(robot, effort=weak), scene)
    assert found.complete
    assert found.fallback.surfaces == ("LElbow", "RElbow")


@pytest.mark.slow
def test_a_box_too_high_for_the_demonstration_is_climbed(demo_sequence, coman):
    found = plan(demo_sequence, coman, Scene.from_height(0.59))
    assert found.complete
    assert found.fallback.source == "alternatives"
    assert judge(found, simulate(found)).reached


# From the command line.


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
    best = load_plan(out)
    assert best.complete
    assert plan_cost(best) == pytest.approx(costs[0])
    kept = json.loads((out / "replan.json").read_text())
    assert [p["cost"] for p in kept["plans"]] == costs
    assert [t["failed"] for t in kept["tried"]] == [0] * 4


@pytest.mark.whole
def test_replan_with_no_stable_plan_exits_with_1(
    failing, demo_sequence, tmp_path, capsys
):
    failing("LKnee", "LFoot", of=lambda proposer: True)
    source = tmp_path / "sequence.json"
    save_sequence(demo_sequence, source)
    args = ["replan", str(source), "--height", "0.2", "--out", str(tmp_path)]
    assert cli.main([*args, "--search.tries", "2", "--json"]) == 1
    record = json.loads(capsys.readouterr().out)
    assert not any(p["stable"] for p in record["plans"])
    kept = json.loads((tmp_path / "replan.json").read_text())
    assert kept["tried"][-1]["proposer"] == "search"
    assert kept["tried"][-1]["steps"] == 4
    assert kept["plans"][0]["missed"][0].endswith("sore")
