"""Steps in order: what fails is skipped with its reason or mended further back."""

from __future__ import annotations

import re
from dataclasses import fields, replace

import numpy as np
import pytest

from clamber.contact.contact import Contact
from clamber.contact.scaling import retarget
from clamber.contact.steps import MOVED, Seeds, Step, split_steps
from clamber.errors import Status
from clamber.model.scene import Box, Scene
from clamber.model.se3 import matrix_from_quat, matrix_from_rpy
from clamber.model.world import build_world
from clamber.planning import demonstrated, search
from clamber.planning.demonstrated import VARIATIONS, follow_steps, repairs
from clamber.planning.planner import plan
from clamber.planning.records import Budget, PlanOptions, Route, summary
from clamber.planning.search import Search
from clamber.step import change as change_module
from clamber.step.change import Change, Failure, change_contact, standing
from clamber.step.ik import IK
from clamber.step.posture import KeyframeOptions
from clamber.step.transition import MARGINS

OPTIONS = KeyframeOptions()
HEIGHT = 0.275


def find(ik, steps):
    """With the first weights alone."""
    start, search = standing(ik, OPTIONS), Search(ik, PlanOptions())
    return follow_steps(search, start, steps, variations=VARIATIONS[:1])[0]


def surfaces(keyframe) -> set[str]:
    return {c.surface for c in keyframe.stance}


@pytest.fixture(scope="module")
def ik(coman):
    """The usual box, and another one far behind it."""
    far = Box(
        name="far",
        size=np.array([1.0, 1.2, 0.4]),
        centre=np.array([4.0, 0.0, 0.2]),
        rotation=np.eye(3),
    )
    scene = Scene.from_height(HEIGHT)
    return IK(build_world(coman, replace(scene, boxes=(*scene.boxes, far))))


@pytest.fixture(scope="module")
def steps(ik, demo_sequence):
    """Both hands, both elbows, both knees."""
    steps, _ = split_steps(retarget(demo_sequence, ik.kin), ik.world)
    assert [s.makes.surface for s in steps] == [
        "LHand",
        "RHand",
        "LElbow",
        "RElbow",
        "LKnee",
        "RKnee",
    ]
    return steps


def moved(step: Step, *, support: str | None = None, position, fixed=False) -> Step:
    """The same step with its contact elsewhere."""
    makes = step.makes
    makes = replace(makes, support=support or makes.support, position=position)
    return replace(step, makes=makes, fixed=fixed)


def test_where_nothing_else_works_a_foot_that_may_turns(ik, monkeypatch):
    """The contact asked for is backwards; every other way to it is closed."""
    start = standing(ik, OPTIONS)
    foot = next(c for c in start.stance if c.surface == "LFoot")
    back = replace(foot, quaternion=np.array([0.0, 0.0, 0.0, 1.0]))
    step = Step(limb="left_leg", breaks=("LFoot",), makes=back)
    monkeypatch.setattr(change_module, "_keyframes", lambda *_: iter(()))
    assert isinstance(change_contact(ik, start, step, OPTIONS), Failure)
    found = change_contact(ik, start, replace(step, turns=True), OPTIONS)
    assert isinstance(found, Change)
    made = next(c for c in found.keyframe.stance if c.surface == "LFoot")
    ik.kin.update(found.keyframe.q)
    surface = ik.world.surfaces["LFoot"]
    R_WC = ik.kin.rotation(surface.body) @ surface.rotation
    np.testing.assert_allclose(matrix_from_quat(made.quaternion), R_WC, atol=1e-3)
    np.testing.assert_allclose(R_WC[:, 2], [0.0, 0.0, 1.0], atol=1e-3)  # it is flat
    assert made.position[2] == 0.0


# Standing.


def test_who_rises_stands_as_at_first_and_else_stays_bent(ik, steps):
    """The hand lets go of the box."""
    made = find(ik, steps[:1])
    key = made.keyframes[-1]
    step = replace(steps[0], breaks=("LHand",), makes=None, fixed=False)
    away = []
    for stands_up in (False, True):
        again = change_contact(ik, key, replace(step, stands_up=stands_up), OPTIONS)
        assert isinstance(again, Change)
        assert surfaces(again.keyframe) == {"LFoot", "RFoot"}
        joints = ik.world.qadr
        away.append(np.abs(again.keyframe.q - ik.world.home)[joints].max())
    assert away[0] > 0.3
    assert away[1] < 0.1


def test_the_robot_starts_on_both_feet_at_rest_over_them(ik):
    key = standing(ik, OPTIONS)
    assert surfaces(key) == {"LFoot", "RFoot"}
    assert key.status is Status.SOLVED
    assert np.array_equal(key.q, ik.world.home)
    assert all(c.position[2] == 0.0 for c in key.stance)
    assert np.mean([c.position for c in key.stance], axis=0)[1] == pytest.approx(0.0)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_feet_stand_where_the_scene_says_and_turned_as_it_says(coman, yaw):
    start = np.array([0.4, -0.2, yaw])
    key = standing(IK(build_world(coman, Scene(start=start))), OPTIONS)
    across = np.subtract(*(c.position for c in key.stance))
    assert np.allclose(
        matrix_from_rpy([0, 0, -yaw]) @ across,
        [0, across @ across, 0] / np.linalg.norm(across),
        atol=1e-6,
    )
    assert key.status is Status.SOLVED


# Steps that cannot be.


def test_a_step_out_of_reach_is_skipped_with_its_reason_and_the_rest_goes_on(ik, steps):
    far = moved(steps[1], support="far", position=np.array([4.0, 0.0, 0.4]))
    found = find(ik, [steps[0], far, steps[1]])
    (failure,) = found.failures
    assert failure.step is far
    assert failure.status is Status.UNREACHABLE
    assert str(failure).startswith("air -> RHand on far: a contact cannot be reached")
    said = re.search(r"\(RHand: stays (\d+) mm from far.*stretched", failure.detail)
    assert said is not None
    assert 2000 < int(said[1]) < 3000  # of 4 m, less the robot's reach and the box
    assert not found.arrived
    assert len(found.keyframes) == len(found.changes) + 1 == 3
    assert surfaces(found.keyframes[-1]) == {"LFoot", "RFoot", "LHand", "RHand"}
    assert {c.support for c in found.keyframes[-1].stance} == {"ground", "box"}


def test_a_move_that_leaves_nothing_to_stand_on_is_refused(ik, steps):
    step = Step(limb="left_leg", breaks=("LFoot", "RFoot"), makes=None)
    failure = change_contact(ik, standing(ik, OPTIONS), step, OPTIONS)
    assert str(failure) == "LFoot, RFoot -> air: no other contact is loaded"


def test_nothing_to_do_finds_the_start_alone(ik):
    found = find(ik, [])
    assert found.arrived
    assert found.changes == found.failures == ()


def test_a_firm_contact_is_made_where_it_is_wanted(ik, steps):
    wanted = np.array([0.42, 0.12, HEIGHT])
    found = find(ik, [moved(steps[0], position=wanted, fixed=True)])
    hand = next(c for c in found.keyframes[-1].stance if c.surface == "LHand")
    assert np.linalg.norm(hand.position - wanted) < 5e-3


def test_a_contact_that_is_not_firm_moves_towards_its_shoulder(ik, steps):
    wanted = np.array([0.42, 0.02, HEIGHT])
    fixed, free = (
        find(ik, [moved(steps[0], position=wanted, fixed=f)]).keyframes[-1]
        for f in (True, False)
    )
    assert free.cost_after < fixed.cost_after
    d_firm, d_free = (
        next(c for c in k.contacts if c.contact.surface == "LHand").projected_distance
        for k in (fixed, free)
    )
    assert d_free < d_firm


# Mending what lies further back.


def test_a_badly_placed_knee_is_put_elsewhere_for_the_other_ones_sake(
    ik, steps, monkeypatch
):
    bad = np.array([0.4, -0.1, HEIGHT])  # the left knee where the right one should go
    tangled = [*steps[:4], moved(steps[4], position=bad, fixed=True), steps[5]]
    monkeypatch.setattr(demonstrated, "MAX_REPAIRS", 0)
    stuck = find(ik, tangled)
    assert [str(f.step) for f in stuck.failures] == ["RFoot -> RKnee on box"]
    assert "RFoot" in surfaces(stuck.keyframes[-1])

    monkeypatch.undo()
    mended = find(ik, tangled)
    assert mended.arrived
    assert surfaces(mended.keyframes[-1]) >= {"LElbow", "RElbow", "LKnee", "RKnee"}
    left, before = (
        next(c.position for c in found.keyframes[5].stance if c.surface == "LKnee")
        for found in (mended, stuck)
    )
    assert np.linalg.norm(left - before) > MOVED.eased
    assert all(k.status is Status.SOLVED for k in mended.keyframes)


def test_no_repair_is_proposed_where_nothing_stands_on_a_contact_that_was_made(
    ik, steps
):
    start = standing(ik, OPTIONS)
    assert list(repairs(ik, Route(start=start), steps[0])) == []


class FakePlanner:
    """Stands in for `change_contact` and `repairs`: names instead of postures."""

    def __init__(
        self, monkeypatch, fails, repairs_to, margin=lambda name, tried: MARGINS[0]
    ):
        self.fails, self.repairs_to, self.tried = fails, repairs_to, []
        self.margin = margin
        monkeypatch.setattr(search, "change_contact", self.change_contact)
        monkeypatch.setattr(demonstrated, "repairs", self.repairs)

    def change_contact(self, ik, before, step, options, method):
        name = step.limb + ("!" if step.fixed else "")
        self.tried.append(name)
        if self.fails(name, self.tried):
            return Failure(status=Status.COLLIDING, detail=name)
        margin = self.margin(name, self.tried)
        return Change(step=step, keyframe=name, phases=(), margin=margin)

    def repairs(self, ik, route, step, margin=MARGINS[-1]):
        self.asked = margin
        better = self.repairs_to(step.limb, route.changes)
        return iter([] if better is None else [better])


def fake_steps(*names: tuple[str, int]) -> list[Step]:
    contact = Contact(
        surface="LHand", support="box", position=np.zeros(3), quaternion=np.eye(4)[0]
    )
    return [Step(limb=n, breaks=(), makes=contact, stance=i) for n, i in names]


A = {0: fake_steps(("a", 1))[0].makes}  # the first change's contact elsewhere


@pytest.mark.parametrize(
    ("names", "fails", "mended", "tried", "made", "missed"),
    [
        # Planning goes on from the mended step, and what works then is not missed.
        (
            "abcd",
            lambda name, tried: name == "c" and "a!" not in tried,
            "c",
            ["a", "b", "c", "a!", "b", "c", "d"],
            ["a!", "b", "c", "d"],
            [],
        ),
        (
            "abc",
            lambda name, tried: name in "bc" and "a!" not in tried,
            "c",
            ["a", "b", "c", "a!", "b", "c"],
            ["a!", "b", "c"],
            [],
        ),
        # A step that was left out between does not confuse which one is mended.
        (
            "abc",
            lambda name, tried: name == "a" or (name == "c" and "b!" not in tried),
            "c",
            ["a", "b", "c", "b!", "c"],
            ["b!", "c"],
            ["a"],
        ),
        # One that is missed before and after a repair is reported once.
        (
            "abc",
            lambda name, tried: name == "b" or (name == "c" and "a!" not in tried),
            "c",
            ["a", "b", "c", "a!", "b", "c"],
            ["a!", "c"],
            ["b"],
        ),
        # Repairs end after a few, and the step is then left out.
        (
            "abc",
            lambda name, tried: name == "b",
            "b",
            ["a", "b", *["a!", "b"] * demonstrated.MAX_REPAIRS, "c"],
            ["a!", "c"],
            ["b"],
        ),
    ],
)
def test_a_step_that_fails_is_mended_further_back_or_left_out(
    ik, monkeypatch, names, fails, mended, tried, made, missed
):
    def repairs_to(limb, changes):
        return (A, Seeds()) if limb == mended else None

    fake = FakePlanner(monkeypatch, fails, repairs_to)
    found = find(ik, fake_steps(*((n, i) for i, n in enumerate(names))))
    assert fake.tried == tried
    assert list(found.keyframes[1:]) == made
    assert [str(f) for f in found.failures] == missed
    assert found.arrived is (missed == [])


WIDE, NARROW = MARGINS[0], MARGINS[-1]


@pytest.mark.parametrize(
    ("fails", "margin", "made", "margins"),
    [
        # Room is made for a step with a small margin.
        (
            lambda name, tried: False,
            lambda name, tried: MARGINS[name == "c" and "a!" not in tried],
            ["a!", "b", "c", "d"],
            [WIDE] * 4,
        ),
        # But no other step loses its margin for it,
        (
            lambda name, tried: False,
            lambda name, tried: MARGINS[name == "a!" if "a!" in tried else name == "c"],
            ["a", "b", "c", "d"],
            [WIDE, WIDE, NARROW, WIDE],
        ),
        (
            lambda name, tried: False,
            lambda name, tried: MARGINS[name == "b" if "a!" in tried else name == "c"],
            ["a", "b", "c", "d"],
            [WIDE, WIDE, NARROW, WIDE],
        ),
        # and none is missed for it.
        (
            lambda name, tried: name == "b" and "a!" in tried and "d" not in tried,
            lambda name, tried: MARGINS[name == "c"],
            ["a", "b", "c", "d"],
            [WIDE, WIDE, NARROW, WIDE],
        ),
    ],
)
def test_for_a_larger_margin_earlier_contacts_are_put_elsewhere(
    ik, monkeypatch, fails, margin, made, margins
):
    def repairs_to(limb, changes):
        return (A, Seeds()) if limb == "c" else None

    fake = FakePlanner(monkeypatch, fails, repairs_to, margin)
    found = find(ik, fake_steps(("a", 1), ("b", 2), ("c", 3), ("d", 4)))
    assert fake.asked == WIDE
    assert list(found.keyframes[1:]) == made
    assert [c.margin for c in found.changes] == margins
    assert found.arrived


def test_feet_that_stay_go_on_tiptoe_where_flat_ones_do_not_do(ik, steps, monkeypatch):
    """And where those do not do either, the reason is that of flat feet."""
    tried = []

    def refuse(ik, before, step, held, *rest):
        tried.append(held)
        yield replace(before, status=list(Status)[len(tried)])

    monkeypatch.setattr(change_module, "_unbalanced", lambda *_: None)
    monkeypatch.setattr(change_module, "_keyframes", refuse)
    start = standing(ik, OPTIONS)
    found = change_contact(ik, start, steps[0], OPTIONS)
    assert found.status is list(Status)[1]
    assert tried[0] == start.stance
    toes = max(ik.kin.bearing_points("LFoot", np.array([0.0, 0.0, 1.0]))[:, 0])
    for c in tried[1]:
        assert c.edge is not None
        assert c.position[0] == pytest.approx(toes, abs=1e-6)


# The queue, the log and the budget.


class Named:
    """An entry that leads to others; its price may rise."""

    idle = False

    def __init__(self, name, price, ended=False, leads_to=()):
        self.name, self.price, self.ended = name, price, ended
        self.leads_to, self.asked = leads_to, []

    def look(self, search):
        self.asked.append(self.name)
        return self.leads_to

    def after(self, found):
        return found


def test_the_cheapest_comes_first_and_an_end_must_be_the_cheapest_too(ik):
    end, late = Named("end", 2.0, ended=True), Named("late", 3.0)
    middle = Named("middle", 1.0, leads_to=[end])
    first = Named("first", 0.0, leads_to=[Named("other", 1.5), late, middle])
    assert Search(ik, PlanOptions()).best_first([first]) == (end, None)
    assert middle.asked == ["middle"]
    assert late.asked == []


def test_what_has_become_dearer_while_it_waited_waits_on(ik):
    end, waits = Named("end", 1.5, ended=True), Named("waits", 1.0)
    first = Named("first", 0.0, leads_to=[end])
    first.after = lambda _: setattr(waits, "price", 2.0) or [end]
    assert Search(ik, PlanOptions()).best_first([first, waits])[0] is end
    assert waits.asked == []


def test_what_is_idle_by_now_is_not_looked_at(ik):
    end, waits = Named("end", 2.0, ended=True), Named("waits", 1.0)
    first = Named("first", 0.0, leads_to=[end])
    first.after = lambda _: setattr(waits, "idle", True) or [end]
    assert Search(ik, PlanOptions()).best_first([first, waits])[0] is end
    assert waits.asked == []


def test_without_an_end_it_says_whether_all_was_tried_or_the_budget_spent(ik):
    _, failure = Search(ik, PlanOptions()).best_first([Named("a", 0.0)])
    assert failure.status is Status.EXHAUSTED
    for budget, most in ((Budget(seconds=0.0), None), (Budget(), 0)):
        entry = Named("a", 0.0)
        found, failure = Search(ik, PlanOptions(), budget).best_first([entry], most)
        assert found is entry
        assert failure.status is Status.BUDGET
        assert entry.asked == []


def test_all_that_is_tried_is_noted_with_who_wanted_it(ik, monkeypatch):
    FakePlanner(monkeypatch, lambda name, tried: name == "b", lambda *_: None)
    search, (a, b, c) = (
        Search(ik, PlanOptions()),
        fake_steps(("a", 1), ("b", 2), ("c", 3)),
    )
    start = standing(ik, OPTIONS)
    follow_steps(search, start, [a, c])
    follow_steps(search, start, [b], "elbows", VARIATIONS[:2])
    tried = [(x.proposer, x.step.limb, x.failure is None) for x in search.attempts]
    assert tried == [
        ("demonstrated", "a", True),
        ("demonstrated", "c", True),
        ("elbows", "b", False),
        ("elbows", "b", False),
    ]
    demonstrated, elbows = summary(search.attempts)
    assert (demonstrated.steps, demonstrated.failed, demonstrated.last) == (2, 0, "")
    assert (elbows.proposer, elbows.steps, elbows.failed) == ("elbows", 2, 2)
    assert elbows.last == str(search.attempts[-1].failure)


def test_of_all_weights_the_first_that_leave_out_least_are_taken(ik, monkeypatch):
    """One step cannot be; another one can with the third weights alone."""
    wanted = [demonstrated.varied(PlanOptions(), f).keyframe for f in VARIATIONS]

    def change(ik, before, step, options, method):
        weights = [vars_of(w) for w in wanted].index(vars_of(options))
        if step.limb == "no" or (step.limb == "third" and weights != 2):
            return Failure(status=Status.COLLIDING, step=step)
        return Change(step=step, keyframe=before, phases=(), margin=MARGINS[0])

    monkeypatch.setattr(search, "change_contact", change)
    monkeypatch.setattr(demonstrated, "repairs", lambda *a, **k: iter(()))
    start, shared = standing(ik, OPTIONS), Search(ik, PlanOptions())
    for names, weights, missed in (
        (("a",), 0, 0),
        (("a", "third"), 2, 0),
        (("a", "third", "no"), 2, 1),
        (("a", "no"), 0, 1),
    ):
        steps = fake_steps(*((n, 1) for n in names))
        route, used = follow_steps(shared, start, steps)
        assert vars_of(used.keyframe) == vars_of(wanted[weights])
        assert len(route.failures) == missed
        assert route.arrived is (missed == 0)


def vars_of(options) -> tuple:
    return tuple(getattr(options, f.name) for f in fields(options))


def test_seconds_that_are_spent_leave_what_was_reached(ik, steps):
    shared = Search(ik, PlanOptions(), Budget(seconds=0.0))
    route, _ = follow_steps(shared, standing(ik, OPTIONS), steps)
    assert shared.attempts == []
    assert [f.status for f in route.failures] == [Status.BUDGET]


def test_a_box_higher_than_flat_feet_reach_is_climbed_on_tiptoe(coman, demo_sequence):
    found = plan(demo_sequence, coman, Scene.from_height(0.56))
    assert found.complete
    assert all(e.feasible for e in found.equilibria)
    held = [c for change in found.changes for c in change.phases[1].contacts]
    tiptoe = [c for c in held if c.edge is not None]
    assert {c.surface for c in tiptoe} <= {"LFoot", "RFoot"}
    assert {c.support for c in found.keyframes[-1].stance} == {"box"}
